"""Point sets and triangles: alignment, matching to a moved copy, triangulation, welding, and ray intersection."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array
from jawusd.geometry.se3 import make_transform, transform_points
from jawusd.geometry.so3 import nearest_rotation

_Number = TypeVar("_Number", np.float64, np.int64)

_MIN_ASPECT = 1e-6  # ratio of the second-largest to the largest extent of points below which they count as collinear


def rigid_fit(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """Return the rigid T (..., 4, 4) minimising sum w |T source - target|^2 (Arun et al. 1987, Umeyama 1991).

    `source` (N, 3) [mm] are at least three points, not collinear; `target` (..., N, 3) [mm] is one set or many;
    `weights` (N,) are not negative.

    Raises:
        ValueError: the shapes are wrong, or the points are fewer than three or collinear.
    """
    P, Q = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if P.shape != Q.shape[-2:] or P.ndim != 2 or P.shape[1] != 3 or len(P) < 3:
        raise ValueError(f"source and target must both have shape (N >= 3, 3), got {P.shape} and {Q.shape}")
    w = np.ones(len(P)) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w / w.sum()
    p0, q0 = w @ P, w @ Q
    spread = np.linalg.svd((P - p0) * np.sqrt(w)[:, None], compute_uv=False)
    if spread[1] < 1e-9 * max(spread[0], 1e-300):
        raise ValueError("the source points are collinear, so the rotation about their line is undetermined")
    R = np.swapaxes(nearest_rotation(((P - p0) * w[:, None]).T @ (Q - q0[..., None, :])), -1, -2)
    return make_transform(R, q0 - R @ p0)


def rigid_fits(source: ArrayLike, targets: ArrayLike) -> tuple[Array, Array]:
    """Return the rigid motions of points (N, 3) [mm] to targets (F, N, 3) [mm], NaN if missing, each by `rigid_fit`.

    Return T (F, 4, 4), and the rms distance (F,) [mm] over the points present; both are NaN in frames with fewer than
    three points or collinear ones.

    Raises:
        ValueError: the shapes are wrong.
    """
    P, Q = np.asarray(source, dtype=np.float64), np.asarray(targets, dtype=np.float64)
    if P.ndim != 2 or P.shape[1] != 3 or Q.ndim != 3 or Q.shape[1:] != P.shape:
        raise ValueError(f"expected source (N, 3) and targets (F, N, 3), got {P.shape} and {Q.shape}")
    T, rms = np.full((len(Q), 4, 4), np.nan), np.full(len(Q), np.nan)
    present = np.isfinite(Q).all(axis=-1)
    for seen in np.unique(present, axis=0):
        if seen.sum() < 3 or _on_a_line(P[seen]):
            continue
        rows = np.flatnonzero((present == seen).all(axis=1))
        found = Q[rows][:, seen]
        T[rows] = rigid_fit(P[seen], found)
        off = transform_points(T[rows], P[seen]) - found
        rms[rows] = np.sqrt((off**2).sum(axis=-1).mean(axis=-1))
    return T, rms


def _on_a_line(points: Array) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] < _MIN_ASPECT * spread[0] or spread[0] == 0)


def triangulate(projections: ArrayLike, pixels: ArrayLike) -> Array:
    """Return the world point (3,) [mm] that pinhole projections (C, 3, 4), C >= 2, map to undistorted pixels (C, 2).

    A linear estimate (Hartley & Zisserman, Multiple View Geometry, section 12.2), refined by Gauss-Newton on
    the reprojection error.

    Raises:
        ValueError: the shapes are wrong, or there are fewer than two views.
    """
    M, x = np.asarray(projections, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
    if M.ndim != 3 or M.shape[1:] != (3, 4) or x.shape != (len(M), 2) or len(M) < 2:
        raise ValueError(f"expected projections (C, 3, 4) with C >= 2 and pixels (C, 2), got {M.shape} and {x.shape}")
    rows = (x[:, :, None] * M[:, None, 2, :] - M[:, :2, :]).reshape(-1, 4)
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    X = np.linalg.svd(rows)[2][-1]
    X = X[:3] / X[3]
    for _ in range(10):
        h = M @ np.append(X, 1.0)
        seen = h[:, :2] / h[:, 2:]
        residual = (seen - x).ravel()
        J = (M[:, :2, :3] - seen[:, :, None] * M[:, None, 2, :3]) / h[:, 2, None, None]
        J = J.reshape(-1, 3)
        step = np.linalg.lstsq(J, residual, rcond=None)[0]
        X = X - step
        if np.linalg.norm(step) < 1e-10:
            break
    return X


_HALF_TURNS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
_PROBES = 60


def match_points(source: Array, moved: Array, chosen: NDArray[np.int64], farthest: float) -> NDArray[np.int64] | None:
    """Return the points of a moved and scaled copy of a shape that correspond to chosen points of the shape.

    The principal axes of both are aligned, which leaves four rotations by half turns. The one that fits is used; if
    several fit, as for symmetric shapes, the one that best preserves the order of the points.

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


def welded(points: NDArray[_Number]) -> tuple[NDArray[_Number], NDArray[np.int64]]:
    """Return the distinct ones of finite points (n, k) in lexicographic order, (m, k), and indices into them, (n,).

    This is four times as fast as `numpy.unique` over rows.
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
