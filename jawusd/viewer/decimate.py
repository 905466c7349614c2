"""Meshes for a screen: decimation, and which ones need both sides of their faces drawn."""

from __future__ import annotations

import numpy as np

from jawusd.formats.mesh import Mesh

_STEPS, _NEAR = 8, 0.93  # share of the wanted number of faces that ends the search


def for_view(mesh: Mesh, most_faces: int) -> Mesh:
    """Return a mesh decimated to at most `most_faces` faces for display; the mesh itself when it has no more.

    Vertex clustering (Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993).
    The number of faces goes with the inverse square of the grid's cell, which gives every next cell.
    """
    if len(mesh.faces) <= most_faces:
        return mesh
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    fine, coarse, cell, best = 0.0, extent, np.sqrt(2.0 * area / most_faces), None
    for _ in range(_STEPS):
        if not fine < cell < coarse:
            cell = 0.5 * (fine + coarse)
        clustered = _clustered(mesh, cell)
        count = len(clustered.faces)
        if count > most_faces:
            fine = cell
        else:
            coarse, best = cell, clustered
            if count > _NEAR * most_faces:
                break
        cell *= np.sqrt(count / (0.97 * most_faces))
    return best if best is not None and len(best.faces) else mesh


def is_solid(mesh: Mesh) -> bool:
    """Return whether a mesh is closed with its faces outwards, so that no back face is visible from outside."""
    a, b, c = mesh.faces.T.astype(np.int64)
    starts, ends = np.concatenate([a, b, c]), np.concatenate([b, c, a])
    count = len(mesh.vertices)
    closed = np.isin(starts * count + ends, ends * count + starts).all()
    corners = mesh.vertices[mesh.faces]
    volume = np.linalg.det(corners - mesh.vertices.mean(axis=0)).sum()  # six times
    return bool(closed and volume > 0)


def _clustered(mesh: Mesh, cell_mm: float) -> Mesh:
    """Return the mesh with one vertex, the mean, per occupied cell."""
    cells = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell_mm).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    flat = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    _, owner, count = np.unique(flat, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(owner, column) / count for column in mesh.vertices.T], axis=1)
    colors = None
    if mesh.colors is not None:
        sums = [np.bincount(owner, column) / count for column in mesh.colors.T.astype(float)]
        colors = np.stack(sums, axis=1).round().astype(np.uint8)
    faces = owner[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    # Cyclic permutations of three vertices are the same face; flipped ones are its other side.
    first = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    return Mesh(means, np.unique(turned, axis=0), colors)
