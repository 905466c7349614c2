"""Register two scans in occlusion using photographs of the closed bite, and estimate the camera poses."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import CaptureError, explain_missing_packages
from jawusd.formats.atomic import refuse_existing
from jawusd.formats.photographs import AlignedPhotos, save_photographs
from jawusd.media.overlay import save_png
from jawusd.media.pictures import read_gray
from jawusd.meshes.meshio import load_mesh
from jawusd.photographs import Drawing, PhotoAlignment, align_photographs, read_lines, seen_outlines
from jawusd.pipeline.state import Progress, no_progress

RESULT = "photos.json"
_COLOURS = np.array([[60, 220, 60], [60, 160, 255]], np.uint8)  # RGB colours of the upper and lower crowns
# Fraction of bright pixels above which a drawing is read as filled teeth; outlines of 20 teeth, 4 px wide, cover 4 %.
_FILLED = 0.08


@dataclass(frozen=True, eq=False)
class PhotographFiles:
    """Result of an alignment, and the files written."""

    result: AlignedPhotos
    file: Path
    overlays: tuple[Path, ...]


@explain_missing_packages()
def align_photograph_files(
    outlines: Sequence[str | os.PathLike[str]],
    upper_teeth: str | os.PathLike[str],
    lower_teeth: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    force: bool = False,
    progress: Progress = no_progress,
) -> PhotographFiles:
    """Align scans with outlines drawn in photographs, and write camera poses, lenses, scan registration and overlays.

    Args:
        outlines: one drawing per photograph, all of the same bite and from one camera: tooth outlines as bright lines
            on black, or filled teeth, each with its own gray value.
        upper_teeth, lower_teeth: scans, each in any coordinate frame.
        out: folder for photos.json and one overlay per photograph.
        force: overwrite existing files.

    Raises:
        CaptureError: an image or scan cannot be read, or two images have the same name.
        TrackingError: too few outlines in an image, or too few faces in a scan.
        OutputError: the output exists already, or cannot be written.
    """
    paths, folder = [Path(path) for path in outlines], Path(out)
    names = [path.stem for path in paths]
    for name in names:
        if names.count(name) > 1:
            raise CaptureError(
                f'two photographs have the name "{name}".', hint="Photographs are identified by their file names."
            )
    refuse_existing(folder / RESULT, force)
    pictures = [_read(path) for path in paths]
    drawings = [read_drawing(picture, name) for picture, name in zip(pictures, names, strict=True)]
    meshes = [load_mesh(path) for path in (upper_teeth, lower_teeth)]
    found = align_photographs(drawings, meshes, progress)
    overlays = []
    for k, (picture, name) in enumerate(zip(pictures, names, strict=True)):
        overlays.append(folder / f"overlay_{name}.png")
        save_png(overlays[-1], drawn_over(np.repeat(picture[..., None], 3, axis=2), found, k))
    save_photographs(folder / RESULT, found.result)
    return PhotographFiles(found.result, folder / RESULT, tuple(overlays))


def read_drawing(picture: NDArray[np.uint8], name: str) -> Drawing:
    """Return the drawn outlines of a gray drawing (h, w), or the borders of its areas if the teeth are filled.

    Raises:
        TrackingError: the drawing has too few outlines.
    """
    if np.count_nonzero(picture) > _FILLED * picture.size:
        border = np.zeros(picture.shape, bool)
        border[:, 1:] |= picture[:, 1:] != picture[:, :-1]
        border[1:] |= picture[1:] != picture[:-1]
        picture = np.where(border, 255, 0).astype(np.uint8)
    return read_lines(picture, name)


def drawn_over(picture: NDArray[np.uint8], found: PhotoAlignment, number: int) -> NDArray[np.uint8]:
    """Return an RGB image (h, w, 3) with the aligned crowns' outlines, upper green and lower blue."""
    photo, solved = found.bite.photos[number], found.result.photos[number]
    seen = seen_outlines(found.rows.fine, photo, found.bite)
    out = picture.copy()
    column, row = np.round(seen.pixels).astype(int).T
    if solved.mirrored:
        column = picture.shape[1] - 1 - column
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = column + right, row + down
        inside = (x >= 0) & (x < picture.shape[1]) & (y >= 0) & (y < picture.shape[0])
        out[y[inside], x[inside]] = _COLOURS[seen.arch[inside]]
    return out


def _read(path: Path) -> NDArray[np.uint8]:
    picture = read_gray(path)
    if picture is None:
        raise CaptureError("is not a readable image.", path=path, hint="Check the path; save it as 8-bit PNG.")
    return picture
