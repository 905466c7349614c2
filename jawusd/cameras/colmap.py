"""Read and write the cameras of COLMAP text models (https://colmap.github.io/format.html).

`cameras.txt` contains the intrinsics. `images.txt` contains two lines per image: the rotation (w, x, y, z) and
translation from world to camera, and the image's points, which may be omitted. The centre of the top-left pixel is at
(0.5, 0.5); in OpenCV it is at (0, 0).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError, FormatError, errors_name_file, naming_file
from jawusd.base.tables import is_number, read_text
from jawusd.cameras.files import (
    MOST_BYTES,
    CameraFormat,
    Size,
    cameras_of_images,
    corner_matrix,
    files_in,
    folder_of,
    numbers,
)
from jawusd.formats.atomic import write_text_atomic
from jawusd.geometry import Camera, make_transform, matrix_from_wxyz, wxyz_from_matrix

_FILES = ("cameras.txt", "images.txt")
# For each camera model: its focal length parameters (f is shared by x and y), and the number of distortion
# coefficients, in OpenCV's order, after the principal point.
_MODELS = {
    "SIMPLE_PINHOLE": ("f", 0),
    "PINHOLE": ("fxfy", 0),
    "SIMPLE_RADIAL": ("f", 1),
    "RADIAL": ("f", 2),
    "OPENCV": ("fxfy", 4),
    "FULL_OPENCV": ("fxfy", 8),
}
_COUNTED = re.compile(r"^# Number of images: (\d+)", re.MULTILINE)
_POINTS = re.compile(r"(?:\S+ \S+ -?\d+(?: |$))+")
_LARGEST_SKEW = 1e-9


def load_colmap(folder: Path) -> list[Camera]:
    """Read a COLMAP text model; return the cameras sorted by name, in the model's unit.

    All images of a camera must have the same pose and lens, since cameras of a capture are static.

    Raises:
        CalibrationError: a file is missing, a value is missing or wrong, or the camera model is not supported.
    """
    lenses = _lenses(folder / "cameras.txt")
    path = folder / "images.txt"
    images = []
    with naming_file(path):
        for row in _image_rows(path):
            if row[8] not in lenses:
                raise CalibrationError(f"image {row[9]} refers to camera {row[8]}, which is not in cameras.txt.")
            q, t = np.split(numbers(" ".join(row[1:8]), 7, f"image {row[9]}"), [4])
            if not np.linalg.norm(q) > 0:
                raise CalibrationError(f"image {row[9]} has a zero quaternion.")
            images.append(Camera(" ".join(row[9:]), *lenses[row[8]], make_transform(matrix_from_wxyz(q), t)))
        if not images:
            raise CalibrationError("has no images.")
        counted = _COUNTED.search(read_text(path, MOST_BYTES))
        if counted is not None and int(counted[1]) > len(images):
            raise CalibrationError(
                f"is truncated: it has {len(images)} of the {counted[1]} images in its header.",
                hint='Export the model again; if images were removed by hand, correct "# Number of images".',
            )
        return cameras_of_images(images)


def _image_rows(path: Path) -> Iterator[list[str]]:
    """Yield the words of each image line; a line of points, three numbers per point, may follow it."""
    after_image = False
    for row in _rows(path):
        # a point is (x, y, ID of the 3D point)
        if not row or (after_image and _POINTS.fullmatch(" ".join(row))):
            after_image = False
            continue
        if len(row) < 10 or not all(is_number(word) for word in row[:9]):
            raise CalibrationError(
                f'"{" ".join(row):.80}" is not an image line; expected ID, 4 + 3 pose values, camera ID and name.'
            )
        after_image = True
        yield row


def _rows(path: Path) -> list[list[str]]:
    """Return the words of each line, without comment lines."""
    try:
        text = read_text(path, MOST_BYTES)
    except FormatError as error:
        binary = path.with_suffix(".bin").exists() and not path.exists()
        convert = "colmap model_converter --input_path . --output_path . --output_type TXT"
        raise CalibrationError(
            f"cannot be read ({error.message.rstrip('.')}).",
            hint=f"This model is binary; convert it to text: {convert}"
            if binary
            else "A COLMAP text model has cameras.txt and images.txt.",
        ) from error
    return [line.split() for line in text.split("\n") if not line.lstrip().startswith("#")]


@errors_name_file
def _lenses(path: Path) -> dict[str, tuple[Size, Array, Array]]:
    """Return size, K (3, 3) and distortion of each camera by its ID."""
    return {row[0]: _lens(row) for row in _rows(path) if row}


def _lens(row: list[str]) -> tuple[Size, Array, Array]:
    if len(row) < 5 or row[1] not in _MODELS:
        found = row[1] if len(row) > 1 else "nothing"
        raise CalibrationError(
            f"camera {row[0]} has the model {found}; it must be one of {', '.join(_MODELS)}.",
            hint="Undistort the footage first, or solve again with --ImageReader.camera_model OPENCV.",
        )
    focal, terms = _MODELS[row[1]]
    expected = 2 + (3 if focal == "f" else 4) + terms
    values = numbers(" ".join(row[2:]), expected, f"camera {row[0]} of the model {row[1]}")
    size = (int(values[0]), int(values[1]))
    fx, fy, cx, cy = (values[2], *values[2:5]) if focal == "f" else values[2:6]
    distortion = values[expected - terms :]
    if 0 < terms < 4:  # pad a model that has only radial terms
        distortion = np.concatenate([distortion, np.zeros(4 - terms)])
    return size, corner_matrix(f"camera {row[0]}", fx, fy, cx, cy), distortion


FORMAT = CameraFormat(
    lambda path: (
        path.name in _FILES or any(file.stem in ("cameras", "images") for file in files_in(path, ".txt", ".bin"))
    ),
    lambda path, _: load_colmap(folder_of(path)),
    lambda path: [folder_of(path) / name for name in _FILES],
)


def save_colmap(folder: Path, cameras: Sequence[Camera]) -> list[Path]:
    """Write cameras as a COLMAP text model in mm, with one image `NAME.png` per camera and an empty `points3D.txt`.

    Raises:
        CalibrationError: a camera has pixel skew, which COLMAP's camera models lack.
        OutputError: a file cannot be written.
    """
    lenses = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, camera in enumerate(cameras, start=1):
        (fx, skew, cx), (_, fy, cy) = camera.K[:2]
        if abs(skew) > _LARGEST_SKEW * fx:
            raise CalibrationError(f"camera {camera.name} has pixel skew, which COLMAP does not support.")
        lens = np.pad(camera.distortion, (0, 8 - camera.distortion.size))
        # COLMAP's image origin is the corner of the top-left pixel.
        values = np.concatenate([[fx, fy, cx + 0.5, cy + 0.5], lens])
        shown = " ".join(repr(float(value)) for value in values)
        lenses.append(f"{number} FULL_OPENCV {camera.size_px[0]} {camera.size_px[1]} {shown}")
        T = camera.T_cam_world
        pose = np.concatenate([wxyz_from_matrix(T[:3, :3]), T[:3, 3]])
        images += [f"{number} {' '.join(repr(float(value)) for value in pose)} {number} {camera.name}.png", ""]
    texts = {"cameras.txt": lenses, "images.txt": images, "points3D.txt": ["# no points"]}
    for name, lines in texts.items():
        write_text_atomic(folder / name, "\n".join(lines) + "\n")
    return [folder / name for name in texts]
