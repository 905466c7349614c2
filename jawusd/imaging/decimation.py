"""Fewer faces, by quadric edge collapse, for what needs the surface's shape: solver steps, replays of reports.

The browser viewer has a simpler way of its own, since it is installed without pyfqmr.
"""

from __future__ import annotations

import numpy as np
import pyfqmr
from numpy.typing import NDArray

from jawusd.geometry.arrays import Array


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
    unique, index = np.unique(points, axis=0, return_inverse=True)
    index = index.reshape(-1).astype(np.int32)
    return np.ascontiguousarray(unique), np.ascontiguousarray(index[crowns]), np.ascontiguousarray(index[gum])
