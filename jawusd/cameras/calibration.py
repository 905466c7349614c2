"""Camera calibration as TOML of aniposelib (lengths in mm), or of Pose2Sim and Caliscope (same keys, in metres).

Each table `[cam_0]`, `[cam_1]`, ... has name, size, matrix, distortions, rotation (Rodrigues vector) and translation;
the last two map world to camera coordinates. Pose2Sim names the tables after its cameras; Caliscope nests them in
`[cameras]`, by port.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, CalibrationError, errors_name_file
from jawusd.cameras.files import CameraFormat, Size, check_lens_model
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.text import read_toml
from jawusd.geometry import Camera, make_transform, rigidity_defect, so3_exp, so3_log

# Maximum entry of R R^T - I for a rotation to be accepted; rotations written with 6 digits stay below it.
_ROTATION_TOLERANCE = 1e-4
_NOT_READ = {
    ".3de": "3DEqualizer's project",
    ".mel": "MEL",
    ".ma": "Maya",
    ".mb": "Maya",
    ".fbx": "FBX",
    ".chan": "curves",
    ".bin": "a binary model of COLMAP",
    ".npz": "numpy",
    ".mat": "MATLAB",
}
_INSTEAD = "Export the cameras for Nuke (.nk, from 3DEqualizer) or as USD; `jawusd cameras -h` lists all formats."
_CAMERA_TABLE = re.compile(r"^cam_\d+$")


@errors_name_file
def load_calibration(path: AnyPath) -> list[Camera]:
    """Read the cameras of a calibration file.

    Raises:
        CalibrationError: a value is missing, has the wrong shape, is not finite, or a rotation is invalid.
        FormatError: the file is not TOML.
    """
    path = Path(path)
    data = read_toml(path)
    tables = sorted((k for k in data if _CAMERA_TABLE.match(k)), key=lambda k: int(k[4:]))
    if not tables:
        below = data.get("cameras")
        if isinstance(below, dict):  # Caliscope nests the camera tables in [cameras]
            data = {f"cam_{port}": table for port, table in below.items()}
        tables = [key for key, table in data.items() if isinstance(table, dict) and "matrix" in table]
    if not tables:
        raise CalibrationError('has no camera tables such as "[cam_0]", "[cam_1]".')
    cameras = [_camera(table, data[table]) for table in tables]
    names = [camera.name for camera in cameras]
    if len(set(names)) != len(names):
        raise CalibrationError(f"has cameras with the same name; the names are {', '.join(names)}.")
    return cameras


def _numbers(table: str, values: dict[str, object], key: str, shapes: tuple[tuple[int, ...], ...]) -> Array:
    if key not in values:
        raise CalibrationError(f'[{table}] has no "{key}".')
    try:
        array = np.array(values[key], dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise CalibrationError(f'[{table}] "{key}" is not an array of numbers.') from error
    if array.shape not in shapes:
        allowed = " or ".join(str(s) for s in shapes)
        raise CalibrationError(f'[{table}] "{key}" has shape {array.shape}; expected {allowed}.')
    if not np.isfinite(array).all():
        raise CalibrationError(f'[{table}] "{key}" has a value that is not finite.')
    return array


def _camera(table: str, values: object) -> Camera:
    if not isinstance(values, dict):
        raise CalibrationError(f"[{table}] must be a table.")
    size = _numbers(table, values, "size", ((2,),))
    K = _numbers(table, values, "matrix", ((3, 3),))
    distortion = _numbers(table, values, "distortions", ((0,), (4,), (5,), (8,)))
    rotation = _numbers(table, values, "rotation", ((3,), (3, 3)))
    translation = _numbers(table, values, "translation", ((3,),))
    check_lens_model(f"[{table}]", values)
    if (size < 16).any() or (size != np.round(size)).any():
        raise CalibrationError(f"[{table}] size is {size.tolist()} px; expected two whole numbers of at least 16 px.")
    if K[0, 0] <= 0 or K[1, 1] <= 0 or np.abs(K[[1, 2, 2], [0, 0, 1]]).max() > 0 or K[2, 2] != 1:
        raise CalibrationError(f"[{table}] matrix must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0 px.")
    if rotation.ndim == 1:
        rotation = so3_exp(rotation)
    defect = float(rigidity_defect(make_transform(rotation, np.zeros(3))))
    if defect > _ROTATION_TOLERANCE:
        raise CalibrationError(
            f"[{table}] rotation is not orthonormal: R R^T - I is up to {defect:.2g}; at most "
            f"{_ROTATION_TOLERANCE:g} is allowed.",
            hint="Write the Rodrigues vector of a proper rotation, world to camera.",
        )
    # A rotation written with few digits is only approximately orthonormal.
    rotation = so3_exp(so3_log(rotation))
    name = str(values.get("name", table))
    return Camera(name, (int(size[0]), int(size[1])), K, distortion, make_transform(rotation, translation))


def save_calibration(path: AnyPath, cameras: list[Camera]) -> None:
    """Write cameras as aniposelib TOML, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = []
    for index, camera in enumerate(cameras):
        lines += [
            f"[cam_{index}]",
            f'name = "{camera.name}"',
            f"size = [{camera.size_px[0]}, {camera.size_px[1]}]",
            f"matrix = {camera.K.tolist()}",
            f"distortions = {camera.distortion.tolist()}",
            f"rotation = {so3_log(camera.T_cam_world[:3, :3]).tolist()}",
            f"translation = {camera.T_cam_world[:3, 3].tolist()}",
            "",
        ]
    write_text_atomic(path, "\n".join([*lines, "[metadata]", 'units = "mm"', ""]))


def _load(path: Path, _: Mapping[str, Size]) -> list[Camera]:
    if path.is_dir():
        raise CalibrationError("is a folder without cameras in a supported format.", hint=_INSTEAD)
    if path.suffix.lower() in _NOT_READ:
        what = _NOT_READ[path.suffix.lower()]
        raise CalibrationError(f"is a file of {what}; this format is not supported.", hint=_INSTEAD)
    return load_calibration(path)


FORMAT = CameraFormat(lambda path: 0, _load)  # the fallback for files that no other format reads
