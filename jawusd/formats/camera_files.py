"""Calibrations of other programs, recognised by their names.

TOML of aniposelib, Pose2Sim and Caliscope: `calibration`. XML of Metashape and XMP of RealityScan: `camera_xml`. CSV of
RealityScan and YAML of OpenCV: `camera_tables`. Nuke script of 3DEqualizer: `camera_3de`. Here: COLMAP text and
nerfstudio JSON.

COLMAP: `cameras.txt` and `images.txt` (https://colmap.github.io/format.html); rotation (w, x, y, z) and translation
take world to camera. nerfstudio: `transforms.json` (https://docs.nerf.studio/quickstart/data_conventions.html);
camera-to-world with OpenGL axes (x right, y up, z backward). Both put the centre of the top-left pixel at (0.5, 0.5),
OpenCV and jawusd at (0, 0).
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from jawusd.errors import CalibrationError
from jawusd.formats.calibration import load_calibration
from jawusd.formats.camera_3de import files_of_3de, load_3de
from jawusd.formats.camera_tables import load_opencv_yaml, load_realityscan_csv
from jawusd.formats.camera_xml import load_metashape, load_realityscan_xmp
from jawusd.geometry import Camera, make_transform, matrix_from_wxyz, rigidity_defect, se3_inverse
from jawusd.geometry.arrays import Array
from jawusd.inputs import check_input

_COLMAP = ("cameras.txt", "images.txt")
_YAML = (".yml", ".yaml")
_HALF_PX = 0.5
_NOT_READ = {
    ".3de": "3DEqualizer's project",
    ".mel": "MEL",
    ".ma": "Maya",
    ".mb": "Maya",
    ".fbx": "FBX",
    ".chan": "curves",
}
_INSTEAD = "Export the cameras for Nuke (.nk, from 3DEqualizer) or as USD; `jawusd cameras -h` lists what is read."
# Per COLMAP model: which parameters are fx, fy, cx, cy and, from there on, OpenCV's distortion; SIMPLE ones share f.
_MODELS = {
    "SIMPLE_PINHOLE": ("f", 0),
    "PINHOLE": ("fxfy", 0),
    "SIMPLE_RADIAL": ("f", 1),
    "RADIAL": ("f", 2),
    "OPENCV": ("fxfy", 4),
    "FULL_OPENCV": ("fxfy", 8),
}
# Images of one camera may differ this much before they count as a moving camera.
_MOVED_RAD, _MOVED_SHARE = 1e-3, 1e-3
_MAX_BYTES = 64 << 20
_MOST_SCALE = 1e9
_MOST_VALUE = 1e300
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def load_cameras_file(
    path: str | os.PathLike[str], unit_mm: float = 1.0, sizes: Mapping[str, tuple[int, int]] | None = None
) -> list[Camera]:
    """Read cameras of any known kind of calibration, in the file's order: lengths in mm, OpenCV axes and pixels.

    Args:
        path: TOML of aniposelib, Pose2Sim or Caliscope, a COLMAP text model (its folder or one of its files),
            nerfstudio's transforms.json, Metashape XML, RealityScan CSV or (a folder of) XMP, OpenCV YAML, or
            3DEqualizer's Nuke script (or its folder).
        unit_mm: length of the file's unit.
        sizes: (width, height) [px] of the pictures by camera, for formats that do not hold them; see `lacks_sizes`.

    Raises:
        CalibrationError: a value is missing or wrong, or the camera model is not supported.
        FormatError: the file is damaged.
    """
    path = Path(path)
    suffix, known = path.suffix.lower(), {} if sizes is None else sizes
    if suffix == ".nk" or _others(path, ".nk"):
        cameras = load_3de(path, known)
    elif path.name in _COLMAP or (path.is_dir() and not _others(path)):
        cameras = load_colmap(path if path.is_dir() else path.parent)
    elif suffix == ".json":
        cameras = load_nerfstudio(path)
    elif suffix == ".xml":
        cameras = load_metashape(path)
    elif suffix == ".csv":
        cameras = load_realityscan_csv(path, known)
    elif suffix == ".xmp" or _others(path, ".xmp"):
        cameras = load_realityscan_xmp(path if path.is_dir() else path.parent, known)
    elif suffix in _YAML or path.is_dir():
        cameras = load_opencv_yaml(calibration_files(path), known)
    elif suffix in _NOT_READ:
        raise CalibrationError(f"is a file of {_NOT_READ[suffix]}, which is not read.", path=path, hint=_INSTEAD)
    else:
        cameras = load_calibration(path)
    poses = [make_transform(camera.T_cam_world[:3, :3], unit_mm * camera.T_cam_world[:3, 3]) for camera in cameras]
    return [replace(camera, T_cam_world=pose) for camera, pose in zip(cameras, poses, strict=True)]


def calibration_files(path: Path) -> list[Path]:
    """Return the files that make up a calibration."""
    folder = path if path.is_dir() else path.parent
    if path.suffix.lower() == ".nk" or _others(path, ".nk"):
        return files_of_3de(path)
    if path.suffix.lower() == ".xmp" or _others(path, ".xmp"):
        return sorted(folder.glob("*.xmp"))
    if path.is_dir() and (found := _others(path)):
        return found
    if path.is_dir() or path.name in _COLMAP:
        return [folder / name for name in _COLMAP]
    pair = folder / path.name.replace("intri", "extri", 1)
    return [path, pair] if path.stem in ("intri", "intrinsics") and pair.exists() else [path]


def lacks_sizes(path: Path) -> bool:
    """Tell whether a calibration's format does not hold the size of the pictures."""
    return path.is_dir() or path.suffix.lower() in (".csv", ".xmp", ".nk", *_YAML)


