"""Read the cameras of Agisoft Metashape from XML (File, Export, Export Cameras, "Agisoft XML").

The conventions are those of a frame camera in the Metashape User Manual, appendix "Camera models": `transform` of a
camera maps camera coordinates (x right, y down, z forward) to its chunk; the transform of the chunk or component maps
to the world and includes a scale. With the undistorted normalised image point x, y (focal length 1) and its norm r,
    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y,
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p2 (r^2 + 2 y^2) + 2 p1 x y,
    u = width / 2 + cx + x' f + x' b1 + y' b2,  v = height / 2 + cy + y' f,
where the corner of the top-left pixel is at (0, 0). OpenCV's p1 and p2 are Metashape's p2 and p1. The unit is usually
the metre.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError
from jawusd.cameras.files import (
    UNDISTORT,
    CameraFormat,
    Size,
    lens_with_k4,
    names_of_labels,
    number,
    numbers,
    parsed_xml,
    world_to_camera,
)
from jawusd.geometry import Camera
from jawusd.geometry.camera import intrinsics

_HALF_PX, _MOST_PX = 0.5, 1e6


def load_metashape(path: Path) -> list[Camera]:
    """Read the aligned cameras of a Metashape XML, named by their labels, in the file's unit.

    Raises:
        CalibrationError: no camera is aligned, two cameras have the same label, or a sensor is not a frame camera or
            has no calibration.
        FormatError: the file is damaged.
    """
    root = parsed_xml(path)
    nodes = [
        (chunk, node)
        for chunk in root.findall("chunk") or [root]
        for node in chunk.iter("camera")
        # Metashape writes no transform for cameras that it could not align.
        if (node.findtext("transform") or "").strip()
    ]
    if not nodes:
        raise CalibrationError("has no aligned cameras.", hint="Align the photos, then export the cameras.")
    names = names_of_labels([str(node.get("label")) for _, node in nodes])
    cameras = [_camera(name, chunk, node) for name, (chunk, node) in zip(names, nodes, strict=True)]
    return sorted(cameras, key=lambda camera: camera.name)


def _camera(name: str, chunk: ElementTree.Element, node: ElementTree.Element) -> Camera:
    sensors = {str(one.get("id")): one for one in chunk.iter("sensor")}
    components = {str(one.get("id")): one.find("transform") for one in chunk.iter("component")}
    T_chunk_cam = numbers(node.findtext("transform", ""), 16, f"camera {name}").reshape(4, 4)
    R, t, scale = _placement(components.get(str(node.get("component_id")), chunk.find("transform")))
    sensor = sensors.get(str(node.get("sensor_id")))
    if sensor is None:
        raise CalibrationError(f"camera {name} refers to a sensor that is not in the file.")
    size, K, lens = _lens(sensor)
    centre = scale * R @ T_chunk_cam[:3, 3] + t
    return Camera(name, size, K, lens, world_to_camera(name, R @ T_chunk_cam[:3, :3], centre))


def _lens(sensor: ElementTree.Element) -> tuple[Size, Array, Array]:
    label = sensor.get("label") or sensor.get("id")
    found = {node.get("class", ""): node for node in sensor.findall("calibration")}
    node = found.get("adjusted") if "adjusted" in found else next(iter(found.values()), None)
    resolution = sensor.find("resolution") if node is None else node.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if node is None or resolution is None:
        raise CalibrationError(f"sensor {label} has no calibration.", hint="Align the photos first.")
    kind = node.get("type", sensor.get("type", "frame"))
    if kind != "frame":
        raise CalibrationError(
            f'sensor {label} has the type "{kind}"; only sensors of type "frame" are supported.', hint=UNDISTORT
        )
    values = {child.tag: child.text or "" for child in node}

    def value(key: str, other: float = 0.0) -> float:
        return other if key not in values else number(values[key], f"sensor {label} {key}")

    sides = (number(resolution.get(side, "0"), f"sensor {label} {side}") for side in ("width", "height"))
    width, height = (int(min(side, _MOST_PX)) for side in sides)
    size = (width, height)
    focal = value("f", value("fy"))
    if not focal > 0 or min(size) < 1:
        raise CalibrationError(f"sensor {label} has no focal length or no resolution.")
    wide = value("fx", focal + value("b1"))
    # Before version 1.0, cx and cy were relative to the image corner, and focal lengths were fx and fy.
    old = "fx" in values
    cx = value("cx") + (0.0 if old else size[0] / 2) - _HALF_PX
    cy = value("cy") + (0.0 if old else size[1] / 2) - _HALF_PX
    K = intrinsics(wide, focal, cx, cy, value("b2"))
    for key in ("p3", "p4"):  # former names of the tangential coefficients
        if value(key):
            raise CalibrationError(f"sensor {label} has {key} = {value(key):g}; it must be 0.", hint=UNDISTORT)
    radial = np.array([value(f"k{k}") for k in (1, 2, 3, 4)])
    return size, K, lens_with_k4(str(label), K, size, radial, (value("p2"), value("p1")))


def _placement(node: ElementTree.Element | None) -> tuple[Array, Array, float]:
    """Return rotation, translation and scale of a chunk's or component's transform; identity for None."""
    parts = {} if node is None else {child.tag: child.text or "" for child in node}
    R = numbers(parts.get("rotation", "1 0 0 0 1 0 0 0 1"), 9, "rotation").reshape(3, 3)
    t = numbers(parts.get("translation", "0 0 0"), 3, "translation")
    return R, t, number(parts.get("scale", "1"), "scale")


FORMAT = CameraFormat(lambda path: path.suffix.lower() == ".xml", lambda path, _: load_metashape(path))
