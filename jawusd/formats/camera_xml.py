"""Cameras of photogrammetry programs in XML: Agisoft Metashape, and RealityScan (RealityCapture) XMP.

Metashape (File, Export, Export Cameras, "Agisoft XML"; Metashape User Manual, appendix "Camera models", frame camera):
`transform` of a camera maps camera to chunk, x right, y down, z forward; the chunk's (or component's) transform goes on
to the world, with a scale. With x, y undistorted, r their length and lengths over the focal length,
    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y,
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p2 (r^2 + 2 y^2) + 2 p1 x y,
    u = width / 2 + cx + x' f + x' b1 + y' b2,  v = height / 2 + cy + y' f,
the corner of the top-left pixel at (0, 0). OpenCV's p1 and p2 are Metashape's p2 and p1. The unit is mostly metres.

RealityScan writes `IMAGE.xmp` beside each picture ("Camera Geometry in RealityScan", dev.epicgames.com, and
"RealityCapture XMP Camera Math", support.capturingreality.com): Rotation (row by row) takes world to camera axes, x
right, y down, z forward; Position is the camera's centre. FocalLength35mm is for 36 mm along the longer side;
PrincipalPointU and V are from the middle of the picture in lengths of that side. Distortion "brown3" and "brown4" (with
t2: tangential) works as OpenCV's on coordinates over the focal length: k1 k2 k3 k4 t1 t2 with t1, t2 = OpenCV's p1, p2.
The size of the picture is not in the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from jawusd.errors import CalibrationError
from jawusd.formats.text import read_text
from jawusd.geometry import Camera, make_transform, rigidity_defect
from jawusd.geometry.arrays import Array
from jawusd.geometry.lens_fit import opencv_radial

Size = tuple[int, int]

_MOST_BYTES = 64 << 20
_HALF_PX, _MOST_PX = 0.5, 1e6
_FILM_MM = 36.0
_LARGEST_ERROR_PX = 0.05  # of a lens written with other coefficients
_LARGEST_DEFECT = 1e-3
_LARGEST_SKEW = 1e-6
_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"


def load_metashape(path: Path) -> list[Camera]:
    """Read the aligned cameras of a Metashape XML, by their labels without suffix, in the file's unit.

    Raises:
        CalibrationError: no cameras are aligned, or a sensor is no frame camera or has no calibration.
        FormatError: the file is damaged.
    """
    root = _parsed(path)
    sensors = {str(node.get("id")): node for node in root.iter("sensor")}
    components = {str(node.get("id")): _placement(path, node.find("transform")) for node in root.iter("component")}
    chunk = _placement(path, root.find("./chunk/transform"))
    out: dict[str, Camera] = {}
    for node in root.iter("camera"):
        matrix = node.find("transform")
        if matrix is None or not matrix.text:
            continue  # not aligned
        label = str(node.get("label"))
        name = Path(label.replace("\\", "/")).stem or label
        T_chunk_cam = _numbers(path, matrix.text, 16, f"camera {label}").reshape(4, 4)
        R, t, scale = components.get(str(node.get("component_id")), chunk)
        rotation = R @ T_chunk_cam[:3, :3]
        centre = scale * R @ T_chunk_cam[:3, 3] + t
        sensor = sensors.get(str(node.get("sensor_id")))
        if sensor is None:
            raise CalibrationError(f"camera {label} names a sensor that the file does not hold.", path=path)
        size, K, lens = _metashape_lens(path, sensor)
        out[name] = Camera(name, size, K, lens, _world_to_camera(path, name, rotation, centre))
    if not out:
        raise CalibrationError(
            "holds no aligned cameras.", path=path, hint="Align the photos, then export the cameras."
        )
    return [out[name] for name in sorted(out)]


def load_realityscan_xmp(folder: Path, sizes: Mapping[str, Size]) -> list[Camera]:
    """Read the XMP files of a folder as cameras by the files' names, in their unit.

    Args:
        folder: of the files.
        sizes: (width, height) [px] of the pictures by camera; those of others are not read.

    Raises:
        CalibrationError: a size is not known, or a value is missing or wrong.
        FormatError: a file is damaged.
    """
    out = []
    for path in sorted(folder.glob("*.xmp")):
        node = next(_parsed(path).iter(f"{_RDF}Description"), None)
        values = {} if node is None else _xmp_values(node)
        if "Rotation" not in values or "Position" not in values:
            raise CalibrationError("has no Rotation and Position.", path=path, hint="Export XMP with camera poses.")
        size = known_size(path, path.stem, sizes)
        f35 = _numbers(path, values.get("FocalLength35mm", ""), 1, "FocalLength35mm")[0]
        principal = [float(_numbers(path, values.get(f"PrincipalPoint{a}", "0"), 1, "PrincipalPoint")[0]) for a in "UV"]
        model = values.get("DistortionModel", "perspective").lower()
        if not model.startswith(("brown", "perspective")):
            raise CalibrationError(
                f'has the distortion model "{model}"; "brown3" and "brown4" are read.',
                path=path,
                hint="Choose Brown3 or Brown4 with tangential as distortion model, and align again.",
            )
        terms = _numbers(path, values.get("DistortionCoeficients", "0 0 0 0 0 0"), 6, "DistortionCoeficients")
        for key, square in (("Skew", 0.0), ("AspectRatio", 1.0)):
            if abs(_numbers(path, values.get(key, str(square)), 1, key)[0] - square) > _LARGEST_SKEW:
                raise CalibrationError(
                    f"has {key} {values[key]}, allowed is {square:g}.", path=path, hint="Align with square pixels."
                )
        K, lens = realityscan_lens(path, path.stem, size, f35, (principal[0], principal[1]), terms)
        rotation = _numbers(path, values["Rotation"], 9, "Rotation").reshape(3, 3)
        centre = _numbers(path, values["Position"], 3, "Position")
        out.append(Camera(path.stem, size, K, lens, _world_to_camera(path, path.stem, rotation.T, centre)))
    if not out:
        raise CalibrationError("holds no .xmp files.", path=folder)
    return out


def known_size(path: Path, name: str, sizes: Mapping[str, Size]) -> Size:
    """Return the size of a camera's pictures.

    Raises:
        CalibrationError: it is not known.
    """
    if name not in sizes:
        listed = ", ".join(sizes) or "none"
        raise CalibrationError(
            f"camera {name}: RealityScan does not write the size of pictures, and there is no footage of that name "
            f"(there is: {listed}).",
            path=path,
            hint="Name the picture of each camera as its [[camera]], or give --size.",
        )
    return sizes[name]


def realityscan_lens(
    path: Path, name: str, size: Size, f35_mm: float, principal: tuple[float, float], terms: Array
) -> tuple[Array, Array]:
    """Return K (3, 3) and OpenCV's coefficients of RealityScan's values: terms are k1 k2 k3 k4 t1 t2.

    Raises:
        CalibrationError: the focal length cannot be, or the lens cannot be written with OpenCV's coefficients.
    """
    longer = max(size)
    if not f35_mm > 0:
        raise CalibrationError(f"camera {name} has the focal length {f35_mm:g} mm, allowed is more than 0.", path=path)
    focal = f35_mm / _FILM_MM * longer
    cx, cy = (principal[k] * longer + size[k] / 2 - _HALF_PX for k in (0, 1))
    K = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    return K, _opencv(path, name, K, size, terms[:4], (float(terms[4]), float(terms[5])))


def _metashape_lens(path: Path, sensor: ElementTree.Element) -> tuple[Size, Array, Array]:
    label = sensor.get("label") or sensor.get("id")
    found = {node.get("class", ""): node for node in sensor.findall("calibration")}
    node = found.get("adjusted") if "adjusted" in found else next(iter(found.values()), None)
    resolution = sensor.find("resolution") if node is None else node.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if node is None or resolution is None:
        raise CalibrationError(f"sensor {label} has no calibration.", path=path, hint="Align the photos first.")
    kind = node.get("type", sensor.get("type", "frame"))
    if kind != "frame":
        raise CalibrationError(f'sensor {label} is a "{kind}" camera; "frame" cameras are read.', path=path)
    values = {child.tag: child.text or "" for child in node}

    def value(key: str, other: float = 0.0) -> float:
        return other if key not in values else float(_numbers(path, values[key], 1, f"sensor {label} {key}")[0])

    sides = (_numbers(path, resolution.get(side, "0"), 1, f"sensor {label} {side}")[0] for side in ("width", "height"))
    width, height = (int(min(side, _MOST_PX)) for side in sides)
    size = (width, height)
    focal = value("f", value("fy"))
    if not focal > 0 or min(size) < 1:
        raise CalibrationError(f"sensor {label} has no focal length or no resolution.", path=path)
    wide = value("fx", focal + value("b1"))
    # Before version 1.0, cx and cy counted from the corner, and fx stood beside fy.
    old = "fx" in values
    cx = value("cx") + (0.0 if old else size[0] / 2) - _HALF_PX
    cy = value("cy") + (0.0 if old else size[1] / 2) - _HALF_PX
    K = np.array([[wide, value("b2"), cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    radial = np.array([value(f"k{k}") for k in (1, 2, 3, 4)])
    return size, K, _opencv(path, str(label), K, size, radial, (value("p2"), value("p1")))


def _opencv(path: Path, name: str, K: Array, size: Size, radial: Array, tangential: tuple[float, float]) -> Array:
    """Return OpenCV's coefficients of a lens with four radial terms and OpenCV's (p1, p2)."""
    k, error_px = opencv_radial(K, size, radial)
    if error_px > _LARGEST_ERROR_PX:
        raise CalibrationError(
            f"camera {name}: its lens cannot be written with OpenCV's coefficients (off by {error_px:.2f} px, allowed "
            f"are {_LARGEST_ERROR_PX:g}).",
            path=path,
            hint="Calibrate without k4, or undistort the footage first.",
        )
    lens = np.concatenate([k[:2], tangential, k[2:]])
    return lens if lens.any() else np.zeros(0)


def _placement(path: Path, node: ElementTree.Element | None) -> tuple[Array, Array, float]:
    """Return rotation, translation and scale of a chunk's or component's transform; none is the identity."""
    if node is None:
        return np.eye(3), np.zeros(3), 1.0
    parts = {child.tag: child.text or "" for child in node}
    R = _numbers(path, parts["rotation"], 9, "rotation").reshape(3, 3) if "rotation" in parts else np.eye(3)
    t = _numbers(path, parts["translation"], 3, "translation") if "translation" in parts else np.zeros(3)
    scale = float(_numbers(path, parts["scale"], 1, "scale")[0]) if "scale" in parts else 1.0
    return R, t, scale


def _world_to_camera(path: Path, name: str, rotation: Array, centre: Array) -> Array:
    """Return T_cam_world of a camera's axes in the world (3, 3) and its centre (3,)."""
    if rigidity_defect(make_transform(rotation, np.zeros(3))) > _LARGEST_DEFECT:
        raise CalibrationError(f"camera {name} has a rotation that is none.", path=path)
    u, _, vt = np.linalg.svd(rotation)
    exact = u @ vt
    return make_transform(exact.T, -exact.T @ centre)


def _xmp_values(node: ElementTree.Element) -> dict[str, str]:
    found = {key.removeprefix(_XCR): value for key, value in node.attrib.items() if key.startswith(_XCR)}
    return found | {child.tag.removeprefix(_XCR): child.text or "" for child in node if child.tag.startswith(_XCR)}


def _numbers(path: Path, text: str, count: int, what: str) -> Array:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise CalibrationError(f'{what}: "{text:.60}" are not numbers.', path=path) from error
    if len(values) != count or not np.isfinite(values).all():
        raise CalibrationError(f"{what} has {len(values)} values, {count} finite ones are needed.", path=path)
    return values


def _parsed(path: Path) -> ElementTree.Element:
    text = read_text(path, _MOST_BYTES)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities can name other files, and grow without end
        raise CalibrationError("declares a document type, which calibrations do not.", path=path)
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise CalibrationError(f"is not XML that can be read ({error}).", path=path) from error
