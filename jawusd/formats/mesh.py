"""A triangle mesh as the layers exchange it, and which of its faces are painted as crowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.geometry.arrays import Array, Mask

GUM, TOOTH, BOUNDARY = 0, 1, 2

# How far red or green must exceed the other channels (of 255) to be a label: painted labels exceed them by more (pure
# red by 255), the gum of photographic scan textures, such as (200, 110, 110), by less.
_PAINT_CONTRAST = 100
_FEWEST_PAINTED = 0.01  # share of the vertices; a handful of reddish ones is not a labelling


@dataclass(frozen=True, eq=False)
class Mesh:
    """Hold a triangle mesh."""

    vertices: Array  # positions [mm], shape (V, 3), float64
    faces: NDArray[np.int32]  # vertex indices, counter-clockwise seen from outside, shape (F, 3), int32
    colors: NDArray[np.uint8] | None = None  # red, green, blue per vertex, shape (V, 3), uint8, or None

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


def tooth_labels(mesh: Mesh) -> NDArray[np.uint8]:
    """Return GUM, TOOTH or BOUNDARY per vertex of a teeth scan, shape (V,); everything that is tooth is > 0.

    Red vertices are teeth, green ones teeth whose border is of interest (the incisal edge), all others gum. A scan
    without colours, or with hardly any red or green, counts as teeth all over.
    """
    labels = np.full(len(mesh.vertices), GUM, np.uint8)
    if mesh.colors is not None:
        red, green, blue = mesh.colors.astype(np.int16).T
        labels[red - np.maximum(green, blue) > _PAINT_CONTRAST] = TOOTH
        labels[green - np.maximum(red, blue) > _PAINT_CONTRAST] = BOUNDARY
    if np.count_nonzero(labels) < _FEWEST_PAINTED * len(labels) or mesh.colors is None:
        labels[:] = TOOTH
    return labels


def crown_face_mask(mesh: Mesh) -> Mask:
    """Return which faces of a teeth scan belong to crowns, shape (F,): those with two or three tooth corners."""
    return (tooth_labels(mesh) != GUM)[mesh.faces].sum(axis=1) >= 2
