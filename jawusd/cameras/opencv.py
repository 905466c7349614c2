"""Read cameras from files of OpenCV's `cv::FileStorage`: YAML, XML and JSON.

The format is described at https://docs.opencv.org/4.x/d4/da4/group__core__xml.html. Matrices have the names that
OpenCV's samples, ROS `camera_info` and EasyMocap use: camera_matrix, cameraMatrix, K or M with distortion coefficients,
and R (3 x 3 or Rodrigues vector) and T, which map world to camera. Names may have the camera as suffix, such as
`K_left` and `R_left`. For a stereo pair with M1, D1, M2, D2, R and T, the world frame is that of the first camera.
Pixels and axes are OpenCV's. Other values are ignored.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError, errors_name_file, naming_file
from jawusd.base.tables import read_text
from jawusd.cameras.files import CameraFormat, Size, check_lens_model, files_in, known_size, parsed_xml
from jawusd.formats.text import read_json
from jawusd.geometry import Camera, make_transform, rigidity_defect, so3_exp

_MOST_BYTES = 16 << 20
_YAML = (".yml", ".yaml")
_BEGINNING = 4096  # number of leading bytes searched for OpenCV's markers in XML and JSON
_MATRIX = re.compile(
    r"^\s*(?P<name>[\w.-]+)\s*:\s*(?:!!opencv-matrix)?\s*\n\s*rows\s*:\s*(?P<rows>\d+)\s*\n\s*cols\s*:\s*(?P<cols>\d+)"
    r"\s*\n(?:\s*dt\s*:\s*\S+\s*\n)?\s*data\s*:\s*\[(?P<data>[^\]]*)\]",
    re.MULTILINE,
)
_VALUE = re.compile(r"^(?P<name>\w+)[ \t]*:[ \t]*(?P<value>[^\s\[!{][^\n]*?)[ \t]*$", re.MULTILINE)
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


def load_opencv(paths: list[Path], sizes: Mapping[str, Size]) -> list[Camera]:
    """Read cameras from OpenCV's storage: one file per camera, named after the camera, or files with several cameras.

    Values of a camera are merged over all files. If any camera has a pose, cameras without one are ignored. `sizes` has
    the image sizes by camera, used if the files do not state them.

    Raises:
        CalibrationError: a camera lacks intrinsics, pose or size, or a value is wrong.
        FormatError: a file cannot be read.
    """
    found: dict[str, dict[str, Array]] = {}
    for path in paths:
        _merge(path, found)
    shared = found.pop("", {}) if any("K" in parts for name, parts in found.items() if name) else {}
    if set(found) == {"1", "2"} and {"R", "T"} <= set(shared):  # a stereo pair: the world frame is the first camera's
        found["1"] |= {"R": np.eye(3), "T": np.zeros(3)}
        found["2"] |= {"R": shared["R"], "T": shared["T"]}
    whole = {name: shared | parts for name, parts in found.items()}
    posed = {name: parts for name, parts in whole.items() if len({"K", "R", "T"} & parts.keys()) > 1}
    known = {name: parts for name, parts in whole.items() if "K" in parts}
    with naming_file(paths[0]):
        cameras = [_camera(name, parts, sizes) for name, parts in (posed or known).items()]
        if not cameras:
            raise CalibrationError("has no camera matrix.")
    return sorted(cameras, key=lambda camera: camera.name)


@errors_name_file
def _merge(path: Path, found: dict[str, dict[str, Array]]) -> None:
    """Add the values of a file to those found in other files, by camera name and role."""
    for name, parts in _parts_of(path).items():
        own = found.setdefault(name, {})
        twice = [role for role in parts if role in own and not np.array_equal(parts[role], own[role])]
        if twice:
            raise CalibrationError(
                f"and another file in the folder have different values of {twice[0]} for camera {name or path.stem}.",
                hint="Give each camera its own file and name.",
            )
        own.update(parts)


def _parts_of(path: Path) -> dict[str, dict[str, Array]]:
    """Return the matrices and numbers of a file, by camera name ("" if unnamed) and role."""
    out: dict[str, dict[str, Array]] = {}
    seen: set[str] = set()
    for key, shape, words in _values(path):
        check_lens_model("the file", {key: " ".join(words)})
        for role, pattern in _ROLES.items():
            named = re.fullmatch(rf"{pattern}(?:_?(?P<camera>\d+|(?<=_)[\w-]+))?", key, re.IGNORECASE)
            if named is None or (not shape and role not in ("width", "height")):
                continue
            if key in seen:
                raise CalibrationError(
                    f'has "{key}" twice.', hint="Write one file per camera, or names such as K_left, K_right."
                )
            seen.add(key)
            parts = out.setdefault(named["camera"] or "", {})
            if not (role == "R" and parts.get("R") is not None and parts["R"].shape == (3, 3)):
                parts[role] = _array(key, shape, words)
            break
    return {path.stem: out[""]} if set(out) == {""} else out


def _array(key: str, shape: tuple[int, ...], words: list[str]) -> Array:
    # OpenCV writes .Nan and -.Inf, which float() rejects
    plain = [re.sub(r"^([-+]?)\.(?=nan|inf)", r"\1", word.lower()) for word in words]
    try:
        data = np.array([float(word) for word in plain]).reshape(shape)
    except ValueError as error:
        what = "does not match its rows and cols" if shape else f"is {' '.join(words):.40}, which is not a number"
        raise CalibrationError(f'"{key}" {what}.') from error
    if not np.isfinite(data).all():
        raise CalibrationError(f'"{key}" has a value that is not finite.')
    return data


def _values(path: Path) -> Iterator[tuple[str, tuple[int, ...], list[str]]]:
    """Yield the name, shape and tokens of each top-level value; the shape of scalars and text is ()."""
    suffix = path.suffix.lower()
    if suffix == ".xml":
        for node in parsed_xml(path):
            rows, cols = node.findtext("rows"), node.findtext("cols")
            if node.find("data") is not None and (rows or "").strip().isdecimal() and (cols or "").strip().isdecimal():
                yield node.tag, (int(rows or 0), int(cols or 0)), node.findtext("data", "").split()
            elif not len(node):
                yield node.tag, (), [(node.text or "").strip().strip('"')]
        return
    if suffix == ".json":
        stored = read_json(path, _MOST_BYTES)
        for name, value in stored.items() if isinstance(stored, dict) else ():
            if isinstance(value, dict) and isinstance(value.get("data"), list):
                rows, cols = value.get("rows"), value.get("cols")
                shape = (rows, cols) if isinstance(rows, int) and isinstance(cols, int) else (-1, -1)
                yield name, shape, [str(word) for word in value["data"]]
            elif not isinstance(value, dict | list):
                yield name, (), [str(value)]
        return
    text = read_text(path, _MOST_BYTES)
    for match in _MATRIX.finditer(text):
        yield match["name"], (int(match["rows"]), int(match["cols"])), match["data"].replace(",", " ").split()
    for match in _VALUE.finditer(text):
        yield match["name"], (), [match["value"].split(" #")[0].strip().strip("\"'")]


def _is_opencv(path: Path) -> int:
    """Return 1 for YAML, 2 for XML and JSON with OpenCV's markers, 0 for other files."""
    suffix = path.suffix.lower()
    if suffix in _YAML or suffix not in (".xml", ".json") or not path.is_file():
        return int(suffix in _YAML)
    with open(path, "rb") as file:
        beginning = file.read(_BEGINNING)
    return 2 * ((b"<opencv_storage" if suffix == ".xml" else b'"opencv-matrix"') in beginning)


