"""Find the points of a shape in a moved copy whose points are in another order, or there more than once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array

_HALF_TURNS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
_PROBES = 60


def match_points(source: Array, moved: Array, chosen: NDArray[np.int64], farthest: float) -> NDArray[np.int64] | None:
    """Return which points of a moved and scaled copy of a shape are chosen points of the shape.

    The principal axes of both are laid over each other; of the half turns that leaves open, the one that fits, and of
    several, as symmetric shapes have, the one that disturbs the order least.

    Args:
        source: points of the shape, shape (N, 3); equal ones count once.
        moved: points of the copy, shape (M, 3), the same set under a rotation, translation and scale.
        chosen: indices (n,) of points of the shape.
        farthest: largest distance between a point and its copy, in units of `source`.

    Returns:
        Indices (n,) into `moved`; None where `moved` is no such copy.
    """
    _, from_source, own = np.unique(source, axis=0, return_index=True, return_inverse=True)
    _, from_moved = np.unique(moved, axis=0, return_index=True)
    if len(from_source) != len(from_moved) or len(from_source) < 4:
        return None
    order = from_source[own.reshape(-1)[chosen]] / len(source)
    a, axes_a = _principal(source[from_source])
    b, axes_b = _principal(moved[from_moved])
    b = (b @ axes_b) * np.sqrt((a**2).sum() / (b**2).sum())
    by_first = np.argsort(b[:, 0])
    b, from_moved = b[by_first], from_moved[by_first]
    axes_b_turn = np.linalg.det(axes_a) * np.linalg.det(axes_b)
    best, least = None, np.inf
    for signs in _HALF_TURNS * axes_b_turn:
        wanted = (a @ axes_a * signs)[own.reshape(-1)[chosen]]
        if _nearest(wanted[:: max(1, len(wanted) // _PROBES)], b, farthest) is None:
            continue
        found = _nearest(wanted, b, farthest)
        if found is None:
            continue
        disturbed = float(np.abs(from_moved[found] / len(moved) - order).sum())
        if disturbed < least:
            best, least = from_moved[found], disturbed
    return best


def _principal(points: Array) -> tuple[Array, Array]:
    centred = points - points.mean(axis=0)
    return centred, np.linalg.eigh(centred.T @ centred)[1][:, ::-1]


def _nearest(wanted: Array, points: Array, farthest: float) -> NDArray[np.int64] | None:
    """Return the nearest of points (M, 3), sorted by their first coordinate; None where one is too far."""
    edges = np.searchsorted(points[:, 0], np.stack([wanted[:, 0] - farthest, wanted[:, 0] + farthest]))
    found = np.empty(len(wanted), dtype=np.int64)
    for k, (first, last) in enumerate(edges.T.tolist()):
        squares = ((points[first:last] - wanted[k]) ** 2).sum(axis=1)
        if not len(squares) or squares.min() > farthest**2:
            return None
        found[k] = first + int(squares.argmin())
    return found
