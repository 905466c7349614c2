"""Bones as pipelines want them: points merged, faces wound alike, no edge with three faces, no pinched vertex."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jawusd.base.arrays import Array, Mask
from jawusd.formats.mesh import Mesh

# By how much the parts of a surface that meet in one point only are moved apart [mm]: validators take points at the
# very same place for a seam that somebody forgot to merge.
_APART_MM = 1e-3


def manifold(mesh: Mesh) -> Mesh:
    """Return a surface as a manifold, of the same shape but for what cannot be one.

    Points at the same place are merged, empty and repeated faces dropped; where more than two faces meet in an edge,
    the smallest ones go; linked faces are wound consistently; parts that touch only in a point get a point each.
    """
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    surface.merge_vertices()
    surface.update_faces(surface.unique_faces() & surface.nondegenerate_faces())
    while (surplus := _surplus_faces(surface)).any():
        surface.update_faces(~surplus)
    trimesh.repair.fix_winding(surface)
    vertices, faces = _unpinched(np.asarray(surface.vertices), np.asarray(surface.faces), surface)
    return Mesh(vertices, faces.astype(np.int32))


def _surplus_faces(surface: trimesh.Trimesh) -> Mask:
    """Return the smallest faces of every edge that has more than two, shape (F,)."""
    _, edge, count = np.unique(surface.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    owner = np.repeat(np.arange(len(surface.faces)), 3)
    out = np.zeros(len(surface.faces), dtype=bool)
    for k in np.flatnonzero(count > 2):
        around = owner[edge.reshape(-1) == k]
        out[around[np.argsort(surface.area_faces[around], kind="stable")][:-2]] = True
    return out


def _unpinched(vertices: Array, faces: NDArray[np.int64], surface: trimesh.Trimesh) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices and faces with a vertex of its own for every fan of faces around a point."""
    corners = np.arange(faces.size).reshape(faces.shape)
    linked = []
    for (a, b), edge in zip(surface.face_adjacency, surface.face_adjacency_edges, strict=True):
        linked += [(corners[a][faces[a] == v][0], corners[b][faces[b] == v][0]) for v in edge]
    rows, columns = np.array(linked, dtype=np.int64).reshape(-1, 2).T
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(faces.size, faces.size))
    count, fan = connected_components(links, directed=False)
    point = np.empty(count, dtype=np.int64)
    point[fan] = faces.ravel()
    out, split = vertices[point], fan.reshape(faces.shape)
    pinched = np.bincount(point, minlength=len(vertices))[point] > 1
    middle = np.zeros((count, 3))
    np.add.at(middle, split.ravel(), np.repeat(out[split].mean(1), 3, axis=0))
    away = middle / np.bincount(split.ravel(), minlength=count)[:, None] - out
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    out[pinched] += _APART_MM * away[pinched]
    return out, split
