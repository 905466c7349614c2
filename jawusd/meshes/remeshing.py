"""Simplify and repair surfaces: decimation by quadric edge collapse, and repair of bones to manifolds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyfqmr
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jawusd.base.arrays import Array, Mask
from jawusd.formats.mesh import GUM, TOOTH, Mesh, crown_face_mask
from jawusd.geometry.points import welded

if TYPE_CHECKING:
    import trimesh

# Offset [mm] by which parts of a surface that touch in a single point are separated; validators report coincident
# points as unmerged seams.
_APART_MM = 1e-3


def decimated(vertices: Array, faces: NDArray[np.int32], count: int) -> tuple[Array, NDArray[np.int32]]:
    """Decimate a surface (V, 3), (F, 3) to about `count` faces; return vertices (V', 3) and faces (F', 3).

    The method is quadric edge collapse (Garland & Heckbert 1997). Open borders are preserved.
    """
    if not len(faces):
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    used, index = np.unique(faces, return_inverse=True)
    simplifier = pyfqmr.Simplify()
    simplifier.setMesh(np.ascontiguousarray(vertices[used]), np.ascontiguousarray(index.reshape(-1, 3), np.int32))
    simplifier.simplify_mesh(target_count=count, preserve_border=True, verbose=False)
    points, kept, _ = simplifier.getMesh()
    return np.asarray(points, np.float64), np.asarray(kept, np.int32)


def proxy_of(mesh: Mesh, count: int) -> Mesh:
    """Return a scan decimated to about `count` faces, plus one per border edge, with labels of crown and gum only.

    Borders are preserved, including the one between crown and gum.
    """
    crown = crown_face_mask(mesh)
    parts = []
    for faces, label in ((mesh.faces[crown], TOOTH), (mesh.faces[~crown], GUM)):
        share = int(count * len(faces) / max(len(mesh.faces), count))
        points, kept = decimated(mesh.vertices, faces, min(share + _border_edges(faces), len(faces)))
        parts.append((points, kept, np.full(len(points), label, np.uint8)))
    (crowns, first, tooth), (gums, second, gum) = parts
    faces = np.concatenate([first, second + np.int32(len(crowns))])
    return Mesh(np.concatenate([crowns, gums]), faces, labels=np.concatenate([tooth, gum]))


def bone_proxy_of(mesh: Mesh, count: int) -> Mesh:
    """Return a bone decimated to about `count` faces by edge collapse, then repaired to be manifold."""
    return manifold(proxy_of(mesh, count))


def _border_edges(faces: NDArray[np.int32]) -> int:
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    numbers = edges[:, 0] * (edges.max(initial=0) + 1) + edges[:, 1]
    return int((np.unique(numbers, return_counts=True)[1] == 1).sum())


def decimated_scan(
    vertices: Array, crown_faces: NDArray[np.int32], gum_faces: NDArray[np.int32], crown_count: int
) -> tuple[Array, NDArray[np.int32], NDArray[np.int32]]:
    """Return vertices, about `crown_count` crown faces, and gum faces reduced by the same ratio.

    The border between crown and gum is preserved.
    """
    share = crown_count / len(crown_faces)
    parts = [decimated(vertices, faces, int(share * len(faces))) for faces in (crown_faces, gum_faces)]
    points = np.concatenate([p for p, _ in parts])
    crowns, gum = parts[0][1], parts[1][1] + len(parts[0][0])
    # The points of the crown-gum line exist in both parts; merge them.
    places, index = welded(points)
    index = index.astype(np.int32)
    return places, np.ascontiguousarray(index[crowns]), np.ascontiguousarray(index[gum])


def manifold(mesh: Mesh) -> Mesh:
    """Return a surface repaired to be manifold.

    Coincident points are merged, degenerate and duplicate faces dropped; at edges with more than two faces, only the
    two largest faces are kept; connected faces are wound consistently; parts that touch in one point are separated.
    """
    import trimesh  # takes half a second, and is needed when rigs are baked only

    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    surface.merge_vertices()
    surface.update_faces(surface.unique_faces() & surface.nondegenerate_faces())
    while (surplus := _surplus_faces(surface)).any():
        surface.update_faces(~surplus)
    trimesh.repair.fix_winding(surface)
    vertices, faces = _unpinched(np.asarray(surface.vertices), np.asarray(surface.faces), surface)
    return Mesh(vertices, faces.astype(np.int32))


def _surplus_faces(surface: trimesh.Trimesh) -> Mask:
    """Return the mask of faces that at one of their edges are not among the two largest faces, shape (F,)."""
    _, edge, count = np.unique(surface.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    owner = np.repeat(np.arange(len(surface.faces)), 3)
    out = np.zeros(len(surface.faces), dtype=bool)
    for k in np.flatnonzero(count > 2):
        around = owner[edge.reshape(-1) == k]
        out[around[np.argsort(surface.area_faces[around], kind="stable")][:-2]] = True
    return out


def _unpinched(vertices: Array, faces: NDArray[np.int64], surface: trimesh.Trimesh) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices and faces with a separate vertex for every fan of faces around a point."""
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
