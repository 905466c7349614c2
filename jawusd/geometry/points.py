"""Point sets and triangles: matching to a rigidly moved copy, welding of coincident points, ray intersection."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array

_HALF_TURNS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
_PROBES = 60


def match_points(source: Array, moved: Array, chosen: NDArray[np.int64], farthest: float) -> NDArray[np.int64] | None:
    """Return the points of a moved and scaled copy of a shape that correspond to chosen points of the shape.

    The principal axes of both are aligned, which leaves four rotations by half turns. The rotation that fits is used;
    if several fit, as for symmetric shapes, the rotation that best preserves the order of the points.

    Args:
        source: Points of the shape, shape (N, 3); duplicates count once.
        moved: Points of the copy, shape (M, 3): the same set, in any order, rotated, translated and scaled.
        chosen: Indices (n,) of points of the shape.
        farthest: Largest allowed distance between a point and its aligned copy, in units of `source`.

    Returns:
        Indices (n,) into `moved`; None if `moved` is not a copy of the shape.
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
    """Return the index of the nearest of points sorted by x, for each wanted point; None if one is too far away."""
    edges = np.searchsorted(points[:, 0], np.stack([wanted[:, 0] - farthest, wanted[:, 0] + farthest]))
    found = np.empty(len(wanted), dtype=np.int64)
    for k, (first, last) in enumerate(edges.T.tolist()):
        squares = ((points[first:last] - wanted[k]) ** 2).sum(axis=1)
        if not len(squares) or squares.min() > farthest**2:
            return None
        found[k] = first + int(squares.argmin())
    return found


def welded(points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the distinct points and the index of each point, four times as fast as `numpy.unique` over rows.

    Args:
        points: Finite points, shape (n, k).

    Returns:
        The distinct points in lexicographic order, shape (m, k), and indices into them, shape (n,).
    """
    order = np.lexsort(points.T[::-1])
    sorted_points = points[order]
    first = np.ones(len(points), bool)
    first[1:] = (sorted_points[1:] != sorted_points[:-1]).any(axis=1)
    index = np.empty(len(points), np.int64)
    index[order] = np.cumsum(first) - 1
    return sorted_points[first], index


_PARALLEL = 1e-12  # determinant below which a line counts as parallel to a triangle


def meet_triangles(origin: Array, direction: Array, corners: Array) -> tuple[Array, Array, Array]:
    """Return the intersections of a line with the planes of triangles (Moeller and Trumbore 1997).

    Args:
        origin, direction: A point of the line and its direction, of any length, shape (3,).
        corners: Corners of the triangles, shape (N, 3, 3).

    Returns:
        Barycentric coordinates u and v of the second and third corner, each shape (N,), and the distance along the
        line in units of `direction`, shape (N,). The line meets a triangle if u, v >= 0 and u + v <= 1. For triangles
        parallel to the line, all three are 0.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    e1, e2, s = b - a, c - a, origin - a
    h = np.cross(direction, e2)
    det = np.einsum("ij,ij->i", e1, h)
    det = np.where(np.abs(det) < _PARALLEL, np.inf, det)
    q = np.cross(s, e1)
    return np.einsum("ij,ij->i", s, h) / det, q @ direction / det, np.einsum("ij,ij->i", e2, q) / det
