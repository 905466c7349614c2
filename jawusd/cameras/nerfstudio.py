"""Read nerfstudio's `transforms.json` (https://docs.nerf.studio/quickstart/data_conventions.html).

Its matrices map camera to world with OpenGL axes (x right, y up, z backward). The centre of the top-left pixel is at
(0.5, 0.5); in OpenCV it is at (0, 0).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError, FormatError
from jawusd.cameras.files import MOST_BYTES, UNDISTORT, CameraFormat, Size, cameras_of_images, corner_matrix
from jawusd.formats.text import read_json
from jawusd.geometry import Camera, rigidity_defect, se3_inverse

_MOST_SCALE = 1e9
_MOST_VALUE = 1e300
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def load_nerfstudio(path: Path) -> list[Camera]:
    """Read nerfstudio's transforms.json; return the cameras sorted by name, in the unit before `applied_scale`.

    Raises:
        CalibrationError: a value is missing or wrong, or the camera model is not supported.
    """
    data = _data(path)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise CalibrationError('has no "frames".')
    scale = data.get("applied_scale", 1.0)
    if not isinstance(scale, int | float) or not 0 < scale < _MOST_SCALE:
        raise CalibrationError(f'"applied_scale" is {scale!r:.50}; it must be a number above 0.')
    images = []
    for index, frame in enumerate(frames):
        where = f"frames[{index}]"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise CalibrationError(f'{where} has no "file_path".')
        size, K, distortion = _lens({**data, **frame}, where)
        try:
            T_world_gl = np.array(frame["transform_matrix"], dtype=np.float64)
        except (KeyError, ValueError, TypeError, OverflowError) as error:
            raise CalibrationError(f'{where} has no "transform_matrix" of 4 x 4 numbers.') from error
        T_world_gl = np.vstack([T_world_gl, [0, 0, 0, 1]]) if T_world_gl.shape == (3, 4) else T_world_gl
        if T_world_gl.shape != (4, 4) or not np.isfinite(T_world_gl).all() or rigidity_defect(T_world_gl) > 1e-4:
            raise CalibrationError(f"{where} has a transform_matrix that is not a rigid motion.")
        T_world_gl[:3, 3] /= scale
        images.append(Camera(frame["file_path"], size, K, distortion, se3_inverse(T_world_gl @ _OPENGL)))
    return cameras_of_images(images)


def _lens(values: dict[str, object], where: str) -> tuple[Size, Array, Array]:
    model = values.get("camera_model", "OPENCV")
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL") or values.get("is_fisheye"):
        raise CalibrationError(
            f'{where} has the camera model "{model}"; only perspective models are supported.', hint=UNDISTORT
        )
    found = {}
    for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4"):
        value = values.get(key, values.get("fl_x") if key == "fl_y" else 0.0 if key[0] in "kp" else None)
        if not isinstance(value, int | float) or not abs(value) < _MOST_VALUE:
            raise CalibrationError(f'{where} has no "{key}", or its value is not a number.')
        found[key] = float(value)
    if found["k4"] != 0:
        # nerfstudio's k4 multiplies r^8; OpenCV's fourth coefficient is in a denominator.
        raise CalibrationError(f"{where} has k4 = {found['k4']:g}; it must be 0.")
    K = corner_matrix(where, found["fl_x"], found["fl_y"], found["cx"], found["cy"])
    lens = np.array([found[key] for key in ("k1", "k2", "p1", "p2", "k3")])
    return (int(found["w"]), int(found["h"])), K, lens


def _data(path: Path) -> dict[str, object]:
    try:
        data = read_json(path, MOST_BYTES)
    except FormatError as error:
        raise CalibrationError(f"cannot be read as JSON ({error.message.rstrip('.')}).") from error
    if not isinstance(data, dict):
        raise CalibrationError("is not a JSON object.")
    return data


FORMAT = CameraFormat(lambda path: path.suffix.lower() == ".json", lambda path, _: load_nerfstudio(path))
