"""Interpolation between key frames of d: straight lines as in the paper, or smooth curves without overshoot.

A smooth curve is cubic between keys, separately in each parameter, with tangents that keep it monotone (F. N. Fritsch
and R. E. Carlson, Monotone Piecewise Cubic Interpolation, SIAM J. Numer. Anal. 17, 1980). They are computed as by F. N.
Fritsch and J. Butland (SIAM J. Sci. Stat. Comput. 5, 1984): the weighted harmonic mean of the slopes on both sides,
zero at extrema and next to constant segments. The curve starts and stops at rest.
"""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.clamping import kept_inside
from jawusd.evaluator.curves import HermiteCurve

_SAMPLES = 129  # number of samples of a segment that is clamped to the bound
# Fractions of a segment at which it is checked against the bound, dense at its ends, since keys may lie on the bound.
_CHECK_SHARES = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 1025))
_ROUNDING_MM = 1e-9


def interpolated(frames: Array, keys: Array, at: Array, method: str, bound: SliceHull | None) -> Array:
    """Return d (m, 3) [mm] at times ``at`` between keys (k, 3), "linear" or "smooth"; constant outside the keys.

    Args:
        bound: Smooth segments between two valid keys that would leave this bound follow it instead.

    Raises:
        ValueError: an unknown method.
    """
    if method == "linear":
        return interpolate_linear(frames, keys, at)
    if method == "smooth":
        return interpolate_smooth(frames, keys, at, bound)
    raise ValueError(f'method must be "linear" or "smooth", got {method!r}')


def interpolate_linear(frames: Array, keys: Array, at: Array) -> Array:
    """Return d (m, 3) [mm] at times ``at`` on straight lines between keys (k, 3); constant outside the keys."""
    return np.stack([np.interp(at, frames, column) for column in keys.T], axis=1)


def interpolate_smooth(frames: Array, keys: Array, at: Array, bound: SliceHull | None) -> Array:
    """Return d (m, 3) [mm] at times ``at`` on a monotone C1 curve through the keys (k, 3); constant outside the keys.

    A segment between valid keys that would leave the bound follows it instead, and is then only continuous.
    """
    if len(keys) == 1:
        return np.broadcast_to(keys, (len(at), 3)).copy()
    curve = HermiteCurve(frames, keys, monotone_tangents(frames, keys))
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


def monotone_tangents(frames: Array, keys: Array) -> Array:
    """Return the tangents (k, 3) [mm per frame] of the smooth curve at the keys (k, 3) [mm]: zero at both ends."""
    step = np.diff(frames)[:, None]
    slope = np.diff(keys, axis=0) / step
    before, after = slope[:-1], slope[1:]
    weight_before, weight_after = 2 * step[1:] + step[:-1], step[1:] + 2 * step[:-1]
    tangents = np.zeros_like(keys)
    onward = before * after > 0
    np.divide(weight_before, before, out=tangents[1:-1], where=onward)
    rest = np.divide(weight_after, after, out=np.zeros_like(before), where=onward)
    total = tangents[1:-1] + rest
    tangents[1:-1] = np.divide(weight_before + weight_after, total, out=np.zeros_like(before), where=onward)
    return tangents
