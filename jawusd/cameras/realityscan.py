"""Read the cameras of RealityScan (RealityCapture) from XMP files beside the images, or from CSV.

In XMP files (`IMAGE.xmp`), Rotation (row-major) maps world to camera axes (x right, y down, z forward), and Position is
the camera's centre. FocalLength35mm assumes that the longer side measures 36 mm; PrincipalPointU and V are relative to
the image centre, in units of the longer side. Distortion models "brown3" and "brown4" (with the suffix "t2": with
tangential terms) equal OpenCV's in normalised coordinates: k1 k2 k3 k4 t1 t2, where t1, t2 are OpenCV's p1, p2. The
image size is not in the file. References: "Camera Geometry in RealityScan", dev.epicgames.com; "RealityCapture XMP
Camera Math", support.capturingreality.com.

In CSV files ("Internal/External camera parameters"; columns are found by name), (x, y, alt) is the camera's centre. The
camera's axes in the world (x right, y up, z backward) are Rz(-heading) Rx(pitch) Ry(roll) with angles in degrees, as in
nerfstudio and brush. f, px, py, k1 to k4, t1 and t2 are as in XMP.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError, errors_name_file
from jawusd.base.tables import read_table
from jawusd.cameras.files import (
    CameraFormat,
    Size,
    files_in,
    folder_of,
    known_size,
    lens_with_k4,
    names_of_labels,
    number,
    numbers,
    parsed_xml,
    world_to_camera,
)
from jawusd.geometry import Camera, make_transform, se3_inverse, so3_exp
from jawusd.geometry.camera import intrinsics

_MOST_BYTES = 16 << 20
_HALF_PX = 0.5
_FILM_MM = 36.0
_LARGEST_SKEW = 1e-6
_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_LENS = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_OPENGL = np.diag([1.0, -1.0, -1.0])


def load_realityscan_xmp(folder: Path, sizes: Mapping[str, Size]) -> list[Camera]:
    """Read the XMP files of a folder; return cameras named after the files, in the files' unit; `sizes` by camera.

    Raises:
        CalibrationError: a file is not XML, a size is unknown, or a value is missing or wrong.
        FormatError: a file cannot be read.
    """
    cameras = [_camera_of_xmp(path, sizes) for path in files_in(folder, ".xmp")]
    if not cameras:
        raise CalibrationError("has no .xmp files.")
    return cameras


@errors_name_file
def _camera_of_xmp(path: Path, sizes: Mapping[str, Size]) -> Camera:
    node = next(parsed_xml(path).iter(f"{_RDF}Description"), None)
    values = {} if node is None else _xmp_values(node)
    if "Rotation" not in values or "Position" not in values:
        raise CalibrationError("has no Rotation or no Position.", hint="Export XMP with camera poses.")
    size = known_size(path.stem, sizes)
    f35 = number(values.get("FocalLength35mm", ""), "FocalLength35mm")
    u, v = (number(values.get(f"PrincipalPoint{axis}", "0"), "PrincipalPoint") for axis in "UV")
    model = values.get("DistortionModel", "perspective").lower()
    if not model.startswith(("brown", "perspective")):
        raise CalibrationError(
            f'has the distortion model "{model}"; expected "brown3" or "brown4".',
            hint="Choose Brown3 or Brown4 with tangential distortion, and align again.",
        )
    terms = numbers(values.get("DistortionCoeficients", "0 0 0 0 0 0"), 6, "DistortionCoeficients")
    for key, square in (("Skew", 0.0), ("AspectRatio", 1.0)):
        if abs(number(values.get(key, str(square)), key) - square) > _LARGEST_SKEW:
            raise CalibrationError(f"has {key} {values[key]}; it must be {square:g}.", hint="Align with square pixels.")
    K, lens = _lens(path.stem, size, f35, (u, v), terms)
    rotation = numbers(values["Rotation"], 9, "Rotation").reshape(3, 3)
    centre = numbers(values["Position"], 3, "Position")
    return Camera(path.stem, size, K, lens, world_to_camera(path.stem, rotation.T, centre))


def load_realityscan_csv(path: Path, sizes: Mapping[str, Size]) -> list[Camera]:
    """Read cameras from RealityScan's camera parameters, named after the images, in the file's unit; `sizes` by camera.

    Raises:
        CalibrationError: a column or a size is missing, or a value is not finite.
        FormatError: the file is not a table of numbers.
    """
    table = read_table(path, _MOST_BYTES, comment="#cameras")
    header = [word.lstrip("#").strip().lower() for word in table.header]
    lacking = [key for key in _NEEDED if key not in header]
    if lacking:
        raise CalibrationError(f"has no column {lacking[0]}; expected the columns {', '.join(_NEEDED)}.")
    columns = [k for k, key in enumerate(header) if key in (*_NEEDED[1:], *_LENS)]
    column = header.index("name")
    names = names_of_labels([row[column] for row in table.rows])
    out = []
    for where, name, values in zip(table.places, names, table.numbers(columns), strict=True):
        if not np.isfinite(values).all():
            raise CalibrationError(f"{where} has a value that is not finite.")
        found = {header[k]: float(value) for k, value in zip(columns, values)}
        size = known_size(name, sizes)
        terms = np.array([found.get(key, 0.0) for key in _LENS[2:]])
        K, lens = _lens(name, size, found["f"], (found.get("px", 0.0), found.get("py", 0.0)), terms)
        heading, pitch, roll = (np.deg2rad(found[key]) for key in ("heading", "pitch", "roll"))
        turns = so3_exp(np.array([[0, 0, -heading], [pitch, 0, 0], [0, roll, 0]]))
        axes = turns[0] @ turns[1] @ turns[2] @ _OPENGL
        T_world_cam = make_transform(axes, np.array([found["x"], found["y"], found["alt"]]))
        out.append(Camera(name, size, K, lens, se3_inverse(T_world_cam)))
    if not out:
        raise CalibrationError("has no cameras.")
    return sorted(out, key=lambda camera: camera.name)


def _lens(name: str, size: Size, f35_mm: float, principal: tuple[float, float], terms: Array) -> tuple[Array, Array]:
    """Return K (3, 3) and OpenCV's coefficients from RealityScan's values; `terms` are k1 k2 k3 k4 t1 t2."""
    longer = max(size)
    if not f35_mm > 0:
        raise CalibrationError(f"camera {name} has focal length {f35_mm:g} mm; it must be > 0.")
    focal = f35_mm / _FILM_MM * longer
    cx, cy = (principal[k] * longer + size[k] / 2 - _HALF_PX for k in (0, 1))
    K = intrinsics(focal, focal, cx, cy)
    return K, lens_with_k4(name, K, size, terms[:4], (float(terms[4]), float(terms[5])))


def _xmp_values(node: ElementTree.Element) -> dict[str, str]:
    found = {key.removeprefix(_XCR): value for key, value in node.attrib.items() if key.startswith(_XCR)}
    return found | {child.tag.removeprefix(_XCR): child.text or "" for child in node if child.tag.startswith(_XCR)}


def _load(path: Path, sizes: Mapping[str, Size]) -> list[Camera]:
    if path.suffix.lower() == ".csv":
        return load_realityscan_csv(path, sizes)
    return load_realityscan_xmp(folder_of(path), sizes)


FORMAT = CameraFormat(
    lambda path: path.suffix.lower() in (".csv", ".xmp") or bool(files_in(path, ".xmp")),
    _load,
    lambda path: [path] if path.suffix.lower() == ".csv" else files_in(folder_of(path), ".xmp"),
    lacks_sizes=True,
)
