"""A triangle mesh as the layers exchange it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.geometry.arrays import Array


@dataclass(frozen=True, eq=False)
class Mesh:
    """Hold a triangle mesh.

    Attributes:
        vertices: positions [mm], shape (V, 3), float64.
        faces: vertex indices, counter-clockwise seen from outside, shape (F, 3), int32.
        colors: red, green, blue per vertex, shape (V, 3), uint8, or None.
    """

    vertices: Array
    faces: NDArray[np.int32]
    colors: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int32)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"a mesh needs vertices (V, 3) and faces (F, 3), got {vertices.shape} and {faces.shape}")
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ValueError(f"faces index vertex {faces.max()} of {len(vertices)}")
        if self.colors is not None and np.shape(self.colors) != vertices.shape:
            raise ValueError(f"colors must have shape {vertices.shape}, got {np.shape(self.colors)}")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
