"""Triangle mesh used by all layers, its crown faces, and the colours of contacts between teeth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask

GUM, TOOTH, BOUNDARY, BASE = 0, 1, 2, 3

# Minimum difference of red or green from the other channels (of 255) in a painted label. Pure red has 255; gum in
# photographic textures, such as (200, 110, 110), has less than 100.
_PAINT_CONTRAST = 100
_FEWEST_PAINTED = 0.01  # minimum fraction of red or green vertices for a scan to count as painted


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh, optionally with colours, labels and texture coordinates."""

    vertices: Array  # vertex positions [mm], shape (V, 3), float64
    faces: NDArray[np.int32]  # vertex indices, counter-clockwise seen from outside, shape (F, 3), int32
    colors: NDArray[np.uint8] | None = None  # red, green and blue of each vertex, shape (V, 3), uint8, or None
    # Labels of a teeth scan that are not painted: GUM, TOOTH, BOUNDARY or BASE for each vertex, shape (V,), uint8.
    labels: NDArray[np.uint8] | None = None
    # texture coordinates of face corners, u to the right, v upwards, shape (F, 3, 2), float64, or None
    uv: Array | None = None

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int32)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"a mesh needs vertices (V, 3) and faces (F, 3), got {vertices.shape} and {faces.shape}")
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ValueError(f"faces refer to vertex {faces.max()}, but the mesh has {len(vertices)} vertices")
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
    """Return vertices (V, 3) and colours after moving unused vertices onto used ones, evenly distributed.

    Indices of picked vertices stay valid, and unused vertices do not affect sizes, centres and labels.
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
    """Return GUM, TOOTH or BOUNDARY for each vertex of a painted teeth scan, shape (V,); None if it is not painted.

    Red vertices are teeth, green ones are teeth at a border of interest (the incisal edge), others are gum. A scan with
    very few red or green vertices counts as not painted.
    """
    if mesh.colors is None:
        return None
    labels = np.full(len(mesh.vertices), GUM, np.uint8)
    red, green, blue = mesh.colors.astype(np.int16).T
    labels[red - np.maximum(green, blue) > _PAINT_CONTRAST] = TOOTH
    labels[green - np.maximum(red, blue) > _PAINT_CONTRAST] = BOUNDARY
    return labels if np.count_nonzero(labels) >= max(_FEWEST_PAINTED * len(labels), 1) else None


def natural_colors(mesh: Mesh) -> NDArray[np.uint8] | None:
    """Return the natural vertex colours of a scan, shape (V, 3); None if they are painted, uniform or missing."""
    if mesh.colors is None or painted_labels(mesh) is not None or (mesh.colors == mesh.colors[:1]).all():
        return None
    return mesh.colors


def tooth_labels(mesh: Mesh) -> NDArray[np.uint8]:
    """Return GUM, TOOTH or BOUNDARY for each vertex of a teeth scan, shape (V,); tooth labels are > 0.

    The labels are those of the mesh, with the base as gum, or painted ones; without labels, every vertex is TOOTH.
    """
    if mesh.labels is not None:
        return np.where(mesh.labels == BASE, GUM, mesh.labels).astype(np.uint8)
    painted = painted_labels(mesh)
    return np.full(len(mesh.vertices), TOOTH, np.uint8) if painted is None else painted


def crown_face_mask(mesh: Mesh) -> Mask:
    """Return which faces of a teeth scan are crown, shape (F,): those with two or three tooth vertices."""
    return (tooth_labels(mesh) != GUM)[mesh.faces].sum(axis=1) >= 2


class Mark(NamedTuple):
    """Colour in contact images, for a range of distances."""

    color: tuple[int, int, int]  # red, green and blue, 0 to 255
    meaning: str
    apart_mm: float  # maximum distance with this colour; negative for penetration deeper than in occlusion


DEEP = Mark((120, 40, 200), "deeper than in occlusion", -0.15)
TOUCHING = (
    Mark((200, 20, 30), "touching", 0.05),
    Mark((240, 120, 30), "within 0.2 mm", 0.2),
    Mark((250, 205, 70), "within 0.5 mm", 0.5),
)