def _stored(path: Path) -> list[Path]:
    if path.is_dir():
        return [file for file in files_in(path, *_YAML, ".xml", ".json") if _is_opencv(file)]
    pair = path.parent / path.name.replace("intri", "extri", 1)
    return [path, pair] if path.stem in ("intri", "intrinsics") and pair.exists() else [path]


def _camera(name: str, parts: Mapping[str, Array], sizes: Mapping[str, Size]) -> Camera:
    lacking = [role for role in ("K", "R", "T") if role not in parts]
    if lacking:
        raise CalibrationError(
            f"camera {name} has no {lacking[0]}.", hint="Both pose (R, T) and camera matrix (K) are needed."
        )
    if "width" in parts and "height" in parts:
        sides = np.array([parts["width"], parts["height"]], np.float64).ravel()
        if sides.size != 2 or not ((sides >= 1) & (sides <= _MOST_PX)).all():
            raise CalibrationError(
                f"camera {name} has image size {sides.tolist()} px; width and height must be 1 to 1e6 px."
            )
        size = (int(sides[0]), int(sides[1]))
    else:
        size = known_size(name, sizes)
    R = so3_exp(parts["R"].ravel()) if parts["R"].size == 3 else parts["R"]
    K, T, lens = parts["K"], parts["T"].ravel(), parts.get("dist", np.zeros(0)).ravel()
    if K.shape != (3, 3) or R.shape != (3, 3) or T.shape != (3,) or lens.size not in (0, 4, 5, 8, 12, 14):
        raise CalibrationError(f"camera {name} has a matrix of the wrong size.")
    if lens[8:].any():
        raise CalibrationError(
            f"camera {name} has thin-prism or tilt coefficients; only the first 8 coefficients are supported."
        )
    if rigidity_defect(make_transform(R, np.zeros(3))) > _LARGEST_DEFECT or not np.isfinite(K).all():
        raise CalibrationError(f"camera {name} has a rotation that is not orthonormal.")
    return Camera(name, size, K, lens[:8], make_transform(R, T))


FORMAT = CameraFormat(
    lambda path: len(_stored(path)[:1]) if path.is_dir() else _is_opencv(path),
    lambda path, sizes: load_opencv(_stored(path), sizes),
    _stored,
    lacks_sizes=True,
)
