"""Ways between two points inside the bound: their lengths, and shorter ones across the inside."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator.bounds import SliceHull

INSET_MM = 0.01  # what is drawn inside ends this far below the surface, so that lines between samples stay inside

_FINE_MM = 0.1  # lines are looked at in pieces of this length
_TRIED = 24  # ends of a short cut tried at once
_TIGHT_POINTS, _TIGHT_ROUNDS, _WORTH_MM = 49, 20, 0.01
_TIGHT_SHARES = (1.0, 0.5, 0.25, 0.1)  # the largest first


def lengths(path: Array) -> Array:
    """Return the length of a path (n, 3) up to each of its points (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def along(path: Array, way: Array, at: Array) -> Array:
    """Return the points (m, 3) of a path (n, 3) at lengths ``at`` (m,), given its lengths ``way`` (n,)."""
    keep = np.concatenate([[True], np.diff(way) > 0])
    return np.stack([np.interp(at, way[keep], column[keep]) for column in path.T], axis=1)


def short_enough(bound: SliceHull, path: Array, allowed: Array) -> Array:
    """Return a path (n, 3) inside, cut short across the inside where it is longer than the motion may run (n,)."""
    most = allowed[-1] - allowed[0]
    if lengths(path)[-1] <= most:
        return path
    shorter = _cut_short(bound, path)
    shorter = _pulled_tight(bound, shorter, most)
    way = lengths(shorter)
    share = (allowed - allowed[0]) / most if most > 0 else np.linspace(0.0, 1.0, len(path))
    return along(shorter, way, share * way[-1])


def _cut_short(bound: SliceHull, path: Array) -> Array:
    """Return the corners (m, 3) of a shorter path inside: straight lines from point to point, as far as each sees."""
    corners, i, last = [0], 0, len(path) - 1
    while i < last:
        tried = np.unique(np.linspace(i + 1, last, _TRIED).astype(int))
        sees = tried[_clear(bound, path[i], path[tried])]
        i = int(max(sees.max(initial=i + 1), i + 1))
        corners.append(i)
    return path[corners]


def _pulled_tight(bound: SliceHull, corners: Array, most_mm: float) -> Array:
    """Return a path (n, 3) between the same ends pulled tight inside, until it is no longer than asked for.

    Stretch after stretch, long ones first, is moved towards the straight line between its ends as far as the bound
    allows.
    """
    way = lengths(corners)
    path = along(corners, way, np.union1d(np.linspace(0.0, way[-1], _TIGHT_POINTS), way))
    for _ in range(_TIGHT_ROUNDS):
        before = lengths(path)[-1]
        half = len(path) // 2
        while half:
            for a in range(0, len(path) - 2 * half, max(half // 2, 1)):
                _flatten(bound, path[a : a + 2 * half + 1])
            half //= 2
        length = lengths(path)[-1]
        if length <= most_mm or length > before - _WORTH_MM:
            break
    return path


def _flatten(bound: SliceHull, stretch: Array) -> None:
    """Move a stretch of a path (n, 3), in place, towards the straight line between its ends, if the bound allows."""
    line = np.linspace(stretch[0], stretch[-1], len(stretch))
    tried = stretch + np.array(_TIGHT_SHARES)[:, None, None] * (line - stretch)
    points = np.concatenate([tried[:, 1:-1], 0.5 * (tried[:, 1:] + tried[:, :-1])], axis=1)
    distance = bound.signed_distance(points.reshape(-1, 3)).reshape(points.shape[:2])
    clear = (distance <= -0.5 * INSET_MM).all(axis=1)
    if clear.any():
        stretch[:] = tried[int(np.argmax(clear))]


def _clear(bound: SliceHull, start: Array, ends: Array) -> Mask:
    """Tell which straight lines from a point (3,) to others (m, 3) stay inside."""
    count = int(np.clip(np.ceil(np.linalg.norm(ends - start, axis=1).max() / _FINE_MM), 2, 400))
    share = np.linspace(0.0, 1.0, count + 1)[1:-1]
    points = start + share[:, None, None] * (ends - start)
    distance = bound.signed_distance(points.reshape(-1, 3)).reshape(len(share), len(ends))
    return np.asarray((distance <= -0.5 * INSET_MM).all(axis=0))
