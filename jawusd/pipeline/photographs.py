"""Photographs of teeth that are together: the bite of scans that nobody registered, and where each was taken."""

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
_COLOURS = np.array([[60, 220, 60], [60, 160, 255]], np.uint8)  # upper, lower; red, green, blue
# Share of bright pixels above which a picture shows filled areas: lines of 4 px around 20 teeth cover 4 per cent.
_FILLED = 0.08


@dataclass(frozen=True, eq=False)
class PhotographFiles:
    """Hold what was written."""

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
    """Align scans with outlines drawn in photographs, and write poses, lenses, bite and overlays.

    Args:
        outlines: a picture per photograph, all of one bite and one camera: bright lines along the outlines of the
            teeth on black, or areas of the teeth, one value for each.
        upper_teeth, lower_teeth: scans, each in any frame.
        out: folder of photos.json and an overlay per photograph.
        force: overwrite what is there.

    Raises:
        CaptureError: a picture or scan cannot be read, or two pictures have one name.
        TrackingError: hardly any line in a picture, or hardly any face in a scan.
        OutputError: the output exists already, or cannot be written.
    """
    paths, folder = [Path(path) for path in outlines], Path(out)
    names = [path.stem for path in paths]
    for name in names:
        if names.count(name) > 1:
            raise CaptureError(f'two pictures are called "{name}".', hint="Photographs go by their file names.")
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
    """Return the lines of a gray picture (h, w), or the borders of its areas if it shows areas.

    Raises:
        TrackingError: the picture shows hardly any line.
    """
    if np.count_nonzero(picture) > _FILLED * picture.size:
        border = np.zeros(picture.shape, bool)
        border[:, 1:] |= picture[:, 1:] != picture[:, :-1]
        border[1:] |= picture[1:] != picture[:-1]
        picture = np.where(border, 255, 0).astype(np.uint8)
    return read_lines(picture, name)


def drawn_over(picture: NDArray[np.uint8], found: PhotoAlignment, number: int) -> NDArray[np.uint8]:
    """Return an RGB picture (h, w, 3) with the aligned crowns' outlines, upper green and lower blue."""
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


def photograph_lines(found: PhotographFiles) -> list[str]:
    """Return the result as lines for people."""
    lines = ["photograph           focal [px]  mirrored  outlines rms / median [px at 1440]  alone [mm]"]
    for photo in found.result.photos:
        lines.append(
            f"{photo.name:20} {photo.focal_px:10.0f}  {'yes' if photo.mirrored else 'no':>8}  "
            f"{photo.outline_rms_px:17.1f} / {photo.outline_median_px:<14.1f}  {photo.alone_off_mm:9.2f}"
        )
    lines.append("T_upper_lower [mm]")
    lines += ["  ".join(f"{value:12.6f}" for value in row) for row in found.result.T_upper_lower]
    lines += [finding.line() for finding in found.result.findings]
    return [*lines, *map(str, (found.file, *found.overlays))]


def _read(path: Path) -> NDArray[np.uint8]:
    picture = read_gray(path)
    if picture is None:
        raise CaptureError("is no picture that can be read.", path=path, hint="Check the path; save it as PNG, 8 bits.")
    return picture
