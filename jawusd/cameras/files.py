"""Load calibrations of all supported programs; the format is recognised by file name or content.

Every module of this package that defines a CameraFormat named FORMAT (see `parts`) is registered as a format. Files of
no registered format are read as TOML of aniposelib, Pose2Sim or Caliscope by `calibration`.
"""

from __future__ import annotations

import os
import pkgutil
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path

from jawusd.base.errors import CalibrationError
from jawusd.base.inputs import check_input
from jawusd.cameras.calibration import load_calibration
from jawusd.cameras.parts import CameraFormat, Size
from jawusd.geometry import Camera, make_transform

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


@cache
def _formats() -> list[CameraFormat]:
    names = sorted(module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)]))
    modules = [import_module(f"{__package__}.{name}") for name in names]
    return [module.FORMAT for module in modules if hasattr(module, "FORMAT")]


def _toml(path: Path, _: Mapping[str, Size]) -> list[Camera]:
    if path.is_dir():
        raise CalibrationError("is a folder without cameras in a supported format.", path=path, hint=_INSTEAD)
    if path.suffix.lower() in _NOT_READ:
        what = _NOT_READ[path.suffix.lower()]
        raise CalibrationError(f"is a file of {what}; this format is not supported.", path=path, hint=_INSTEAD)
    return load_calibration(path)


_TOML = CameraFormat(lambda path: 0, _toml)


def _format_of(path: Path) -> CameraFormat:
    return max([_TOML, *_formats()], key=lambda one: one.reads(path))


def load_cameras_file(
    path: str | os.PathLike[str], unit_mm: float = 1.0, sizes: Mapping[str, Size] | None = None
) -> list[Camera]:
    """Read cameras from a calibration in any supported format, in file order; lengths in mm, OpenCV axes and pixels.

    Args:
        path: TOML of aniposelib, Pose2Sim or Caliscope; a COLMAP text model (its folder or one of its files);
            nerfstudio's transforms.json; Metashape XML; RealityScan CSV, or (a folder of) XMP; OpenCV YAML, XML or
            JSON; or 3DEqualizer's Nuke script (or its folder).
        unit_mm: the file's unit of length [mm].
        sizes: (width, height) [px] of the images by camera, for formats without them; see `lacks_sizes`.

    Raises:
        CalibrationError: a value is missing or wrong, or the camera model is not supported.
        FormatError: the file is damaged.
    """
    path = Path(path)
    if not path.is_dir():
        check_input(path, CalibrationError)
    cameras = _format_of(path).load(path, {} if sizes is None else sizes)
    poses = [make_transform(camera.T_cam_world[:3, :3], unit_mm * camera.T_cam_world[:3, 3]) for camera in cameras]
    return [replace(camera, T_cam_world=pose) for camera, pose in zip(cameras, poses, strict=True)]


def calibration_files(path: Path) -> list[Path]:
    """Return all files that belong to a calibration."""
    return _format_of(path).files(path)


def lacks_sizes(path: Path) -> bool:
    """Return whether a calibration's format lacks the image sizes."""
    return _format_of(path).lacks_sizes
