"""Cameras as text tables: RealityScan CSV, and OpenCV YAML.

RealityScan CSV ("Internal/External camera parameters"; columns may be chosen and are found by name): x, y, alt is the
camera's centre; the camera's axes in the world, x right, y up, z backward, are Rz(-heading) Rx(pitch) Ry(roll) in
degrees, as nerfstudio and brush read them; f is for 36 mm along the longer side, px and py are from the middle of the
picture in lengths of that side, k1 .. k4, t1, t2 as in `camera_xml`.

OpenCV YAML (`cv::FileStorage`, https://docs.opencv.org/4.x/d4/da4/group__core__xml.html): matrices in the forms that
OpenCV's samples, ROS `camera_info` and EasyMocap write: camera_matrix, cameraMatrix, K or M with distortion
coefficients, and R (3 x 3 or Rodrigues vector) and T, world to camera; names may end with the camera's, `K_left`,
`R_left`; of M1, D1, M2, D2, R, T the first camera is the world. Pixels and axes are OpenCV's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jawusd.errors import CalibrationError
from jawusd.formats.camera_xml import Size, known_size, realityscan_lens
from jawusd.geometry import Camera, make_transform, rigidity_defect, se3_inverse, so3_exp
from jawusd.geometry.arrays import Array
from jawusd.tables import read_table, read_text

_MOST_BYTES = 16 << 20
_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_LENS = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_OPENGL = np.diag([1.0, -1.0, -1.0])
_MATRIX = re.compile(
    r"^\s*(?P<name>[\w.-]+)\s*:\s*(?:!!opencv-matrix)?\s*\n\s*rows\s*:\s*(?P<rows>\d+)\s*\n\s*cols\s*:\s*(?P<cols>\d+)"
    r"\s*\n(?:\s*dt\s*:\s*\S+\s*\n)?\s*data\s*:\s*\[(?P<data>[^\]]*)\]",
    re.MULTILINE,
)
_SCALAR = re.compile(r"^(?P<name>\w+)\s*:\s*(?P<value>-?[\d.]+(?:e[-+]?\d+)?)\s*$", re.MULTILINE | re.IGNORECASE)
_ROLES = {
    "K": r"(?:camera_matrix|cameramatrix|intrinsic_matrix|intrinsics|k|m)",
    "dist": r"(?:distortion_coefficients|distortion|dist_coeffs?|distcoeffs|dist|d)",
    "R": r"(?:rotation_matrix|rotation|rot|rvec|r)",
    "T": r"(?:translation_vector|translation|tvec|t)",
    "width": r"(?:image_width|imagewidth|width|w)",
    "height": r"(?:image_height|imageheight|height|h)",
}
_LARGEST_DEFECT = 1e-4
_MOST_PX = 1e6


def load_realityscan_csv(path: Path, sizes: Mapping[str, Size]) -> list[Camera]:
    """Read RealityScan's camera parameters, by the names of the pictures without suffix, in the file's unit.

    Args:
        path: the CSV.
        sizes: (width, height) [px] of the pictures by camera.

    Raises:
        CalibrationError: a column or a size is missing, or a value is not finite.
        FormatError: the file is no table of numbers.
    """
    table = read_table(path, _MOST_BYTES, comment="#cameras")
    header = [word.lstrip("#").strip().lower() for word in table.header]
    lacking = [key for key in _NEEDED if key not in header]
    if lacking:
        raise CalibrationError(
            f"has no column {lacking[0]}; RealityScan's camera parameters have {', '.join(_NEEDED)}.", path=path
        )
    columns = [k for k, key in enumerate(header) if key in (*_NEEDED[1:], *_LENS)]
    numbers = table.numbers(columns)
    out = []
    for where, row, values in zip(table.places, table.rows, numbers):
        if not np.isfinite(values).all():
            raise CalibrationError(f"{where} has a value that is not finite.", path=path)
        found = {header[k]: float(value) for k, value in zip(columns, values)}
        name = Path(row[header.index("name")].strip().replace("\\", "/")).stem
        size = known_size(path, name, sizes)
        terms = np.array([found.get(key, 0.0) for key in _LENS[2:]])
        K, lens = realityscan_lens(path, name, size, found["f"], (found.get("px", 0.0), found.get("py", 0.0)), terms)
        heading, pitch, roll = (np.deg2rad(found[key]) for key in ("heading", "pitch", "roll"))
        turns = so3_exp(np.array([[0, 0, -heading], [pitch, 0, 0], [0, roll, 0]]))
        axes = turns[0] @ turns[1] @ turns[2] @ _OPENGL
        T_world_cam = make_transform(axes, np.array([found["x"], found["y"], found["alt"]]))
        out.append(Camera(name, size, K, lens, se3_inverse(T_world_cam)))
    if not out:
        raise CalibrationError("holds no cameras.", path=path)
    return sorted(out, key=lambda camera: camera.name)


def load_opencv_yaml(paths: list[Path], sizes: Mapping[str, Size]) -> list[Camera]:
    """Read cameras from OpenCV's YAML: one file per camera, named after it, or files that hold several.

    Args:
        paths: the files; what one says of a camera is joined with what others say, and cameras whose lens alone is
            known are left out.
        sizes: of the pictures by camera, where the files do not say them.

    Raises:
        CalibrationError: a camera lacks intrinsics, pose or size, or a value is wrong.
        FormatError: a file cannot be read.
    """
    found: dict[str, dict[str, Array]] = {}
    for path in paths:
        for name, parts in _parts_of(path).items():
            found.setdefault(name, {}).update(parts)
    shared = found.pop("", {}) if any("K" in parts for name, parts in found.items() if name) else {}
    if set(found) == {"1", "2"} and {"R", "T"} <= set(shared):  # a stereo pair: the first camera is the world
        found["1"] |= {"R": np.eye(3), "T": np.zeros(3)}
        found["2"] |= {"R": shared["R"], "T": shared["T"]}
    known = {name: shared | parts for name, parts in found.items() if "K" in parts}
    posed = {name: parts for name, parts in known.items() if "R" in parts or "T" in parts}
    cameras = [_yaml_camera(paths[0], name, parts, sizes) for name, parts in (posed or known).items()]
    if not cameras:
        raise CalibrationError("holds no camera matrix.", path=paths[0])
    return sorted(cameras, key=lambda camera: camera.name)


def _parts_of(path: Path) -> dict[str, dict[str, Array]]:
    """Return the matrices and numbers of a file, by camera and role; "" is the camera that is not named."""
    text = read_text(path, _MOST_BYTES)
    values: dict[str, Array] = {}
    for match in _MATRIX.finditer(text):
        try:
            data = np.array([float(word) for word in match["data"].replace("\n", " ").split(",") if word.strip()])
            values[match["name"]] = data.reshape(int(match["rows"]), int(match["cols"]))
        except ValueError as error:
            raise CalibrationError(f'"{match["name"]}" is not a matrix as its rows and cols say.', path=path) from error
    values |= {match["name"]: np.array(float(match["value"])) for match in _SCALAR.finditer(text)}
    out: dict[str, dict[str, Array]] = {}
    for key, value in values.items():
        for role, pattern in _ROLES.items():
            named = re.fullmatch(rf"{pattern}(?:_?(?P<camera>\d+|(?<=_)[\w-]+))?", key, re.IGNORECASE)
            if named and key.lower() not in ("rows", "cols"):
                parts = out.setdefault(named["camera"] or "", {})
                if not (role == "R" and parts.get("R") is not None and parts["R"].shape == (3, 3)):
                    parts[role] = value
                break
    if set(out) == {""}:
        return {path.stem: out[""]}
    return out


def _yaml_camera(path: Path, name: str, parts: Mapping[str, Array], sizes: Mapping[str, Size]) -> Camera:
    lacking = [role for role in ("K", "R", "T") if role not in parts]
    if lacking:
        raise CalibrationError(
            f"camera {name} has no {lacking[0]}.", path=path, hint="Pose (R, T) and intrinsics (K, D) are both needed."
        )
    if "width" in parts and "height" in parts:
        sides = np.array([parts["width"], parts["height"]], np.float64).ravel()
        if sides.size != 2 or not ((sides >= 1) & (sides <= _MOST_PX)).all():
            raise CalibrationError(
                f"camera {name} has pictures of {sides.tolist()} px, allowed are 1 to 1e6.", path=path
            )
        size = (int(sides[0]), int(sides[1]))
    elif name in sizes:
        size = sizes[name]
    else:
        raise CalibrationError(f"camera {name} has no image_width and image_height.", path=path)
    R = so3_exp(parts["R"].ravel()) if parts["R"].size == 3 else parts["R"]
    K, T, lens = parts["K"], parts["T"].ravel(), parts.get("dist", np.zeros(0)).ravel()
    if K.shape != (3, 3) or R.shape != (3, 3) or T.shape != (3,) or lens.size not in (0, 4, 5, 8, 12, 14):
        raise CalibrationError(f"camera {name} has a matrix of the wrong size.", path=path)
    if lens[8:].any():
        raise CalibrationError(f"camera {name} has thin-prism or tilt coefficients, allowed are 8.", path=path)
    if rigidity_defect(make_transform(R, np.zeros(3))) > _LARGEST_DEFECT or not np.isfinite(K).all():
        raise CalibrationError(f"camera {name} has a rotation that is none.", path=path)
    return Camera(name, size, K, lens[:8], make_transform(R, T))
