"""Triangle mesh used by all layers, its crown faces and the colours of contacts, and files of the labels of scans.

Labels of crown, gum and base of a teeth scan are in an npz file beside the scan, format jawusd-scan-labels/1:

    labels (V,) uint8    0 gum, 1 crown, 2 crown at a border of interest, 3 base plate; in the order of the scan file
    meta                 JSON: scan_sha256 of the scan's vertices, source, weak_share

The hash identifies the version of the scan for which labels were made; they are rejected for any other version.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, FormatError
from jawusd.base.npz import read_npz, take
from jawusd.formats.atomic import write_described_npz

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
        shapes = {"colors": vertices.shape, "labels": vertices.shape[:1], "uv": (*faces.shape, 2)}
        for name, shape in shapes.items():
            if (value := getattr(self, name)) is not None and np.shape(value) != shape:
                raise ValueError(f"{name} must have shape {shape}, got {np.shape(value)}")
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


LABELS_FAMILY, LABELS_VERSION = "jawusd-scan-labels", 1
LABELS_SUFFIX = ".labels.npz"

LabelSource = Literal["automatic", "reviewed"]


@dataclass(frozen=True, eq=False)
class ScanLabels:
    """Crown, gum and base labels of one scan."""

    labels: NDArray[np.uint8]  # label of each vertex of the scan file, shape (V,)
    source: LabelSource  # "automatic" if derived from the shape, "reviewed" if accepted by a user
    weak_share: float = 0.0  # fraction of the crown-gum border with weak geometric evidence, 0 to 1


def labels_path(scan: Path, folder: Path | None = None) -> Path:
    """Return the path of the labels of a scan: beside the scan, or in a folder of labels."""
    return (scan.parent if folder is None else folder) / f"{scan.stem}{LABELS_SUFFIX}"


def scan_hash(mesh: Mesh) -> str:
    """Return the SHA-256 of the vertices of a scan, which identifies it in its labels."""
    return hashlib.sha256(mesh.vertices.tobytes()).hexdigest()


def save_scan_labels(path: AnyPath, labels: ScanLabels, mesh: Mesh) -> None:
    """Write the labels of a scan.

    Raises:
        ValueError: the number of labels differs from the number of vertices.
        OutputError: the file cannot be written.
    """
    if labels.labels.shape != mesh.vertices.shape[:1]:
        raise ValueError(f"labels must have shape ({len(mesh.vertices)},), got {labels.labels.shape}")
    meta = {"scan_sha256": scan_hash(mesh), "source": labels.source, "weak_share": labels.weak_share}
    arrays = {"labels": labels.labels.astype(np.uint8)}
    write_described_npz(path, f"{LABELS_FAMILY}/{LABELS_VERSION}", arrays, meta)


def load_scan_labels(path: AnyPath, mesh: Mesh) -> ScanLabels:
    """Read the labels of a scan.

    Raises:
        FormatError: the file does not contain labels, or they were made for another version of the scan.
        VersionError: the file was written by a newer version.
    """
    arrays, meta = read_npz(path, LABELS_FAMILY, LABELS_VERSION)
    labels = take(arrays, "labels", (None,), path)
    if meta.get("scan_sha256") != scan_hash(mesh) or len(labels) != len(mesh.vertices):
        raise FormatError(
            f"was made for another version of the scan ({len(labels)} vertices; the scan has {len(mesh.vertices)}).",
            path=path,
            hint="Create new labels with `jawusd scans --force`, or delete the file.",
        )
    if not np.isin(labels, range(BASE + 1)).all():
        raise FormatError(f'"labels" must be 0 to {BASE}, found {labels.max():g}.', path=path)
    source, weak = meta.get("source"), meta.get("weak_share", 0.0)
    if source != "automatic" and source != "reviewed":
        raise FormatError(f'source is "{source}"; it must be "automatic" or "reviewed".', path=path)
    if isinstance(weak, bool) or not isinstance(weak, int | float) or not 0 <= weak <= 1:
        raise FormatError(f'weak_share is "{weak}"; it must be a number from 0 to 1.', path=path)
    return ScanLabels(labels.astype(np.uint8), source, float(weak))
