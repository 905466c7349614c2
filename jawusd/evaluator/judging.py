"""Margins and verdicts of a rig: for batches of poses, and for poses that arrive one at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator.arrays import RigArrays
from jawusd.evaluator.batching import as_floats, as_rows, in_chunks, rows_of
from jawusd.evaluator.bounds import PolygonBound
from jawusd.evaluator.contact import AUTHORED_MM, RigClearance
from jawusd.evaluator.kernels import NumpyKernels
from jawusd.evaluator.verdicts import Limits, Reason, Verdicts, exceeds, is_inside, too_fast
from jawusd.geometry.se3 import transform_points

BoundName = Literal["slices", "polygons"]

SINGLE_LIMIT_MM = 1e4  # maximum |d|; beyond it, float functions may raise where array functions give infinities

_scalar = cast("Callable[[float], Array]", np.float64)  # numpy's stubs do not treat scalars as arrays


class RigJudging(RigClearance, RigArrays):
    """Margins and verdicts of a rig."""

    kernels: NumpyKernels  # the implementation that evaluates rows
    limits: Limits  # the rig's thresholds of `validate`, for measured poses
    polygons: PolygonBound  # the paper's bound

    def margin(self, d: ArrayLike, *, bound: BoundName = "slices") -> Array:
        """Return the signed distance of d to the bound [mm]: positive inside, finite and smooth outside.

        Args:
            d: Jaw parameters [mm], shape (..., 3).
            bound: "slices", the joint bound of all three parameters, or "polygons", the paper's two outlines in
                (d1, d2) and (d1, d3), whose margin is continuous but not smooth.

        Returns:
            Margins [mm], shape (...); a float for one d.
        """
        if bound != "slices":
            rows, batch = as_rows(d, (3,), "d")
            margins = -in_chunks(self._polygons(bound).signed_distance, rows)
            return margins.reshape(batch)[()]  # a number without batch axes
        d = as_floats(d, "d")
        if d.shape == (3,):
            d1, d2, d3 = d.tolist()
            if abs(d1) + abs(d2) + abs(d3) < SINGLE_LIMIT_MM:  # comparisons with NaN are false
                return _scalar(self.kernels.margin(d1, d2, d3))
        rows, batch = rows_of(d, (3,), "d")
        return self.kernels.margins(rows).reshape(batch)[()]  # a number without batch axes

    def is_inside(self, d: ArrayLike, *, bound: BoundName = "slices") -> Mask:
        """Return whether jaw parameters d (..., 3) [mm] lie inside the bound, i.e. have a margin of 0 or more.

        The bound itself counts as inside, up to rounding of 1e-6 mm. The tolerance of measured poses does not apply.
        """
        return is_inside(self.margin(d, bound=bound))

    def _polygons(self, bound: BoundName) -> PolygonBound:
        if bound != "polygons":
            raise ValueError(f'bound must be "slices" or "polygons", got {bound!r}')
        return self.polygons

    def validate(
        self,
        T_skull_mandible: ArrayLike,
        *,
        residual_limit_mm: float | None = None,
        tolerance_mm: float | None = None,
        bound: BoundName = "slices",
        times_s: ArrayLike | None = None,
        speed_limit_mm_s: float | None = None,
    ) -> Verdicts:
        """Judge measured poses by rigidity, distance to the model, margin to the bound, collisions and speed.

        Args:
            T_skull_mandible: Poses, shape (..., 4, 4).
            residual_limit_mm: Largest landmark distance to the model; default: the rig's own limit.
            tolerance_mm: How far outside the bound a measured pose may lie; default: the rig's own tolerance. With 0
                the poses are judged as authored: teeth may then penetrate less deeply than in measured poses.
            bound: "slices" or "polygons"; see `margin`.
            times_s: Times of the poses along the last batch axis, shape (F,); required with a speed limit.
            speed_limit_mm_s: Largest speed of a landmark since the last valid pose; None disables the check.

        Returns:
            Verdicts of the batch shape.

        Raises:
            ValueError: wrong shapes, a negative tolerance, or a speed limit without increasing times.
        """
        rows, batch = rows_of(T_skull_mandible, (4, 4), "T_skull_mandible")
        limits = self.limits.replaced(residual_limit_mm, tolerance_mm, speed_limit_mm_s)
        verdicts = self._judged(self.kernels.judge_poses(rows, limits), limits, bound, measured=tolerance_mm != 0)
        return self._with_speed(verdicts, rows, batch, times_s, limits)

    def validate_parameters(
        self,
        d: ArrayLike,
        *,
        tolerance_mm: float | None = 0.0,
        bound: BoundName = "slices",
        times_s: ArrayLike | None = None,
        speed_limit_mm_s: float | None = None,
    ) -> Verdicts:
        """Judge jaw parameters d (..., 3) [mm] as `validate` judges poses; the residual is 0.

        By default they count as authored, with tolerance 0. With another tolerance, or None for the rig's own, they are
        judged as measured.

        Raises:
            ValueError: wrong shapes, a negative tolerance, or a speed limit without increasing times.
        """
        rows, batch = rows_of(d, (3,), "d")
        limits = self.limits.replaced(None, tolerance_mm, speed_limit_mm_s)
        verdicts = self._judged(self.kernels.judge_parameters(rows, limits), limits, bound, measured=tolerance_mm != 0)
        poses = rows if speed_limit_mm_s is None else self.kernels.poses(rows)
        return self._with_speed(verdicts, poses, batch, times_s, limits)

    def _judged(self, verdicts: Verdicts, limits: Limits, bound: BoundName, *, measured: bool) -> Verdicts:
        """Return the verdicts for a bound, with colliding poses marked invalid."""
        if bound != "slices":
            verdicts = verdicts.with_margin(self.margin(verdicts.d, bound=bound), limits)
        if self.contact is None:
            return verdicts
        limit_mm = self.contact.limit_mm if measured else -AUTHORED_MM
        if len(verdicts.d) == 1 and not self.contact.collides_at(verdicts.d, limit_mm):
            return verdicts
        return verdicts.flagged(Reason.TEETH_COLLIDE, self.contact.collides(verdicts.d, limit_mm))

    def _with_speed(
        self, verdicts: Verdicts, poses: Array, batch: tuple[int, ...], times_s: ArrayLike | None, limits: Limits
    ) -> Verdicts:
        """Return the verdicts in batch shape, with frames that exceed the speed limit marked."""
        finished = verdicts.finished(batch, limits.tolerance_mm)
        if limits.speed_mm_s is None:
            return finished
        measured = np.where(verdicts.measured()[:, None, None], poses, np.nan)
        positions = transform_points(measured, self.landmarks[None]).reshape(*batch, -1, 3)
        return finished.flagged(Reason.TOO_FAST, too_fast(positions, finished.valid, times_s, limits.speed_mm_s))

    def verdicts(
        self,
        *,
        residual_limit_mm: float | None = None,
        tolerance_mm: float | None = None,
        bound: BoundName = "slices",
        speed_limit_mm_s: float | None = None,
    ) -> VerdictStream:
        """Return an object that judges poses one at a time as `validate` judges them together.

        The arguments are those of `validate`.

        Raises:
            ValueError: a negative tolerance, or an unknown bound.
        """
        if bound != "slices":
            self._polygons(bound)
        limits = self.limits.replaced(residual_limit_mm, tolerance_mm, speed_limit_mm_s)

        def judge(T_skull_mandible: Array) -> Verdicts:
            return self.validate(
                T_skull_mandible, residual_limit_mm=residual_limit_mm, tolerance_mm=tolerance_mm, bound=bound
            )

        return VerdictStream(judge, self.landmarks, limits.speed_mm_s)


class GoodPose(NamedTuple):
    """A valid pose of a stream."""

    time_s: float  # its time [s]
    T_skull_mandible: Array  # pose of the mandible, shape (4, 4)
    d: Array  # its jaw parameters [mm], shape (3,)


class VerdictStream:
    """Judge the poses of a stream one at a time; see `JawRig.verdicts`.

    Speeds are measured from the last valid pose, `last_good` (None before the first one), so that one wrong pose does
    not make the next one invalid.
    """

    def __init__(self, judge: Callable[[Array], Verdicts], landmarks: Array, speed_limit_mm_s: float | None) -> None:
        self.last_good: GoodPose | None = None
        self._judge, self._landmarks, self._speed_limit_mm_s = judge, landmarks, speed_limit_mm_s
        self._time_s, self._positions = -np.inf, np.empty((0, 3))

    def __call__(self, T_skull_mandible: ArrayLike, time_s: float) -> Verdicts:
        """Return the verdict on the next pose (4, 4), taken at a time [s] later than that of the previous pose.

        Raises:
            ValueError: a wrong shape, or a time that is not finite or not later than the previous one.
        """
        T, time_s = as_floats(T_skull_mandible, "T_skull_mandible"), float(time_s)
        if T.shape != (4, 4):
            raise ValueError(f"T_skull_mandible must have shape (4, 4), got {T.shape}")
        if not self._time_s < time_s < np.inf:
            raise ValueError(
                f"time_s must be finite and later than that of the last pose ({self._time_s}), got {time_s}"
            )
        verdict = self._judge(T)
        self._time_s = time_s
        if not verdict.measured():
            return verdict
        positions = transform_points(T, self._landmarks)
        if self._speed_limit_mm_s is not None and self.last_good is not None:
            elapsed_s = time_s - self.last_good.time_s
            fast = exceeds(positions - self._positions, elapsed_s, self._speed_limit_mm_s)
            verdict = verdict.flagged(Reason.TOO_FAST, fast)
        if verdict.valid:
            self.last_good, self._positions = GoodPose(time_s, T.copy(), verdict.d), positions
        return verdict