def _others(path: Path, *suffixes: str) -> list[Path]:
    """Return the files in a folder that are a calibration with a file per camera."""
    if not path.is_dir():
        return []
    return sorted(file for file in path.iterdir() if file.suffix.lower() in (suffixes or (".xmp", *_YAML)))


def load_colmap(folder: str | os.PathLike[str]) -> list[Camera]:
    """Read a COLMAP text model; return the cameras by name, in the model's unit.

    An image in a folder is named after it (`cam0/0001.png` is cam0), else after its file (`cam0.png`). Several images
    of one camera must share its pose: the cameras of a capture stand still.

    Raises:
        CalibrationError: see `load_cameras_file`.
    """
    folder = Path(folder)
    path = folder / "images.txt"
    lenses = {}
    for row in _rows(folder / "cameras.txt"):
        lenses[row[0]] = _colmap_lens(folder / "cameras.txt", row)
    cameras: dict[str, Camera] = {}
    for row in _rows(path, every=2):
        if len(row) < 10:
            raise CalibrationError(
                f'"{" ".join(row)}" is not an image: an id, 4 + 3 pose values, a camera id and a name are needed.',
                path=path,
            )
        if row[8] not in lenses:
            raise CalibrationError(f"image {row[9]} names camera {row[8]}, which cameras.txt does not hold.", path=path)
        q, t = np.split(_floats(path, row[1:8]), [4])
        if not np.linalg.norm(q) > 0:
            raise CalibrationError(f"image {row[9]} has a quaternion of length 0.", path=path)
        size, K, distortion = lenses[row[8]]
        name = _camera_name(" ".join(row[9:]))
        _add(cameras, Camera(name, size, K, distortion, make_transform(matrix_from_wxyz(q), t)), path)
    if not cameras:
        raise CalibrationError("holds no images.", path=path)
    return [cameras[name] for name in sorted(cameras)]


def load_nerfstudio(path: str | os.PathLike[str]) -> list[Camera]:
    """Read nerfstudio's transforms.json; return the cameras by name, in the file's unit before its `applied_scale`.

    Raises:
        CalibrationError: see `load_cameras_file`.
    """
    path = Path(path)
    data = _json(path)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise CalibrationError('has no "frames".', path=path)
    scale = data.get("applied_scale", 1.0)
    if not isinstance(scale, int | float) or not 0 < scale < _MOST_SCALE:
        raise CalibrationError(f'"applied_scale" is {scale!r:.50}, allowed is a number above 0.', path=path)
    cameras: dict[str, Camera] = {}
    for index, frame in enumerate(frames):
        where = f"frames[{index}]"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise CalibrationError(f'{where} has no "file_path".', path=path)
        size, K, distortion = _nerfstudio_lens(path, {**data, **frame}, where)
        try:
            T_world_gl = np.array(frame["transform_matrix"], dtype=np.float64)
        except (KeyError, ValueError, TypeError, OverflowError) as error:
            raise CalibrationError(f'{where} has no "transform_matrix" of 4 x 4 numbers.', path=path) from error
        T_world_gl = np.vstack([T_world_gl, [0, 0, 0, 1]]) if T_world_gl.shape == (3, 4) else T_world_gl
        if T_world_gl.shape != (4, 4) or not np.isfinite(T_world_gl).all() or rigidity_defect(T_world_gl) > 1e-4:
            raise CalibrationError(f"{where} transform_matrix is not a rigid 4 x 4 matrix.", path=path)
        T_world_gl[:3, 3] /= scale
        T_cam_world = se3_inverse(T_world_gl @ _OPENGL)
        _add(cameras, Camera(_camera_name(frame["file_path"]), size, K, distortion, T_cam_world), path)
    return [cameras[name] for name in sorted(cameras)]


