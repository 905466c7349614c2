"""Where a ray meets triangles."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array

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
