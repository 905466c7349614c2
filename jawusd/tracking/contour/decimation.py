"""Fewer faces for the steps in which a dense scan says no more than a thin one."""

from __future__ import annotations

import numpy as np
import pyfqmr
from numpy.typing import NDArray

from jawusd.geometry.arrays import Array


def thinned(
    vertices: Array, crown_faces: NDArray[np.int32], gum_faces: NDArray[np.int32], crown_count: int
) -> tuple[Array, NDArray[np.int32], NDArray[np.int32]]:
    """Return crowns and gum with about so many crown faces, and gum thinned alike.

    Quadric edge collapse (Garland & Heckbert 1997); the line between crown and gum stays where it is.

    Args:
        vertices: [mm], shape (V, 3).
        crown_faces, gum_faces: shapes (F, 3) and (G, 3).
        crown_count: crown faces wanted.

    Returns:
        Vertices, crown faces, gum faces.
    """
    share = crown_count / len(crown_faces)
    parts = [_collapsed(vertices, faces, int(share * len(faces))) for faces in (crown_faces, gum_faces)]
    points = np.concatenate([p for p, _ in parts])
    crowns, gum = parts[0][1], parts[1][1] + len(parts[0][0])
    # The border exists on both sides; merged, it is the crown-gum line again.
    unique, index = np.unique(points, axis=0, return_inverse=True)
    index = index.reshape(-1).astype(np.int32)
    return np.ascontiguousarray(unique), np.ascontiguousarray(index[crowns]), np.ascontiguousarray(index[gum])


def _collapsed(vertices: NDArray, faces: NDArray[np.int32], count: int) -> tuple[NDArray, NDArray[np.int32]]:
    if not len(faces):
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    used, index = np.unique(faces, return_inverse=True)
    simplifier = pyfqmr.Simplify()
    simplifier.setMesh(np.ascontiguousarray(vertices[used]), np.ascontiguousarray(index.reshape(-1, 3), np.int32))
    simplifier.simplify_mesh(target_count=count, preserve_border=True, verbose=False)
    points, kept, _ = simplifier.getMesh()
    return np.asarray(points, np.float64), np.asarray(kept, np.int32)
