"""Read calibrated cameras from files of any program, and carry them from one program's files to another's."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from jawusd.base.errors import OutputError
from jawusd.cameras.calibration import save_calibration
from jawusd.cameras.colmap import save_colmap
from jawusd.cameras.files import lacks_sizes, load_cameras_file
from jawusd.geometry import Camera

Size = tuple[int, int]
_LEAST_APART_MM = 10.0  # the same as in `capture.camera_checks`, which refuses such a capture
USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz", ".abc")


def read_calibration(path: Path, unit_mm: float, sizes: Callable[[], Mapping[str, Size]]) -> list[Camera]:
    """Read cameras of any known kind of file, stages of OpenUSD among them [mm].

    Args:
        path: the file or folder.
        unit_mm: length of its unit; a stage says its own.
        sizes: returns (width, height) [px] of the pictures by camera; called only if the file does not hold them.

    Raises:
        CalibrationError, FormatError, RigError: the file holds no cameras that can be used.
    """
    if path.suffix.lower() in USD_SUFFIXES:
        from jawusd.rig.cameras import read_cameras

        return read_cameras(path, sizes)
    return load_cameras_file(path, unit_mm, sizes() if lacks_sizes(path) else None)


class SameSize(dict[str, Size]):
    """Hold one size of pictures for whatever camera is asked for."""

    def __init__(self, size: Size | None) -> None:
        super().__init__()
        self._size = size

    def __contains__(self, name: object) -> bool:
        return self._size is not None

    def __missing__(self, name: str) -> Size:
        if self._size is None:
            raise KeyError(name)
        return self._size


def convert_cameras(source: Path, out: Path, unit_mm: float, size: Size | None) -> tuple[list[Camera], list[Path]]:
    """Read cameras and write them in mm: .toml for aniposelib, .usda for OpenUSD, a folder for COLMAP.

    Args:
        source: see `cameras.files.load_cameras_file`; or a stage.
        out: what to write.
        unit_mm: length of the source's unit.
        size: (width, height) [px] of the pictures, for formats that do not say.

    Raises:
        CalibrationError, FormatError, RigError: the source holds no cameras that can be used, or OUT cannot hold them.
        OutputError: the file cannot be written, or has another suffix.
    """
    cameras = read_calibration(source, unit_mm, lambda: SameSize(size))
    suffix = out.suffix.lower()
    if suffix == ".toml":
        save_calibration(out, cameras)
        return cameras, [out]
    if suffix in USD_SUFFIXES[:3]:
        from jawusd.rig.cameras import write_camera_stage

        return cameras, [write_camera_stage(out, cameras)]
    if suffix:
        raise OutputError(
            f'"{suffix}" is not written.', path=out, hint="Name a .toml (aniposelib), a .usda, or a folder (COLMAP)."
        )
    return cameras, save_colmap(out, cameras)


def camera_lines(cameras: list[Camera], files: list[Path]) -> list[str]:
    """Return cameras as text."""
    lines = []
    for camera in cameras:
        where = ", ".join(f"{value:.1f}" for value in np.round(camera.centre_world(), 1) + 0.0)  # not -0.0
        lens = f"{camera.distortion.size} coefficients" if camera.distortion.size else "no distortion"
        width, height = camera.size_px
        lines.append(f"{camera.name}: {width} x {height} px, f {camera.K[0, 0]:.1f} px, {lens}, at {where} mm")
    places = np.array([camera.centre_world() for camera in cameras])
    apart = float(np.linalg.norm(np.ptp(places, axis=0)))
    if len(cameras) > 1 and apart < _LEAST_APART_MM:
        lines.append(f"note: all cameras lie within {apart:.3g} mm; if the source is in metres, give --unit-mm 1000")
    return [*lines, *map(str, files)]
