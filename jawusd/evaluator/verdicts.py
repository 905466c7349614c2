"""Verdicts: whether a pose is valid, and if not, why and by how many millimetres."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator.formula import ON_BOUND_MM

# Maximum deviation from a rigid transform: accepts matrices rounded to 5 decimals, rejects sheared or scaled ones.
RIGID_TOLERANCE = 1e-3

INSIDE, OUTSIDE = "inside", "outside"


class Reason(IntFlag):
    """Why a pose is invalid; flags may be combined."""

    VALID = 0
    NOT_FINITE = 1
    NOT_RIGID = 2
    OFF_MODEL = 4
    OUTSIDE_BOUNDS = 8
    TOO_FAST = 16
    TEETH_COLLIDE = 32

    def __str__(self) -> str:
        return self.name or "VALID"

    @property
    def words(self) -> str:
        """The reasons in words, joined by commas."""
        return ", ".join(_WORDS[flag] for flag in Reason if flag in self and flag) or "valid"


_WORDS = {
    Reason.NOT_FINITE: "not finite",
    Reason.NOT_RIGID: "not rigid",
    Reason.OFF_MODEL: "off the model",
    Reason.OUTSIDE_BOUNDS: OUTSIDE,
    Reason.TOO_FAST: "too fast",
    Reason.TEETH_COLLIDE: "teeth collide",
}


class Verdicts(NamedTuple):
    """Result of `JawRig.validate`, one entry per pose."""

    valid: Mask  # whether no `Reason` applies, shape (...); measured poses may lie outside the bound by the tolerance
    #: `Reason` flags, uint8, shape (...); ``Reason(int(code))`` names them, `words` spells them out
    reason: NDArray[np.uint8]
    residual_mm: Array  # RMS landmark distance to the nearest pose of the model, (...); NaN if not finite or not rigid
    margin_mm: Array  # signed distance of d to the bound, > 0 inside, shape (...); NaN if not finite or not rigid
    d: Array  # nearest jaw parameters [mm], shape (..., 3); NaN if not finite or not rigid
    tolerance_mm: float = 0.0  # maximum distance of a valid pose outside the bound

    def measured(self) -> Mask:
        """Return which poses were compared with the model: the finite and rigid ones."""
        return (self.reason & (Reason.NOT_FINITE | Reason.NOT_RIGID).value) == 0

    def with_margin(self, margin_mm: Array, limits: Limits) -> Verdicts:
        """Return the verdicts with their margins replaced by the margins (n,) of another bound."""
        reason = self.reason & ~np.uint8(Reason.OUTSIDE_BOUNDS.value)
        reason[self.measured() & _outside(margin_mm, limits)] |= Reason.OUTSIDE_BOUNDS.value
        return self._replace(valid=reason == 0, reason=reason, margin_mm=margin_mm)

    def flagged(self, flag: Reason, where: Mask) -> Verdicts:
        """Return the verdicts with the poses in a mask (...) marked as invalid for a reason."""
        if not np.count_nonzero(where):  # ten times as fast as `any`
            return self
        reason = self.reason | np.where(where, flag.value, 0).astype(np.uint8)
        return self._replace(valid=reason == 0, reason=reason)

    def finished(self, batch: tuple[int, ...], tolerance_mm: float) -> Verdicts:
        """Return the verdicts in a batch shape, with their tolerance."""
        if not batch:
            valid, reason, residual_mm, margin_mm, d, _ = self
            return Verdicts(valid[0], reason[0], residual_mm[0], margin_mm[0], d[0], tolerance_mm)
        valid, reason = self.valid.reshape(batch), self.reason.reshape(batch)
        residual_mm, margin_mm = self.residual_mm.reshape(batch), self.margin_mm.reshape(batch)
        return Verdicts(valid, reason, residual_mm, margin_mm, self.d.reshape(*batch, 3), tolerance_mm)

    def inside(self) -> Mask:
        """Return which poses lie inside the bound, shape (...), regardless of other reasons."""
        return is_inside(self.margin_mm)

    def words(self) -> list[str]:
        """Return the verdicts in words, one per pose in row-major order.

        A valid pose is "inside" or "within tolerance 0.83 of 1.00 mm"; an invalid one is described by its reasons.
        """
        pairs = zip(self.reason.ravel().tolist(), self.margin_mm.ravel().tolist())
        return [Reason(code).words if code else place(margin, self.tolerance_mm) for code, margin in pairs]


def is_inside(margin_mm: ArrayLike) -> Mask:
    """Return which margins [mm] (...) belong to parameters inside the bound; False for NaN."""
    return np.asarray(np.asarray(margin_mm) >= -ON_BOUND_MM)


def place(margin_mm: float, tolerance_mm: float = 0.0) -> str:
    """Return the location of parameters in words: "inside", "within tolerance 0.83 of 1.00 mm" or "outside"."""
    if is_inside(margin_mm):
        return INSIDE
    if margin_mm >= -tolerance_mm - ON_BOUND_MM:
        return f"within tolerance {-margin_mm:.2f} of {tolerance_mm:.2f} mm"
    return OUTSIDE


@dataclass(frozen=True)
class Limits:
    """Thresholds of a verdict."""

    residual_mm: float  # largest landmark distance to the model
    #: maximum distance of a valid pose outside the bound: 0 for authored poses, the rig's tolerance for measured ones
    tolerance_mm: float
    speed_mm_s: float | None = None  # largest speed of any landmark since the last valid pose; None disables the check

    def replaced(self, residual_mm: float | None, tolerance_mm: float | None, speed_mm_s: float | None) -> Limits:
        """Return the limits, with the given ones replaced; raises ValueError for a negative or NaN tolerance."""
        if residual_mm is None and tolerance_mm is None and speed_mm_s is None:
            return self
        if tolerance_mm is not None and not tolerance_mm >= 0:
            raise ValueError(f"tolerance_mm must be 0 or more, got {tolerance_mm}")
        given = {"residual_mm": residual_mm, "tolerance_mm": tolerance_mm, "speed_mm_s": speed_mm_s}
        return replace(self, **{name: float(value) for name, value in given.items() if value is not None})


def judge(finite: Mask, rigid: Mask, residual_mm: Array, margin_mm: Array, d: Array, limits: Limits) -> Verdicts:
    """Return the verdicts (n rows) that follow from measurements and thresholds."""
    reason = np.zeros(len(finite), dtype=np.uint8)
    reason[~finite] |= Reason.NOT_FINITE.value
    reason[finite & ~rigid] |= Reason.NOT_RIGID.value
    measured = finite & rigid
    # `not <=` so that a NaN residual counts as off the model
    reason[measured & ~(residual_mm <= limits.residual_mm)] |= Reason.OFF_MODEL.value
    reason[measured & _outside(margin_mm, limits)] |= Reason.OUTSIDE_BOUNDS.value
    return Verdicts(reason == 0, reason, residual_mm, margin_mm, d)


def _outside(margin_mm: Array, limits: Limits) -> Mask:
    return ~(margin_mm >= -limits.tolerance_mm - ON_BOUND_MM)


def exceeds(moved_mm: Array, elapsed_s: ArrayLike, limit_mm_s: float) -> Mask:
    """Return whether landmarks that moved by (..., L, 3) [mm] in times (...) [s] exceeded a limit; False for NaN."""
    travelled = np.sqrt((moved_mm**2).sum(axis=-1).max(axis=-1, initial=0.0))
    return np.asarray(travelled > limit_mm_s * np.asarray(elapsed_s))


def too_fast(positions: Array, valid: Mask, times_s: ArrayLike | None, limit_mm_s: float) -> Mask:
    """Return which frames (..., F) were reached too fast from the last good one: valid and not reached too fast.

    Measuring from the last good frame, not from the frame before, keeps one wrong frame from making the next one
    invalid. After a lasting jump, frames are too fast until the time since the last good frame suffices for the jump.
    Positions of landmarks are (..., F, L, 3) [mm], NaN without a pose; `valid` (..., F) disregards the speed.

    Raises:
        ValueError: there is no frame axis, or the times (F,) do not match it or do not increase.
    """
    times = np.asarray([] if times_s is None else times_s, dtype=np.float64)
    if positions.ndim < 3 or times.shape != positions.shape[-3:-2] or not (np.diff(times) > 0).all():
        raise ValueError(
            "a speed limit needs poses of shape (..., F, ...) and increasing times_s of shape (F,), got "
            f"{positions.shape[:-2]} and {times.shape}"
        )
    flags = np.zeros(positions.shape[:-2], dtype=bool)
    for track in np.ndindex(flags.shape[:-1]):
        flags[track] = _too_fast(positions[track], valid[track].tolist(), times, limit_mm_s)
    return flags


def _too_fast(positions: Array, valid: list[bool], times: Array, limit_mm_s: float) -> list[bool]:
    """Return which frames of one track were reached too fast, for positions (F, L, 3)."""
    steps = [False, *exceeds(np.diff(positions, axis=0), np.diff(times), limit_mm_s).tolist()]
    flags, last = [False] * len(valid), None
    for frame, good in enumerate(valid):
        if last == frame - 1:
            flags[frame] = steps[frame]
        elif last is not None:
            elapsed_s = times[frame] - times[last]
            flags[frame] = bool(exceeds(positions[frame] - positions[last], elapsed_s, limit_mm_s))
        if good and not flags[frame]:
            last = frame
    return flags
