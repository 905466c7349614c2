"""Authoring with a rig: curves between key frames, slider ranges, and ranges normalised for retargeting.

Smooth curves are cubic between keys, separately in each parameter, with tangents that keep them monotone (Fritsch and
Carlson 1980): the weighted harmonic mean of the slopes on both sides, zero at extrema, at both ends and next to
constant segments (Fritsch and Butland 1984).
"""

from __future__ import annotations

from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.evaluator.arrays import RigArrays
from jawusd.evaluator.batching import as_floats, as_keys, as_rows, in_chunks, pairs_in_chunks
from jawusd.evaluator.bounds import SMALLEST_REACH_MM, Ranges, SliceHull
from jawusd.evaluator.clamping import Inside, kept_inside
from jawusd.evaluator.curves import HermiteCurve, interpolate_linear
from jawusd.evaluator.search import nearest_distance

_SAMPLES = 129  # number of samples of a segment that is clamped to the bound
# Fractions of a segment at which it is checked against the bound, dense at its ends, since keys may lie on the bound.
_CHECK_SHARES = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 1025))
_ROUNDING_MM = 1e-9
# How the error of a model grows: slowly up to about this distance from the captured poses, then linearly [mm]; and
# beyond the widest captured opening, per fraction of this opening, relative to the error near captured poses. Found on
# short takes of 12 subjects, checked on 12 others.
_ONSET_MM, _BEYOND = 3.0, 40.0
_NARROWEST_MM = 5.0  # narrower openings count as this one, as a fraction of almost 0 would be without limit


def interpolate_smooth(
    frames: Array, keys: Array, at: Array, bound: SliceHull | None, tangents: Array | None = None
) -> Array:
    """Return d (m, 3) [mm] at times ``at`` on a C1 curve through the keys (k, 3); constant outside the keys.

    A segment between valid keys that would leave the bound follows it instead, and is then only continuous.
    """
    if len(keys) == 1:
        return np.broadcast_to(keys, (len(at), 3)).copy()
    curve = HermiteCurve(frames, keys, smooth_tangents(frames, keys, tangents))
    at = np.clip(at, frames[0], frames[-1])
    d = curve.value(at)
    if bound is None:
        return d
    inside = bound.signed_distance(keys) <= _ROUNDING_MM
    for segment in np.flatnonzero(inside[:-1] & inside[1:]):
        queried = (at >= frames[segment]) & (at <= frames[segment + 1])
        if queried.any():
            ends = frames[segment], frames[segment + 1]
            checked = ends[0] + _CHECK_SHARES * (ends[1] - ends[0])
            if (bound.signed_distance(curve.value(checked)) > _ROUNDING_MM).any():
                times = np.linspace(*ends, _SAMPLES)
                wanted = np.concatenate([keys[segment, None], curve.value(times[1:-1]), keys[segment + 1, None]])
                kept = kept_inside(bound, times, wanted, ends_stay=True)
                d[queried] = interpolate_linear(kept.times, kept.d, at[queried])
    return d


def smooth_tangents(frames: Array, keys: Array, given: Array | None = None) -> Array:
    """Return the tangents (k, 3) [mm per frame] of the smooth curve: those given, monotone ones where these are NaN."""
    step = np.diff(frames)[:, None]
    slope = np.diff(keys, axis=0) / step
    before, after = slope[:-1], slope[1:]
    weight_before, weight_after = 2 * step[1:] + step[:-1], step[1:] + 2 * step[:-1]
    monotone = np.zeros_like(keys)
    onward = before * after > 0
    np.divide(weight_before, before, out=monotone[1:-1], where=onward)
    rest = np.divide(weight_after, after, out=np.zeros_like(before), where=onward)
    total = monotone[1:-1] + rest
    monotone[1:-1] = np.divide(weight_before + weight_after, total, out=np.zeros_like(before), where=onward)
    return monotone if given is None else np.where(np.isnan(given), monotone, given)


def error_growth_at(captured_d: Array, d: Array, distance_mm: Array) -> tuple[Array, Array]:
    """Return how the error of a model grows away from captured_d (p, 3) [mm], p > 0: factor (n,) and reach (n,) [mm].

    The rms error at d (n, 3), at distances (n,) from the nearest captured_d, is ``base_mm * factor + per_mm * reach``.
    The factor exceeds 1 beyond the widest captured opening, where the path of the condyles is unknown.
    """
    widest = captured_d[:, 0].max()
    beyond = np.maximum(d[:, 0] - widest, 0.0) / max(widest, _NARROWEST_MM)
    return 1.0 + _BEYOND * beyond, distance_mm**2 / (distance_mm + _ONSET_MM)


