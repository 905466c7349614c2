"""Read scans and bones from PLY, STL and OBJ, and scans from 3Shape DCM."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from jawusd.errors import CaptureError, explain_missing_packages
from jawusd.formats.file_kinds import MESHES
from jawusd.formats.mesh import Mesh, tooth_labels
from jawusd.geometry.arrays import Array
from jawusd.geometry.welding import welded
from jawusd.inputs import check_input, why_unreadable

# People who read scans with this module label them next; scripts outside the package import both from here.
__all__ = ["Winding", "load_mesh", "tooth_labels", "winding"]

_NO_FACES = "Export the surface, not a point cloud, under a name that says its format."
# Diagonal of the bounding box [mm]: smallest, typical, largest. A full arch has about 80, a mandible 165, a skull 290.
_DIAGONAL_MM = {"scan": (20.0, 80.0, 150.0), "bone": (50.0, 200.0, 500.0)}
_NO_COLOUR = 128  # gray, where a texture says nothing
_UNITS_MM = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4, "micrometres": 0.001}


def load_mesh(path: str | os.PathLike[str], kind: Literal["scan", "bone"] = "scan") -> Mesh:
    """Read a triangle mesh [mm] from PLY, STL, OBJ or 3Shape DCM, its vertices in the order of the file.

    Larger polygons are cut into triangles; STL files, which share no vertices, give three per triangle. Materials and
    textures are not read, the places of corners in a texture are, of OBJ and PLY. A closed mesh that is inside out has
    its triangles turned; open ones stay as they are. The kind, teeth scan or bone, sets which sizes are accepted.

    Raises:
        CaptureError: the file is missing or damaged, holds no triangles or coordinates that are not finite, or is of
            a size that cannot be in mm.
        MissingDependencyError: the mesh is a DCM file and open3sdcm is not installed.
    """
    path = Path(path)
    check_input(path, CaptureError)
    if path.suffix.lower() not in MESHES:
        raise CaptureError(f"meshes are read from {', '.join(MESHES)} files.", path=path, hint="Convert the mesh.")
    if path.suffix.lower() == ".dcm":
        return _checked(path, *_read_dcm(path), kind)
    try:
        loaded = _parsed(path, maintain_order=True)
        uv = _corner_uv(path, loaded)
    except FileNotFoundError as error:
        raise CaptureError("no such mesh.", path=path, hint="Check the path in capture.toml.") from error
    except Exception as error:  # trimesh reports damaged files by whatever its parsers stumble over
        said, hint = why_unreadable(path) or (f"the mesh cannot be read ({error}).", "Export it again.")
        raise CaptureError(said, path=path, hint=hint) from error
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise CaptureError("the file holds no triangles.", path=path, hint=_NO_FACES)
    if np.shape(loaded.vertices)[1:] != (3,) or np.shape(loaded.faces)[1:] != (3,):
        raise CaptureError("its vertices do not have three coordinates each.", path=path, hint="Export it again.")
    return _checked(path, np.asarray(loaded.vertices), np.asarray(loaded.faces), _vertex_colors(loaded), kind, uv)


def _parsed(path: Path, *, maintain_order: bool) -> trimesh.Trimesh:
    # As a stream and not by name, so that no file named inside (materials, textures) is opened.
    with open(path, "rb") as stream:
        return trimesh.load_mesh(
            stream, file_type=path.suffix[1:].lower(), process=False, maintain_order=maintain_order, skip_materials=True
        )


def _vertex_colors(loaded: trimesh.Trimesh) -> NDArray[np.uint8] | None:
    visual = loaded.visual
    if isinstance(visual, trimesh.visual.ColorVisuals) and visual.kind == "vertex":
        return np.asarray(visual.vertex_colors[:, :3], dtype=np.uint8)
    # beside texture coordinates, the colours of an OBJ are left as numbers
    beside = np.asarray(loaded.vertex_attributes.get("color", ()))
    if len(beside) != len(loaded.vertices) or beside.shape[1:] not in ((3,), (4,)):
        return None
    return np.asarray(trimesh.visual.to_rgba(beside)[:, :3], dtype=np.uint8)


def _corner_uv(path: Path, loaded: trimesh.Trimesh) -> Array | None:
    """Return the places of the corners of all faces in a texture, shape (F, 3, 2); None where not all have one.

    A point on a seam has several. Read in the order of the file it keeps one of them, so the file is read once more
    with a vertex for each.
    """
    if not isinstance(loaded, trimesh.Trimesh) or not isinstance(loaded.visual, trimesh.visual.TextureVisuals):
        return None
    split = _parsed(path, maintain_order=False) if path.suffix.lower() == ".obj" else loaded
    found = getattr(split.visual, "uv", None)
    if found is None or split.faces.shape != loaded.faces.shape:
        return None
    if not np.array_equal(split.vertices[split.faces], loaded.vertices[loaded.faces]):
        return None
    uv = np.asarray(found, dtype=np.float64)[split.faces]
    return uv if uv.shape[2:] == (2,) and np.isfinite(uv).all() else None


@explain_missing_packages("dcm")
def _read_dcm(path: Path) -> tuple[Array, NDArray[np.int64], NDArray[np.uint8] | None]:
    """Return vertices, faces, and colours from the texture or None.

    Raises:
        CaptureError: the file is missing or damaged.
    """
    import open3sdcm

    if not path.is_file():
        raise CaptureError("no such mesh.", path=path, hint="Check the path in capture.toml.")
    try:
        found = open3sdcm.load(str(path))
        vertices, faces = np.array(found.vertices, np.float64), np.array(found.faces).astype(np.int64)
        texture, corners = found.texture, found.uv
    except Exception as error:  # its parser reports damaged and encrypted files by exceptions of its own
        raise CaptureError(f"the mesh cannot be read ({error}).", path=path, hint="Export it as PLY or STL.") from error
    if len(faces) == 0:
        raise CaptureError("the file holds no triangles.", path=path, hint="Export the surface again.")
    return vertices, faces, _texture_colors(texture, corners, faces, len(vertices))


def _texture_colors(
    texture: bytes | None, corners: Array | None, faces: NDArray[np.int64], count: int
) -> NDArray[np.uint8] | None:
    """Return the colour of every vertex: of a texture (JPEG) at its last corner's place (u to the right, v upwards)."""
    if texture is None or corners is None or len(corners) != faces.size:
        return None
    image = cv2.imdecode(np.frombuffer(texture, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return None
    known = np.isfinite(corners).all(axis=1)
    height, width = image.shape[:2]
    place = np.clip(corners[known], 0.0, 1.0) * [width - 1, height - 1]
    column, row = place[:, 0].astype(np.int64), height - 1 - place[:, 1].astype(np.int64)
    colors = np.full((count, 3), _NO_COLOUR, np.uint8)
    colors[faces.ravel()[known]] = image[row, column, ::-1]
    return colors


def _checked(
    path: Path,
    vertices: Array,
    faces: NDArray[np.int64],
    colors: NDArray[np.uint8] | None,
    kind: str,
    uv: Array | None = None,
) -> Mesh:
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if bad.size:
        raise CaptureError(
            f"vertex {bad[0]} has a coordinate that is not finite ({bad.size} such vertices).",
            path=path,
            hint="Export the mesh again.",
        )
    outside = np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))
    if outside.size:
        raise CaptureError(
            f"triangle {outside[0]} names a vertex that does not exist; there are {len(vertices)}.",
            path=path,
            hint="Export the mesh again.",
        )
    low, typical, high = _DIAGONAL_MM[kind]
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not low <= diagonal <= high:
        fitting = {unit: abs(math.log(diagonal * mm / typical)) for unit, mm in _UNITS_MM.items() if diagonal > 0}
        unit = min(fitting, key=fitting.__getitem__) if fitting else ""
        guess = f" It looks like {unit}." if fitting and low <= diagonal * _UNITS_MM[unit] <= high else ""
        raise CaptureError(
            f"the mesh is {diagonal:.4g} mm across its bounding box, a {kind} has {low:g} to {high:g} mm.{guess}",
            path=path,
            hint="Lengths must be in mm: scale the mesh and export it again.",
        )
    mesh = Mesh(vertices.astype(np.float64), faces.astype(np.int32), colors, uv=uv)
    turned = winding(mesh)
    if turned.closed and not turned.outward:
        return Mesh(mesh.vertices, mesh.faces[:, ::-1], colors, uv=None if uv is None else uv[:, ::-1])
    return mesh


class Winding(NamedTuple):
    """Say how the triangles of a mesh are turned."""

    closed: bool  # every edge is shared by exactly two triangles that run along it in opposite directions
    outward: bool  # triangles are counter-clockwise seen from outside; a strong hint only, unless the mesh is closed
    volume_mm3: float  # signed volume, positive if outward


def winding(mesh: Mesh) -> Winding:
    """Find out whether a mesh is closed and which way its triangles are turned.

    The signed volume is the sum of the tetrahedra over the triangles with the centroid as apex (C. Zhang, T. Chen,
    "Efficient feature extraction for 2D/3D objects in mesh representation", ICIP 2001). Vertices at the same place
    count as one.
    """
    places, index = welded(mesh.vertices)
    faces = index[mesh.faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = np.sort(edges[:, 0] * len(places) + edges[:, 1])
    back = np.sort(edges[:, 1] * len(places) + edges[:, 0])
    closed = bool((there[1:] != there[:-1]).all() and (there == back).all())
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - mesh.vertices.mean(axis=0), 1, 0)
    volume = float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)
    return Winding(closed, volume > 0, volume)
