"""Fewer faces, by quadric edge collapse, for what needs the surface's shape: solver steps, replays of reports.

The browser viewer has a simpler way of its own, since it is installed without pyfqmr.
"""

from __future__ import annotations

import numpy as np
import pyfqmr
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.formats.mesh import GUM, TOOTH, Mesh, crown_face_mask
from jawusd.geometry.points import welded
from jawusd.meshes.mesh_cleaning import manifold


def decimated(vertices: Array, faces: NDArray[np.int32], count: int) -> tuple[Array, NDArray[np.int32]]:
    """Return vertices (V', 3) and about `count` of the faces (F, 3) of a surface (V, 3); open borders stay in place.

    Quadric edge collapse (Garland & Heckbert 1997).
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
    """Return a mesh of about `count` faces, and one more for each edge of a border; crowns and gum stay apart.

    Borders, that between crown and gum among them, stay where they are. Labels say what is crown; colours and texture
    coordinates are left out.
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
    """Return a bone of about `count` faces as a manifold: where it is porous, collapsed edges pinch it."""
    return manifold(proxy_of(mesh, count))


def _border_edges(faces: NDArray[np.int32]) -> int:
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    numbers = edges[:, 0] * (edges.max(initial=0) + 1) + edges[:, 1]
    return int((np.unique(numbers, return_counts=True)[1] == 1).sum())


def decimated_scan(
    vertices: Array, crown_faces: NDArray[np.int32], gum_faces: NDArray[np.int32], crown_count: int
) -> tuple[Array, NDArray[np.int32], NDArray[np.int32]]:
    """Return vertices, about `crown_count` crown faces, and gum faces fewer by the same share.

    The line between crown and gum stays where it is.
    """
    share = crown_count / len(crown_faces)
    parts = [decimated(vertices, faces, int(share * len(faces))) for faces in (crown_faces, gum_faces)]
    points = np.concatenate([p for p, _ in parts])
    crowns, gum = parts[0][1], parts[1][1] + len(parts[0][0])
    # The border exists on both sides; merged, it is the crown-gum line again.
    places, index = welded(points)
    index = index.astype(np.int32)
    return places, np.ascontiguousarray(index[crowns]), np.ascontiguousarray(index[gum])
