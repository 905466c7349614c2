"""Point sets and triangles: matching a moved copy, welding coincident points, intersecting rays."""

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


def welded(points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return every place once and the place of each point, as numpy's `unique` of rows does in four times as long.

    Args:
        points: finite, shape (n, k).

    Returns:
        The places in rising order, first by their first coordinate, shape (m, k); and indices into them, shape (n,).
    """
    order = np.lexsort(points.T[::-1])
    sorted_points = points[order]
    first = np.ones(len(points), bool)
    first[1:] = (sorted_points[1:] != sorted_points[:-1]).any(axis=1)
    index = np.empty(len(points), np.int64)
    index[order] = np.cumsum(first) - 1
    return sorted_points[first], index


_PARALLEL = 1e-12  # determinant below which a ray runs along a triangle


def meet_triangles(origin: Array, direction: Array, corners: Array) -> tuple[Array, Array, Array]:
    """Return where a line meets the planes of triangles (Moeller and Trumbore 1997, fast ray/triangle intersection).

    Args:
        origin, direction: a point of the line and its direction, of any length, shape (3,).
        corners: of the triangles, shape (N, 3, 3).

    Returns:
        Barycentric coordinates u and v of the second and third corner, each shape (N,), and how far along the line
        in lengths of `direction`, shape (N,); the line meets a triangle if u, v >= 0 and u + v <= 1. All are 0 where
        it runs along the triangle.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    e1, e2, s = b - a, c - a, origin - a
    h = np.cross(direction, e2)
    det = np.einsum("ij,ij->i", e1, h)
    det = np.where(np.abs(det) < _PARALLEL, np.inf, det)
    q = np.cross(s, e1)
    return np.einsum("ij,ij->i", s, h) / det, q @ direction / det, np.einsum("ij,ij->i", e2, q) / det
