"""Write cameras for other programs; see `files` for the conventions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jawusd.base.errors import CalibrationError, OutputError
from jawusd.formats.atomic import write_text_atomic
from jawusd.geometry import Camera, wxyz_from_matrix

_LARGEST_SKEW = 1e-9


def save_colmap(folder: Path, cameras: Sequence[Camera]) -> list[Path]:
    """Write cameras as a COLMAP text model in mm, one picture `NAME.png` each; `points3D.txt` is empty.

    Raises:
        CalibrationError: a camera has skewed pixels, which COLMAP's models do not have.
        OutputError: a file cannot be written.
    """
    lenses = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, camera in enumerate(cameras, start=1):
        (fx, skew, cx), (_, fy, cy) = camera.K[:2]
        if abs(skew) > _LARGEST_SKEW * fx:
            raise CalibrationError(f"camera {camera.name} has skewed pixels, which COLMAP cannot express.")
        lens = np.pad(camera.distortion, (0, 8 - camera.distortion.size))
        values = np.concatenate([[fx, fy, cx + 0.5, cy + 0.5], lens])  # COLMAP counts from the corner of a pixel
        shown = " ".join(repr(float(value)) for value in values)
        lenses.append(f"{number} FULL_OPENCV {camera.size_px[0]} {camera.size_px[1]} {shown}")
        T = camera.T_cam_world
        pose = np.concatenate([wxyz_from_matrix(T[:3, :3]), T[:3, 3]])
        images += [f"{number} {' '.join(repr(float(value)) for value in pose)} {number} {camera.name}.png", ""]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write here: {error.strerror}.", path=folder) from error
    texts = {"cameras.txt": lenses, "images.txt": images, "points3D.txt": ["# no points"]}
    for name, lines in texts.items():
        write_text_atomic(folder / name, "\n".join(lines) + "\n")
    return [folder / name for name in texts]
