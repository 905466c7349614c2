"""A triangle mesh as the layers exchange it, its crown faces, and the colours of contacts between teeth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask

GUM, TOOTH, BOUNDARY, BASE = 0, 1, 2, 3

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
    # of a teeth scan, if known otherwise than by its paint: GUM, TOOTH, BOUNDARY or BASE per vertex, shape (V,), uint8
    labels: NDArray[np.uint8] | None = None
    # places of the corners of every face in a picture, u to the right, v upwards, shape (F, 3, 2), float64, or None
    uv: Array | None = None

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int32)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"a mesh needs vertices (V, 3) and faces (F, 3), got {vertices.shape} and {faces.shape}")
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ValueError(f"faces index vertex {faces.max()} of {len(vertices)}")
        if self.colors is not None and np.shape(self.colors) != vertices.shape:
            raise ValueError(f"colors must have shape {vertices.shape}, got {np.shape(self.colors)}")
        if self.labels is not None and np.shape(self.labels) != vertices.shape[:1]:
            raise ValueError(f"labels must have shape {vertices.shape[:1]}, got {np.shape(self.labels)}")
        if self.uv is not None and np.shape(self.uv) != (*faces.shape, 2):
            raise ValueError(f"uv must have shape {(*faces.shape, 2)}, got {np.shape(self.uv)}")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)


def without_loose(
    vertices: Array, faces: NDArray[np.int64] | NDArray[np.int32], colors: NDArray[np.uint8] | None
) -> tuple[Array, NDArray[np.uint8] | None]:
    """Return vertices (V, 3) and colours with those that no face uses moved onto others, spread over all of them.

    So they keep their numbers, which picks name, and neither sizes nor middles nor labels count them.
    """
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    loose, kept = np.flatnonzero(~used), np.flatnonzero(used)
    if not loose.size or not kept.size:
        return vertices, colors
    source = np.arange(len(vertices))
    source[loose] = kept[(2 * np.arange(len(loose)) + 1) * len(kept) // (2 * len(loose))]
    return vertices[source], None if colors is None else colors[source]


def painted_labels(mesh: Mesh) -> NDArray[np.uint8] | None:
    """Return GUM, TOOTH or BOUNDARY per vertex of a painted teeth scan, shape (V,); None where it is not painted.

    Red vertices are teeth, green ones teeth whose border is of interest (the incisal edge), all others gum. Hardly any
    red or green is no paint.
    """
    if mesh.colors is None:
        return None
    labels = np.full(len(mesh.vertices), GUM, np.uint8)
    red, green, blue = mesh.colors.astype(np.int16).T
    labels[red - np.maximum(green, blue) > _PAINT_CONTRAST] = TOOTH
    labels[green - np.maximum(red, blue) > _PAINT_CONTRAST] = BOUNDARY
    return labels if np.count_nonzero(labels) >= max(_FEWEST_PAINTED * len(labels), 1) else None


def natural_colors(mesh: Mesh) -> NDArray[np.uint8] | None:
    """Return colours that show how a scan looks, shape (V, 3); None for paint, one colour all over, and no colours."""
    if mesh.colors is None or painted_labels(mesh) is not None or (mesh.colors == mesh.colors[:1]).all():
        return None
    return mesh.colors


def tooth_labels(mesh: Mesh) -> NDArray[np.uint8]:
    """Return GUM, TOOTH or BOUNDARY per vertex of a teeth scan, shape (V,); everything that is tooth is > 0.

    These are the mesh's labels, its base counted as gum; without labels its paint; without either, all is tooth.
    """
    if mesh.labels is not None:
        return np.where(mesh.labels == BASE, GUM, mesh.labels).astype(np.uint8)
    painted = painted_labels(mesh)
    return np.full(len(mesh.vertices), TOOTH, np.uint8) if painted is None else painted


def crown_face_mask(mesh: Mesh) -> Mask:
    """Return which faces of a teeth scan belong to crowns, shape (F,): those with two or three tooth corners."""
    return (tooth_labels(mesh) != GUM)[mesh.faces].sum(axis=1) >= 2


class Mark(NamedTuple):
    """Say what a colour means."""

    color: tuple[int, int, int]  # red, green, blue, 0 to 255
    meaning: str
    apart_mm: float  # surfaces nearer than this have it; of teeth that run too deep, beyond the closed bite


DEEP = Mark((120, 40, 200), "deeper than in the closed bite", -0.15)
TOUCHING = (
    Mark((200, 20, 30), "touching", 0.05),
    Mark((240, 120, 30), "within 0.2 mm", 0.2),
    Mark((250, 205, 70), "within 0.5 mm", 0.5),
)
