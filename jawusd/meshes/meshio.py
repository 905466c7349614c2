"""Read scans and bones from PLY, STL and OBJ, and scans from 3Shape DCM."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, CaptureError, errors_name_file, explain_missing_packages
from jawusd.base.inputs import check_input, why_unreadable
from jawusd.formats.file_names import MESHES
from jawusd.formats.mesh import Mesh, tooth_labels, without_loose
from jawusd.formats.mesh_ply import read_ply
from jawusd.formats.mesh_reading import NO_COLOUR, MeshData, read_obj, read_stl
from jawusd.geometry.points import welded

# Winding, tooth_labels and winding are re-exported for scripts that read and label scans.
__all__ = ["Winding", "load_mesh", "tooth_labels", "winding"]

_NO_FACES = "Export the surface, not a point cloud, with the suffix of its format."
# Bounding box diagonal of each kind of mesh [mm]: minimum, typical value, maximum. A scan of a full arch measures about
# 80 mm, a mandible 165 mm, a skull 290 mm.
_DIAGONAL_MM = {"scan": (20.0, 80.0, 150.0), "bone": (50.0, 200.0, 500.0)}
_UNITS_MM = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4, "micrometres": 0.001}


@errors_name_file
@np.errstate(invalid="ignore", over="ignore")  # non-finite vertices are reported later, if a face uses them
def load_mesh(path: AnyPath, kind: Literal["scan", "bone"] = "scan") -> Mesh:
    """Read a triangle mesh [mm] from PLY, STL, OBJ or 3Shape DCM; vertices keep the order of the file.

    Polygons are triangulated; STL files give three vertices per triangle. Texture coordinates are read from OBJ and
    PLY; materials and textures are ignored. Closed meshes that are inside out are flipped. Unused vertices keep their
    index but move to the position of a used one. `kind` determines the accepted sizes.

    Raises:
        CaptureError: the file is missing, damaged, truncated or too large, has no triangles or non-finite coordinates,
            or has a size that cannot be in mm.
        MissingDependencyError: the mesh is a DCM file and open3sdcm is not installed.
    """
    path = Path(path)
    check_input(path, CaptureError)
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise CaptureError(f"is not a supported mesh file; expected {', '.join(MESHES)}.", hint="Convert the mesh.")
    try:
        if (said := why_unreadable(path)) is not None:
            raise CaptureError(said[0], hint=said[1])
        data = read(path)
    except FileNotFoundError as error:
        raise CaptureError("there is no such mesh file.", hint="Check the path in capture.toml.") from error
    except (OSError, ValueError, OverflowError) as error:
        raise CaptureError(f"the mesh cannot be read ({error}).", hint="Export it again.") from error
    if len(data.faces) == 0:
        raise CaptureError("the file has no triangles.", hint=_NO_FACES)
    return _checked(data, kind)


@explain_missing_packages("dcm")
def _read_dcm(path: Path) -> MeshData:
    """Read a 3Shape DCM scan; vertex colours come from its texture."""
    import open3sdcm

    try:
        found = open3sdcm.load(str(path))
        vertices, faces = np.array(found.vertices, np.float64), np.array(found.faces).astype(np.int64)
        texture, corners = found.texture, found.uv
    except Exception as error:  # open3sdcm raises exceptions of its own for damaged and encrypted files
        raise CaptureError(f"the mesh cannot be read ({error}).", hint="Export it as PLY or STL.") from error
    return MeshData(vertices, faces, _texture_colors(texture, corners, faces, len(vertices)))


_READERS = {".ply": read_ply, ".stl": read_stl, ".obj": read_obj, ".dcm": _read_dcm}


def _texture_colors(
    texture: bytes | None, corners: Array | None, faces: NDArray[np.int64], count: int
) -> NDArray[np.uint8] | None:
    """Return vertex colours, sampled from a JPEG texture at the last texture coordinates (v up) of each vertex."""
    if texture is None or corners is None or len(corners) != faces.size:
        return None
    image = cv2.imdecode(np.frombuffer(texture, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return None
    known = np.isfinite(corners).all(axis=1)
    height, width = image.shape[:2]
    place = np.clip(corners[known], 0.0, 1.0) * [width - 1, height - 1]
    column, row = place[:, 0].astype(np.int64), height - 1 - place[:, 1].astype(np.int64)
    colors = np.full((count, 3), NO_COLOUR, np.uint8)
    colors[faces.ravel()[known]] = image[row, column, ::-1]
    return colors


def _checked(data: MeshData, kind: str) -> Mesh:
    faces = data.faces
    outside = np.flatnonzero(((faces < 0) | (faces >= len(data.vertices))).any(axis=1))
    if outside.size:
        raise CaptureError(
            f"triangle {outside[0]} refers to a vertex that does not exist; the mesh has "
            f"{len(data.vertices)} vertices.",
            hint="Export the mesh again.",
        )
    vertices, colors = without_loose(data.vertices, faces, data.colors)
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if bad.size:
        raise CaptureError(
            f"vertex {bad[0]} has a coordinate that is not finite ({bad.size} such vertices).",
            hint="Export the mesh again.",
        )
    low, typical, high = _DIAGONAL_MM[kind]
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not low <= diagonal <= high:
        fitting = {unit: abs(math.log(diagonal * mm / typical)) for unit, mm in _UNITS_MM.items() if diagonal > 0}
        unit = min(fitting, key=fitting.__getitem__) if fitting else ""
        guess = f" Its lengths look like {unit}." if fitting and low <= diagonal * _UNITS_MM[unit] <= high else ""
        raise CaptureError(
            f"the bounding box diagonal of the mesh is {diagonal:.4g} mm; expected {low:g} to {high:g} mm for a "
            f"{kind}.{guess}",
            hint="Lengths must be in mm: scale the mesh and export it again.",
        )
    mesh = Mesh(vertices, faces.astype(np.int32), colors, uv=data.uv)
    turned = winding(mesh)
    if turned.closed and not turned.outward:
        return replace(mesh, faces=mesh.faces[:, ::-1], uv=None if mesh.uv is None else mesh.uv[:, ::-1])
    return mesh


class Winding(NamedTuple):
    """Winding of a mesh's triangles, and whether the mesh is closed."""

    closed: bool  # whether every edge is shared by exactly two triangles, in opposite directions
    consistent: bool  # whether no two triangles share an edge in the same direction, except degenerate ones
    outward: bool  # whether triangles are counter-clockwise seen from outside; a guess if the mesh is not closed
    volume_mm3: float  # enclosed volume; positive if triangles are wound outward


def winding(mesh: Mesh) -> Winding:
    """Determine whether a mesh is closed and how its triangles are wound; coincident vertices count as one.

    The signed volume is the sum of the tetrahedra over the triangles with the centroid as apex (C. Zhang, T. Chen,
    "Efficient feature extraction for 2D/3D objects in mesh representation", ICIP 2001).
    """
    places, index = welded(mesh.vertices)
    faces = index[mesh.faces]
    ends = np.roll(faces, -1, axis=1)
    edges = faces * len(places) + ends
    there, back = np.sort(edges, axis=None), np.sort(ends * len(places) + faces, axis=None)
    distinct = bool((there[1:] != there[:-1]).all())
    closed = distinct and bool((there == back).all())
    proper = edges[(faces != ends).all(axis=1)]
    consistent = distinct or len(np.unique(proper)) == proper.size
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - mesh.vertices.mean(axis=0), 1, 0)
    volume = float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)
    return Winding(closed, consistent, volume > 0, volume)