def _rows(path: Path, every: int = 1) -> list[list[str]]:
    """Return the words of every n-th line; an image's second line lists its points and may be empty."""
    check_input(path, CalibrationError)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise CalibrationError(f"is {path.stat().st_size} bytes, at most {_MAX_BYTES} are read.", path=path)
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(
            f"cannot be read ({error}).", path=path, hint="A COLMAP text model has cameras.txt and images.txt."
        ) from error
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    if every == 1:
        lines = [line for line in lines if line.strip()]
    return [line.split() for line in lines[::every] if line.strip()]


def _floats(path: Path, words: Iterable[str]) -> Array:
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise CalibrationError(f'"{" ".join(words)}" are not numbers.', path=path) from error
    if not np.isfinite(values).all():
        raise CalibrationError(f'"{" ".join(words)}" holds a value that is not finite.', path=path)
    return values


def _colmap_lens(path: Path, row: list[str]) -> tuple[tuple[int, int], Array, Array]:
    if len(row) < 5 or row[1] not in _MODELS:
        found = row[1] if len(row) > 1 else "nothing"
        raise CalibrationError(
            f"camera {row[0]} has the model {found}, allowed are {', '.join(_MODELS)}.",
            path=path,
            hint="Undistort the footage first, or solve again with --ImageReader.camera_model OPENCV.",
        )
    focal, terms = _MODELS[row[1]]
    values = _floats(path, row[2:])
    expected = 2 + (3 if focal == "f" else 4) + terms
    if len(values) != expected:
        raise CalibrationError(f"camera {row[0]} has {len(values)} values, {row[1]} needs {expected}.", path=path)
    size = (int(values[0]), int(values[1]))
    fx, fy, cx, cy = (values[2], *values[2:5]) if focal == "f" else values[2:6]
    distortion = values[expected - terms :]
    if 0 < terms < 4:  # radial terms only
        distortion = np.concatenate([distortion, np.zeros(4 - terms)])
    return size, _matrix(path, f"camera {row[0]}", fx, fy, cx, cy), distortion


def _nerfstudio_lens(path: Path, values: dict[str, object], where: str) -> tuple[tuple[int, int], Array, Array]:
    model = values.get("camera_model", "OPENCV")
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL") or values.get("is_fisheye"):
        raise CalibrationError(
            f'{where} has the camera model "{model}"; only perspective models are read.',
            path=path,
            hint="Undistort the footage first, or calibrate with the OPENCV model.",
        )
    found = {}
    for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4"):
        value = values.get(key, values.get("fl_x") if key == "fl_y" else 0.0 if key[0] in "kp" else None)
        if not isinstance(value, int | float) or not abs(value) < _MOST_VALUE:
            raise CalibrationError(f'{where} has no number "{key}".', path=path)
        found[key] = float(value)
    if found["k4"] != 0:
        # nerfstudio's k4 is a fourth power of r^2; OpenCV's fourth coefficient is in a denominator.
        raise CalibrationError(f"{where} has k4 = {found['k4']:g}, allowed is 0.", path=path)
    K = _matrix(path, where, found["fl_x"], found["fl_y"], found["cx"], found["cy"])
    lens = np.array([found[key] for key in ("k1", "k2", "p1", "p2", "k3")])
    return (int(found["w"]), int(found["h"])), K, lens


def _matrix(path: Path, where: str, fx: float, fy: float, cx: float, cy: float) -> Array:
    if not (fx > 0 and fy > 0):
        raise CalibrationError(f"{where} has the focal lengths {fx:g} and {fy:g} px, allowed are > 0 px.", path=path)
    return np.array([[fx, 0.0, cx - _HALF_PX], [0.0, fy, cy - _HALF_PX], [0.0, 0.0, 1.0]])


def _camera_name(file: str) -> str:
    image = PurePosixPath(file.replace("\\", "/"))
    folder = image.parent.name
    return image.stem if folder in ("", ".", "images") else folder


def _add(cameras: dict[str, Camera], camera: Camera, path: Path) -> None:
    """Add a camera, or check that it stands where an earlier image of it stood."""
    known = cameras.setdefault(camera.name, camera)
    turned = np.abs(known.T_cam_world[:3, :3] - camera.T_cam_world[:3, :3]).max()
    moved = np.linalg.norm(known.centre_world() - camera.centre_world())
    if turned > _MOVED_RAD or moved > _MOVED_SHARE * np.linalg.norm(known.centre_world()) + 1e-12:
        raise CalibrationError(
            f"camera {camera.name} stands in different places in its images.",
            path=path,
            hint="Name the images after the cameras, one per camera (cam0.png) or one folder each (cam0/0001.png).",
        )


def _json(path: Path) -> dict[str, object]:
    check_input(path, CalibrationError)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise CalibrationError(f"is {path.stat().st_size} bytes, at most {_MAX_BYTES} are read.", path=path)
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise CalibrationError(f"is not JSON that can be read ({error}).", path=path) from error
    if not isinstance(data, dict):
        raise CalibrationError("is not a JSON object.", path=path)
    return data
