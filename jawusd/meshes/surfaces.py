"""Primitives for building surfaces: grids, lofts, merged meshes, normals."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array

Faces = NDArray[np.int32]


def grid_faces(rows: int, columns: int, closed: bool) -> Faces:
    """Return the faces (F, 3) of a grid numbered row by row; `closed` joins the last column to the first."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns if closed else columns - 1), indexing="ij")
    k = (j + 1) % columns
    a, b, c, d = i * columns + j, i * columns + k, (i + 1) * columns + j, (i + 1) * columns + k
    return np.stack([np.stack([a, c, b], -1), np.stack([b, c, d], -1)], 2).reshape(-1, 3).astype(np.int32)


def loft(rings: Array) -> tuple[Array, Faces]:
    """Connect stacked rings (R, A, 3) [mm] to a watertight mesh with fans at both ends.

    Return vertices (R A + 2, 3) and faces (F, 3) with outward winding.
    """
    n_rings, around, _ = rings.shape
    vertices = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(1)])
    i = np.arange(around)
    j = (i + 1) % around
    last, bottom, top = (n_rings - 1) * around, n_rings * around, n_rings * around + 1
    caps = [
        np.stack([np.full(around, bottom), i, j], -1),
        np.stack([np.full(around, top), last + j, last + i], -1),
    ]
    faces = np.concatenate([grid_faces(n_rings, around, closed=True), *caps]).astype(np.int32)
    return vertices, outward(vertices, faces)


def outward(vertices: Array, faces: Faces) -> Faces:
    """Return the faces of a watertight mesh, wound so that its signed volume is positive."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return faces if np.einsum("ij,ij->", a, np.cross(b, c)) > 0 else faces[:, ::-1].copy()


def merged(parts: Iterable[tuple[Array, Faces]]) -> tuple[Array, Faces]:
    """Concatenate meshes, each with vertices (V, 3) and faces (F, 3)."""
    vertices, faces, count = [], [], 0
    for v, f in parts:
        vertices.append(v)
        faces.append(f + count)
        count += len(v)
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


def superellipse(angle: Array, squareness: float) -> tuple[Array, Array]:
    """Return the coordinates of a unit superellipse at angles."""
    c, s = np.cos(angle), np.sin(angle)
    return np.sign(c) * np.abs(c) ** squareness, np.sign(s) * np.abs(s) ** squareness


def summed_normals(vertices: Array, faces: Faces | NDArray[np.int64]) -> Array:
    """Return the sums of the normals of the faces at each vertex, which are twice as long as face areas, (V, 3)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    corners = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    return np.stack([np.bincount(faces.ravel(), corners[:, k], len(vertices)) for k in range(3)], -1)


def vertex_normals(vertices: Array, faces: Faces) -> Array:
    """Return area-weighted unit normals of the vertices, shape (V, 3)."""
    normals = summed_normals(vertices, faces)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
