"""Align photographs of closed teeth: find the pose and focal length of each, and their common bite; draw overlays."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError, explain_missing_packages
from jawusd.formats.atomic import refuse_existing
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import Mesh
from jawusd.formats.photographs import AlignedPhoto, AlignedPhotos, save_photographs
from jawusd.geometry import transform_point, transform_points
from jawusd.media.overlay import save_png
from jawusd.media.pictures import read_gray
from jawusd.meshes.meshio import load_mesh
from jawusd.photographs.drawing import Drawing, read_lines
from jawusd.photographs.search import ArchPair, PhotoStart, find_first, find_next, typical_bites
from jawusd.photographs.solve import Aligner, Bite, Contact, Photo, match, middle_of, seen_outlines
from jawusd.tracking.contour.scan import ARCH_NAMES, Scan, prepare_scan

# Stages of the coarse-to-fine alignment: image scale, and for each step the gate, the maximum residual [mm].
_STAGES = (
    (0.25, (3.0, 3.0, 2.5, 2.5, 2.0, 2.0, 2.0, 2.0)),
    (0.5, (2.0, 2.0, 1.5, 1.5, 1.2, 1.2, 1.0, 1.0)),
    (1.0, (1.0,) * 8),
)
_AT_WIDTH_PX = 1440.0  # reference image width, to which distances in pixels are scaled
_TURN_PX = 10.0  # weight of direction when lines are matched to outlines (see `features`), at the reference width
_CLEAR_MISFIT = 0.2  # maximum misfit of a photograph whose bite initialises the other photographs
_GATE_MM, _MOST_MISFIT = 0.5, 0.45  # gate of the final misfit, and maximum final misfit of scans of the same subject
# Minimum ratio of the misfit with the opposite mirroring to that with the chosen one, for a clear choice.
_SAME_HAND = 1.15
_APART_MM = 1.5  # maximum plausible distance between the bite from one photograph and that from all photographs


@dataclass(frozen=True, eq=False)
class PhotoAlignment:
    """Result of an alignment, with the data that is needed to render it."""

    result: AlignedPhotos
    bite: Bite  # bite and poses for the full-size photographs
    rows: ArchPair


def align_photographs(
    drawings: Sequence[Drawing], meshes: Sequence[Mesh], progress: Callable[[str, int, int], None]
) -> PhotoAlignment:
    """Align both arches with lines drawn in photographs of one bite, taken with one uncalibrated camera.

    Drawings have unique names; the upper and the lower scan [mm] are each in an arbitrary frame. `progress` is called
    with the stage, the number of photographs done, and the total.

    Raises:
        TrackingError: a scan has too few faces.
    """
    scans = [prepare_scan(mesh, name) for mesh, name in zip(meshes, ARCH_NAMES, strict=True)]
    contact = Contact(scans)
    starts = _starts(drawings, scans, contact, progress)
    rows = starts[0].rows
    lines = [one.mirrored() if start.mirrored else one for one, start in zip(drawings, starts, strict=True)]
    bites = [_refined(start.bite, [own], rows, contact) for start, own in zip(starts, lines, strict=True)]
    joint = _together(bites, lines, rows, contact)
    for k in range(len(lines)):
        progress("check", k, len(lines))
        own = Bite(joint.photos[k : k + 1], joint.T_upper_lower, joint.gum_mm)
        bites[k] = _refined(own, lines[k : k + 1], rows, contact)
    progress("check", len(lines), len(lines))
    return PhotoAlignment(_result(joint, bites, starts, rows, contact), joint, rows)


def _starts(
    drawings: Sequence[Drawing], scans: Sequence[Scan], contact: Contact, progress: Callable[[str, int, int], None]
) -> list[PhotoStart]:
    """Return the initial pose of each photograph; the bite found first initialises the other photographs."""
    usual = typical_bites(scans)
    leads: list[tuple[int, PhotoStart]] = []
    for k, drawing in enumerate(drawings):
        progress("search", k, len(drawings))
        leads.append((k, find_first(drawing, scans, usual, contact)))
        if leads[-1][1].misfit < _CLEAR_MISFIT:
            break
    first, lead = min(leads, key=lambda one: one[1].misfit)
    starts = []
    for k, drawing in enumerate(drawings):
        progress("search", k, len(drawings))
        starts.append(lead if k == first else find_next(drawing, lead.rows, lead.bite.T_upper_lower, contact))
    progress("search", len(drawings), len(drawings))
    return starts


def _refined(bite: Bite, lines: Sequence[Drawing], rows: ArchPair, contact: Contact) -> Bite:
    """Return the photographs and the bite after coarse-to-fine alignment."""
    for share, gates in _STAGES:
        factors = [share * _AT_WIDTH_PX / own.size_px[0] for own in lines]
        drawings = [own.shrunk(factor) if factor < 1.0 else own for own, factor in zip(lines, factors, strict=True)]
        photos = tuple(photo.drawn(own) for photo, own in zip(bite.photos, drawings, strict=True))
        crowns = rows.fine if share == 1.0 else rows.thin
        aligner = Aligner(crowns, rows.usual.T_upper_lower, contact)
        bite = aligner.aligned(replace(bite, photos=photos), gates)
    return replace(bite, photos=tuple(photo.drawn(own) for photo, own in zip(bite.photos, lines, strict=True)))


def _together(alone: Sequence[Bite], lines: Sequence[Drawing], rows: ArchPair, contact: Contact) -> Bite:
    """Return all photographs aligned to one bite: the best result over starts from the bite of each photograph."""
    if len(alone) == 1:
        return alone[0]
    photos = tuple(bite.photos[0] for bite in alone)
    aligner = Aligner(rows.fine, rows.usual.T_upper_lower, None)
    tried = []
    for one in alone:
        joint = _refined(Bite(photos, one.T_upper_lower, one.gum_mm), lines, rows, contact)
        tried.append((float(aligner.misfit(joint, _GATE_MM).mean()), joint))
    return min(tried, key=lambda entry: entry[0])[1]


def _result(
    joint: Bite, alone: Sequence[Bite], starts: Sequence[PhotoStart], rows: ArchPair, contact: Contact
) -> AlignedPhotos:
    """Return the numeric results of an alignment."""
    point = _lower_incisor(rows)
    misfits = Aligner(rows.fine, rows.usual.T_upper_lower, None).misfit(joint, _GATE_MM).max(1)
    photos = []
    for photo, own, start, misfit in zip(joint.photos, alone, starts, misfits, strict=True):
        off = transform_point(own.T_upper_lower, point) - transform_point(joint.T_upper_lower, point)
        every, free = _line_distances(photo, joint, rows)
        photos.append(
            AlignedPhoto(
                name=photo.drawing.name,
                size_px=photo.drawing.size_px,
                mirrored=start.mirrored,
                focal_px=photo.pose.focal_px,
                distortion=photo.pose.opencv_k1(photo.drawing.size_px),
                T_cam_upper=photo.pose.T_cam_upper,
                middle_px=middle_of(photo.drawing.size_px),
                outline_rms_px=_rms(every),
                outline_median_px=float(np.median(every)),
                free_rms_px=_rms(free),
                misfit=float(misfit),
                other_hand=start.other_misfit / max(start.misfit, 1e-9),
                T_upper_lower_alone=own.T_upper_lower,
                alone_off_mm=float(np.linalg.norm(off)),
            )
        )
    depth = contact.depth_mm(joint.T_upper_lower)
    return AlignedPhotos(joint.T_upper_lower, joint.gum_mm, depth, tuple(photos), tuple(_findings(photos)))


def _line_distances(photo: Photo, joint: Bite, rows: ArchPair) -> tuple[Array, Array]:
    """Return the distances of all drawn points from outlines, and of those off the gum line [px at 1440 px width]."""
    to_usual = _AT_WIDTH_PX / photo.drawing.size_px[0]
    found = match(seen_outlines(rows.fine, photo, joint), photo.drawing, _TURN_PX / to_usual)
    distance = to_usual * np.linalg.norm(found.outlines.pixels - photo.drawing.pixels, axis=1)
    return distance, distance[found.outlines.gum < 0.5]


def _lower_incisor(rows: ArchPair) -> Array:
    """Return the highest point of the lower front teeth, in scan coordinates [mm], shape (3,)."""
    points = rows.fine[1].scan.crown_vertices()
    _, up, front = transform_points(rows.usual.T_anatomical_lower, points).T
    ahead = np.flatnonzero(front > np.percentile(front, 97))
    return np.asarray(points[ahead[up[ahead].argmax()]], np.float64)


def _findings(photos: Sequence[AlignedPhoto]) -> Iterator[Finding]:
    """Yield the findings about an alignment."""
    for photo in photos:
        finding = partial(Finding, camera=photo.name)
        if photo.misfit > _MOST_MISFIT:
            message = f"the crowns do not fit the drawn lines (misfit {photo.misfit:.2f}; at most {_MOST_MISFIT})"
            hint = "Check that the scans are recent and of this subject, and that the teeth are closed."
            yield finding("photo_unfit", "error", message, photo.misfit, _MOST_MISFIT, hint=hint)
        elif photo.other_hand < _SAME_HAND:
            message = f"the photograph fits about equally well {'un' if photo.mirrored else ''}mirrored"
            yield finding("photo_hand", "warning", message, photo.other_hand, _SAME_HAND)
        if photo.alone_off_mm > _APART_MM:
            message = (
                f"aligned alone, it places the lower incisor {photo.alone_off_mm:.1f} mm from the joint result "
                f"(at most {_APART_MM} mm is allowed)"
            )
            hint = "A single view is inaccurate along its line of sight; photographs of different bites also disagree."
            yield finding("photo_bite", "warning", message, photo.alone_off_mm, _APART_MM, hint=hint)


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))


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
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
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
