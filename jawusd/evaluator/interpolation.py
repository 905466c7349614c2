"""Animation between keys of d: straight lines as in the paper, or smooth curves that stay between their keys.

A smooth curve is cubic between keys, in each parameter by itself, with tangents that keep it monotone (F. N. Fritsch
and R. E. Carlson, Monotone Piecewise Cubic Interpolation, SIAM J. Numer. Anal. 17, 1980), here those of F. N. Fritsch
and J. Butland (SIAM J. Sci. Stat. Comput. 5, 1984): the weighted harmonic mean of the slopes on both sides, zero at
extremes and holds. It starts and stops at rest.
"""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.clamping import kept_inside
from jawusd.evaluator.curves import HermiteCurve

_SAMPLES = 129  # of a piece that is brought inside
# Shares of a piece at which it is looked at to see whether it leaves the bound, dense at its ends: keys may lie on it.
_CROWDED = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 1025))
_ROUNDING_MM = 1e-9


def interpolated(frames: Array, keys: Array, at: Array, method: str, bound: SliceHull | None) -> Array:
    """Return d (m, 3) [mm] at times ``at`` between keys (k, 3), "linear" or "smooth"; constant outside the keys.

    Args:
        bound: Keeps smooth pieces between two keys that are inside: where one would leave the bound, it runs along it.

    Raises:
        ValueError: another method.
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

    With a bound, a piece that would leave it between keys inside follows it instead, and is continuous only.
    """
    if len(keys) == 1:
        return np.broadcast_to(keys, (len(at), 3)).copy()
    curve = HermiteCurve(frames, keys, monotone_tangents(frames, keys))
    at = np.clip(at, frames[0], frames[-1])
    d = curve.value(at)
    if bound is None:
        return d
    inside = bound.signed_distance(keys) <= _ROUNDING_MM
    for piece in np.flatnonzero(inside[:-1] & inside[1:]):
        asked = (at >= frames[piece]) & (at <= frames[piece + 1])
        if asked.any():
            ends = frames[piece], frames[piece + 1]
            looked_at = ends[0] + _CROWDED * (ends[1] - ends[0])
            if (bound.signed_distance(curve.value(looked_at)) > _ROUNDING_MM).any():
                times = np.linspace(*ends, _SAMPLES)
                wanted = np.concatenate([keys[piece, None], curve.value(times[1:-1]), keys[piece + 1, None]])
                kept = kept_inside(bound, times, wanted, ends_stay=True)
                d[asked] = interpolate_linear(kept.times, kept.d, at[asked])
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
