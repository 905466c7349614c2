"""Triangle mesh used by all layers, its crown faces and the colours of contacts; common parts of the mesh readers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import CaptureError

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
    """Return vertices (V, 3) and colours with unused vertices moved onto used ones; picked indices stay valid."""
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
    """Return GUM (or base), TOOTH or BOUNDARY per vertex of a teeth scan, shape (V,); all TOOTH without labels."""
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


Indices = NDArray[np.int64]

MOST_BYTES = 4 << 30
MOST_TRIANGLES, MOST_VERTICES = 10_000_000, 30_000_000
NO_COLOUR = 128  # gray, the colour of vertices without a colour

COPY_AGAIN = "Copy the file again from its source, or export it again."


class MeshData(NamedTuple):
    """Mesh as read from a file."""

    vertices: Array  # vertex positions, shape (V, 3)
    faces: Indices  # vertex indices of triangles, shape (F, 3); they may exceed the number of vertices
    colors: NDArray[np.uint8] | None = None  # red, green and blue of each vertex, shape (V, 3)
    uv: Array | None = None  # texture coordinates of the triangle corners, shape (F, 3, 2)


def read_mesh_bytes(path: Path) -> bytes:
    """Return the content of a mesh file.

    Raises:
        CaptureError: the file is larger than MOST_BYTES.
        OSError: the file cannot be read.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise CaptureError(
            f"is {size:,} bytes long; at most {MOST_BYTES:,} bytes are allowed.", hint="Decimate the mesh."
        )
    return path.read_bytes()


def check_count(count: int, what: str) -> None:
    """Check the number of "vertices", "triangles" or "faces" of a file before reading them.

    Raises:
        CaptureError: the number is too large.
    """
    most = MOST_VERTICES if what == "vertices" else MOST_TRIANGLES
    if count > most:
        raise CaptureError(f"has {count:,} {what}; at most {most:,} are allowed.", hint="Decimate the mesh.")


def cut_off(found: int, said: int, what: str) -> CaptureError:
    """Return the error for a truncated file."""
    return CaptureError(f"is truncated: it has {found} of {said} {what}.", hint=COPY_AGAIN)


def byte_colors(values: Array) -> NDArray[np.uint8] | None:
    """Convert colours (n, 3) of 0 to 1, 0 to 255 or 0 to 65535 to bytes, NaN to gray; None for negative values."""
    top = np.nanmax(values, initial=0.0)
    if np.nanmin(values, initial=0.0) < 0 or top > 65535:
        return None  # negative values are not colours but, for example, normals
    scale = 255.0 if top <= 1 else 1.0 if top <= 255 else 1 / 257
    return np.where(np.isfinite(values), np.round(values * scale), NO_COLOUR).astype(np.uint8)


def cut_polygons(vertices: Array, counts: Indices, corners: Indices) -> tuple[Indices, Indices]:
    """Triangulate polygons as fans: return the positions (F, 3) of corners in `corners`, and vertices (F, 3).

    A fan starts at the first corner from which all triangles face the same way as the polygon, so that concave quads
    are correct; polygons with fewer than three corners are dropped. `counts` (P,) are the numbers of corners of each
    polygon, `corners` (C,) the vertex indices of all.
    """
    starts = np.cumsum(counts) - counts
    triangles, owners = [], []
    for n in np.unique(counts[counts >= 3]):
        owner = np.flatnonzero(counts == n)
        places = starts[owner, None] + np.arange(n)
        if n > 3:
            places = np.take_along_axis(places, _fan_starts(vertices, corners[places]), axis=1)
        fan = np.stack([np.zeros(n - 2, np.int64), np.arange(1, n - 1), np.arange(2, n)], axis=1)
        triangles.append(places[:, fan].reshape(-1, 3))
        owners.append(np.repeat(owner, n - 2))
    if not triangles:
        return np.zeros((0, 3), np.int64), np.zeros((0, 3), np.int64)
    order = np.argsort(np.concatenate(owners), kind="stable")
    found = np.concatenate(triangles)[order]
    return found, corners[found]


def _fan_starts(vertices: Array, polygons: Indices) -> Indices:
    """Return the corner order of each polygon (m, n), rotated to start at a valid fan apex, shape (m, n)."""
    m, n = polygons.shape
    turns = (np.arange(n)[:, None] + np.arange(n)) % n  # row k has all corners, beginning with corner k
    chosen = np.zeros(m, np.int64)
    points = vertices[np.clip(polygons, 0, len(vertices) - 1)]
    open_ones = np.ones(m, bool)
    with np.errstate(invalid="ignore", over="ignore"):
        normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
        for k in range(n):
            around = points[:, turns[k]]
            sides = around[:, 1:] - around[:, :1]
            facing = np.einsum("mti,mi->mt", np.cross(sides[:, :-1], sides[:, 1:]), normal)
            fits = open_ones & (facing >= 0).all(axis=1)
            chosen[fits], open_ones = k, open_ones & ~fits
            if not open_ones.any():
                break
    return turns[chosen]