class RigAuthoring(RigArrays):
    """Authoring functions of a rig: motions of d, and ranges within the bound."""

    bound: SliceHull  # the slice bound

    def interpolate(
        self,
        frames: ArrayLike,
        d_keys: ArrayLike,
        at: ArrayLike,
        method: Literal["linear", "smooth"] = "linear",
        *,
        inside: bool = True,
        tangents: ArrayLike | None = None,
    ) -> Array:
        """Return jaw parameters between keys.

        Args:
            frames: Increasing key times, shape (K,).
            d_keys: Jaw parameters [mm] at the keys, shape (K, 3).
            at: Query times, any shape; before the first key and after the last one, d is constant.
            method: "linear" for straight lines in d as in the paper, or "smooth" for a C1 curve, monotone between keys.
            inside: Where the smooth curve between two valid keys would leave the bound, follow the bound instead; the
                curve is then only continuous. See `keep_inside` for keys outside the bound.
            tangents: Slopes of the smooth curve at the keys [mm per unit of time], shape (K, 3); NaN and None: those
                with which it is monotone between keys. Lines do not use them.

        Returns:
            Jaw parameters [mm], shape (*at.shape, 3).

        Raises:
            ValueError: wrong shapes, keys that are not finite, infinite tangents, frames that do not increase, or an
                unknown method.
        """
        frames, keys = as_keys(frames, d_keys)
        times, batch = as_rows(as_floats(at, "at")[..., None], (1,), "at")
        slopes = None if tangents is None else np.array(tangents, dtype=np.float64)
        if slopes is not None and (slopes.shape != keys.shape or np.isinf(slopes).any()):
            raise ValueError(f"tangents must have shape {keys.shape} and no infinite entry, got shape {slopes.shape}")
        if method == "linear":
            d = interpolate_linear(frames, keys, times[:, 0])
        elif method == "smooth":
            d = interpolate_smooth(frames, keys, times[:, 0], self.bound if inside else None, slopes)
        else:
            raise ValueError(f'method must be "linear" or "smooth", got {method!r}')
        return d.reshape(*batch, 3)

    def keep_inside(self, times: ArrayLike, d: ArrayLike) -> Inside:
        """Return a motion clamped to the bound, both at its samples and on the straight lines between them.

        Poses outside the bound are moved inside continuously, and no step becomes more than 5 % longer than in the
        given motion. Where the path inside the bound is too long for this limit, the motion just before and after it is
        retimed as well.

        Args:
            times: Increasing sample times, shape (F,).
            d: Jaw parameters [mm], interpolated linearly, shape (F, 3).

        Returns:
            The samples at the given times, and additional ones where straight lines between them would leave the bound.

        Raises:
            ValueError: wrong shapes, samples that are not finite, or times that do not increase.
            EvaluatorError: the bound of the rig is empty.
        """
        return kept_inside(self.bound, *as_keys(times, d))

    def ranges(self, d1: ArrayLike, d2: ArrayLike = 0.0, d3: ArrayLike = 0.0) -> Ranges:
        """Return the valid ranges of d2 and of d3, each varied with the other two parameters fixed.

        Args:
            d1: Opening [mm]; d1, d2, d3 broadcast to one shape (...).
            d2: Laterotrusion [mm] while d3 varies.
            d3: Protrusion [mm] while d2 varies.

        Returns:
            The limits [mm]; NaN where no value is valid. The bound ends a few tenths of a mm inside ``d_range[0]``;
            for openings between the two, the limits at the nearest valid opening are returned.
        """
        each = (as_floats(x, name) for x, name in ((d1, "d1"), (d2, "d2"), (d3, "d3")))
        d = np.stack(np.broadcast_arrays(*each), axis=-1)
        rows, batch = as_rows(d, (3,), "d")
        within = (rows[:, 0] >= self.d_range[0, 0]) & (rows[:, 0] <= self.d_range[0, 1])
        rows = np.where(within[:, None], in_chunks(self.bound.nearest_opening, rows), rows)
        ends = [pairs_in_chunks(partial(self.bound.chord, axis=axis), rows) for axis in (1, 2)]
        return Ranges(*(end.reshape(batch) for pair in ends for end in pair))

    def normalized(self, d: ArrayLike) -> Array:
        """Return d as fractions of this subject's ranges, for retargeting to another subject.

        The opening is divided by the full opening; d2 and d3 are divided by the range on their side of the habitual
        path at that opening (at least 0.5 mm).

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            Fractions, shape (..., 3): 1 is the full range.
        """
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(lambda d: d / self._reach_mm(d[:, 0], d), rows).reshape(*batch, 3)

    def denormalized(self, shares: ArrayLike) -> Array:
        """Return the jaw parameters [mm], shape (..., 3), of fractions (..., 3): the inverse of `normalized`."""
        rows, batch = as_rows(shares, (3,), "shares")
        full_mm = self.d_range[0, 1]
        return in_chunks(lambda n: n * self._reach_mm(n[:, 0] * full_mm, n), rows).reshape(*batch, 3)

    def _reach_mm(self, d1: Array, sides: Array) -> Array:
        """Return the ranges (n, 3) [mm] at openings d1 (n,), on the sides given by the signs of ``sides`` (n, 3)."""
        on_path = np.zeros((len(d1), 3))
        on_path[:, 0] = np.clip(d1, self.bound.first_mm, self.bound.last_mm)
        scale = np.full((len(d1), 3), self.d_range[0, 1])
        for axis in (1, 2):
            low, high = self.bound.chord(on_path, axis)
            reach = np.where(sides[:, axis] < 0, -low, high)
            scale[:, axis] = np.where(reach > SMALLEST_REACH_MM, reach, SMALLEST_REACH_MM)
        scale[np.isnan(d1)] = np.nan
        return scale

    def captured_distance(self, d: ArrayLike) -> Array:
        """Return the distance (...) [mm] from d (..., 3) to the d of the nearest captured pose; inf if none."""
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(lambda d: nearest_distance(self.captured_d, d), rows).reshape(batch)

    def landmark_sigma_mm(self, d: ArrayLike) -> Array:
        """Return the root mean square error of the model at its landmarks, shape (..., n) [mm]; 0 if unknown.

        It was estimated from held-out frames, and grows with the distance from the captured poses, fastest towards
        openings wider than all of them; see `error_growth_at`.

        Args:
            d: Jaw parameters [mm], shape (..., 3).
        """
        rows, batch = as_rows(d, (3,), "d")
        near_mm, growth = self.error_growth.T
        if not len(self.captured_d):
            return np.broadcast_to(near_mm, (*batch, len(near_mm))).copy()
        factor, reach_mm = error_growth_at(self.captured_d, rows, self.captured_distance(rows))
        return (near_mm * factor[:, None] + growth * reach_mm[:, None]).reshape(*batch, len(near_mm))
