"""Animation between keys of d: straight lines as in the paper, or smooth curves that respect the bound."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.curves import HermiteCurve
from jawusd.geometry.arrays import Array, Mask

_TANGENT_SCALES = (1.0, 0.7, 0.4, 0.2, 0.0)
_SAMPLES = 33
_MOST_WAYPOINT_ROUNDS = 8
_ROUNDING_MM = 1e-9


def interpolated(frames: Array, keys: Array, at: Array, method: str, bound: SliceHull) -> Array:
    """Return d (m, 3) [mm] at times ``at`` between keys (k, 3), "linear" or "smooth"; constant outside the keys.

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


def interpolate_smooth(frames: Array, keys: Array, at: Array, bound: SliceHull) -> Array:
    """Return d (m, 3) [mm] at times ``at`` on a C1 curve through the keys (k, 3); constant outside the keys.

    Cubic Hermite pieces with the tangents of Catmull and Rom (1974). Where a piece between two keys inside the bound
    would leave it, the tangents at its keys are shortened, at worst to zero, when the piece is a straight line run
    through with a soft start and stop; and where even the straight line leaves the bound (the bound is not convex along
    d1) a waypoint inside is added first.
    """
    if len(keys) == 1:
        return np.broadcast_to(keys, (len(at), 3)).copy()
    frames, keys = _with_waypoints(frames, keys, bound)
    tangents = _tangents(frames, keys)
    scale = np.ones(len(keys))
    guarded = _guarded(keys, bound)
    for level in _TANGENT_SCALES[1:]:
        curve = HermiteCurve(frames, keys, tangents * scale[:, None])
        leaves = guarded & _leaves(curve.value, frames, bound)
        if not leaves.any():
            break
        scale[:-1][leaves] = level
        scale[1:][leaves] = level
    curve = HermiteCurve(frames, keys, tangents * scale[:, None])
    return curve.value(np.clip(at, frames[0], frames[-1]))


def _tangents(frames: Array, keys: Array) -> Array:
    # finite differences for uneven frames; flat at both ends, where the motion starts and stops
    tangents = np.zeros_like(keys)
    step = np.diff(frames)[:, None]
    rate = np.diff(keys, axis=0) / step
    tangents[1:-1] = (rate[:-1] * step[1:] + rate[1:] * step[:-1]) / (step[1:] + step[:-1])
    return tangents


def _guarded(keys: Array, bound: SliceHull) -> Mask:
    """Tell which pieces have both keys inside: only those can be kept inside."""
    inside = bound.signed_distance(keys) <= _ROUNDING_MM
    return inside[:-1] & inside[1:]


def _leaves(value: Callable[[Array], Array], frames: Array, bound: SliceHull) -> Mask:
    """Tell which pieces of a curve leave the bound, by samples that crowd towards the keys."""
    s = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, _SAMPLES))
    times = frames[:-1, None] + s * np.diff(frames)[:, None]
    distance = bound.signed_distance(value(times.ravel())).reshape(times.shape)
    return np.asarray((distance > _ROUNDING_MM).any(axis=1))


def _with_waypoints(frames: Array, keys: Array, bound: SliceHull) -> tuple[Array, Array]:
    """Return frames and keys with waypoints inside the bound wherever a straight line between keys leaves it."""
    for _ in range(_MOST_WAYPOINT_ROUNDS):
        leaves = _guarded(keys, bound) & _leaves(partial(interpolate_linear, frames, keys), frames, bound)
        piece = np.flatnonzero(leaves)
        if not piece.size:
            break
        middle = 0.5 * (keys[piece] + keys[piece + 1])
        # twice as deep as the line was outside, so that the next, shorter lines clear the surface
        sunk = _sunk(middle, bound)
        frames = np.insert(frames, piece + 1, 0.5 * (frames[piece] + frames[piece + 1]))
        keys = np.insert(keys, piece + 1, sunk, axis=0)
    return frames, keys


def _sunk(points: Array, bound: SliceHull) -> Array:
    """Return the points moved down the gradient of the bound, past its surface by as much as they were outside."""
    depth = -np.maximum(bound.signed_distance(points), 0.01)
    points = points.copy()
    for _ in range(20):
        distance, normal = bound.signed_distance_gradient(points)
        squared = np.maximum(np.einsum("ni,ni->n", normal, normal), 1e-6)
        points -= (np.maximum(distance - depth, 0.0) / squared)[:, None] * normal
    return points
