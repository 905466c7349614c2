"""Images and videos of a tracked capture: overlays, worst frames, plates, and the meshes of the report's 3-D replay."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.model import JawModel
from jawusd.formats.report import Overlay, ReplayPart
from jawusd.formats.tracks import Tracks, uncovered_percent, worst_frames
from jawusd.geometry import Camera, transform_points
from jawusd.pipeline.cameras import (
    check_same_cameras,
    load_cameras,
    open_backdrops,
    open_footage,
    tracked_cameras,
    tracked_scans,
)
from jawusd.pipeline.state import Progress, make_folder

if TYPE_CHECKING:
    from jawusd.media.overlay import Backdrop
    from jawusd.media.side_by_side import CameraWall


_UNCOVERED, _UNCERTAIN = 3, 2  # number of frames drawn for each reason; one typical frame is drawn in addition
_MOST_CAMERAS = 4
_REPORT_TILE_PX = (400, 225)
_QUALITY = 82
_MOST_FACES = 6000  # maximum number of faces of a mesh in the report's replay


def draw_frames(
    capture: Capture,
    offsets: Mapping[str, int],
    tracks: Tracks,
    chosen: Sequence[tuple[int, str]],
    names: Collection[str] | None = None,
) -> tuple[Overlay, ...]:
    """Draw the scans over images or masks; raises like `load_cameras` and `open_backdrops`.

    `chosen` are rows of the tracks and the reason for drawing each, `names` the cameras to draw; None: all.
    """
    from jawusd.media.overlay import encode_jpeg, tracking_sheet

    cameras, scans = tracked_cameras(load_cameras(capture), tracks), tracked_scans(capture, tracks)
    backdrops = {n: one for n, one in open_backdrops(capture, offsets).items() if names is None or n in names}
    shown = [camera for camera in cameras if camera.name in backdrops][:_MOST_CAMERAS]
    found = []
    for row, reason in chosen:
        frame = int(tracks.frames[row])
        sheet = tracking_sheet(tracks, [frame], shown, backdrops, *scans, tile_px=_REPORT_TILE_PX)
        found.append(Overlay(frame, reason, encode_jpeg(sheet, _QUALITY)))
    for backdrop in backdrops.values():
        backdrop.close()
    return tuple(found)


def chosen_frames(tracks: Tracks, fps: float) -> list[tuple[int, str]]:
    """Return the frames to inspect, worst first, each as its row in the tracks and the reason."""
    tracked = tracks.tracked()
    uncovered = np.where(tracked, np.fmax.reduce(uncovered_percent(tracks), axis=1), np.nan)
    sigma_mm = np.where(tracked, tracks.sigma_mm.max(axis=1), np.nan)
    worst = (
        (uncovered, _UNCOVERED, "{:.2f} % of the worse arch's masks uncovered"),
        (sigma_mm, _UNCERTAIN, "expected error of {:.2f} mm at the worst landmark"),
    )
    usual = uncovered, "a typical frame, {:.2f} % of the worse arch's masks uncovered"
    return worst_and_usual(tracks, fps, worst, usual)


def worst_and_usual(
    tracks: Tracks, fps: float, worst: Sequence[tuple[Array, int, str]], usual: tuple[Array, str]
) -> list[tuple[int, str]]:
    """Return frames with the largest values, and one with the median value, each as its row and the reason in words.

    `worst` are values (F,) of every frame, NaN if unknown, the largest number of frames, and the words for one, with a
    placeholder for its value; `usual` are values (F,) and the words for the frame with the median one.
    """
    found: list[tuple[int, str]] = []
    for values, count, words in worst:
        rows = worst_frames(values, tracks.frames, fps, count, [row for row, _ in found])
        found += [(row, words.format(values[row])) for row in rows]
    values, words = usual
    if len(known := np.flatnonzero(np.isfinite(values))):
        row = int(known[np.argsort(values[known])[len(known) // 2]])
        found.append((row, words.format(values[row])))
    return found


@explain_missing_packages()
def write_plates(
    capture: Capture, offsets: Mapping[str, int], frames: NDArray[np.int64], folder: Path, progress: Progress
) -> list[str]:
    """Write undistorted plates, EXR for EXR footage and JPEG otherwise, at the paths in `cameras.usda`.

    `frames` (F,) are increasing numbers of the reference camera; those without an image get no plate. Returns the file
    pattern of every camera, relative to the rig's folder. Raises like `open_footage`, and OutputError.
    """
    from jawusd.media.footage import PictureSequence
    from jawusd.media.writers import PlateWriter
    from jawusd.rig.cameras import LIGHT_PLATE, PLATE

    cameras, videos = open_footage(capture)
    light = {n: video for n, video in videos.items() if isinstance(video, PictureSequence) and video.is_fractional}
    patterns = {name: (LIGHT_PLATE if name in light else PLATE).format(name=name) for name in videos}
    done, total = 0, len(videos) * len(frames)
    for name, video in videos.items():
        plates = PlateWriter(cameras[name])
        files = str(folder / patterns[name])
        make_folder(Path(files).parent)
        wanted = [video.timeline.picture(frame - offsets[name]) for frame in frames.tolist()]
        images = video.pictures(wanted, colour="rgb")  # decoded only when they are asked for
        for frame, index in zip(frames.tolist(), wanted, strict=True):
            if name in light:
                if index is not None:
                    plates.write_light(files % frame, light[name].light(index))
            elif (image := next(images)) is not None:
                plates.write(files % frame, image)
            done += 1
            progress("plates", done, total)
    return [patterns[name] for name in videos]


def replay_parts(folder: Path, model: JawModel) -> tuple[ReplayPart, ...]:
    """Return decimated meshes of a rig with the teeth closed, in the anatomical frame [mm], for the report.

    Raises RigError if the rig has no geometry.
    """
    from jawusd.meshes.remeshing import decimated
    from jawusd.rig.geo import read_geometry, read_gum

    path = folder / "geo.usdc"
    meshes, gums = read_geometry(path), read_gum(path)
    A, rest = model.arrays["T_anatomical_skull"], model.arrays["T_rest"]
    found = []
    for name, mesh in meshes.items():
        moves = name in ("mandible", "lower_teeth")
        place = A @ rest if moves else A
        gum = gums.get(name, np.zeros(len(mesh.faces), bool))
        kind = "tooth" if name.endswith("teeth") else "bone"
        for part, chosen in ((kind, mesh.faces[~gum]), ("gum", mesh.faces[gum])):
            if len(chosen):
                vertices, faces = decimated(mesh.vertices, chosen, min(_MOST_FACES, len(chosen)))
                found.append(ReplayPart(name, part, moves, Mesh(transform_points(place, vertices), faces)))
    return tuple(found)


SHEET = "contact_sheet.png"
#: Suffix of an output path that requests one video of all cameras; any other path is a folder.
VIDEO = ".mp4"
_SHEET_FRAMES = 6
_CRF = 20  # H.264 constant rate factor for viewing; archive quality would take twice the time to encode
TILE_PX = (640, 480)
_FILL = 0.12  # opacity of the crowns; low enough to keep the outlines visible


def overlay_files(capture: Capture, path: Path) -> list[Path]:
    """Return the files that `write_overlay` writes: one video, or a video per camera and a contact sheet."""
    if path.suffix.lower() == VIDEO:
        return [path]
    return [path / f"{camera.name}.mp4" for camera in capture.cameras if camera.video] + [path / SHEET]


@explain_missing_packages()
def write_overlay(
    capture: Capture, offsets: Mapping[str, int], tracks: Tracks, path: Path, progress: Progress
) -> list[Path]:
    """Write H.264 video of the tracked frames with both scans drawn over them; return `overlay_files`.

    If `path` is a folder, it gets a contact sheet and a synchronised video of whole images for each camera with
    footage; missing images are gray. If `path` is an .mp4 file, all cameras are placed side by side, cropped to the
    teeth; cameras without footage show their masks. Existing files are overwritten. Raises like `open_footage`,
    FormatError if the tracks belong to another capture, and OutputError.
    """
    check_same_cameras(capture, tracks)
    if path.suffix.lower() == VIDEO:
        _write_side_by_side(capture, offsets, tracks, path, progress)
    else:
        _write_cameras(capture, offsets, tracks, path, progress)
    return overlay_files(capture, path)


def _write_cameras(
    capture: Capture, offsets: Mapping[str, int], tracks: Tracks, folder: Path, progress: Progress
) -> None:
    from jawusd.media.overlay import save_png, tracking_sheet
    from jawusd.media.writers import VideoWriter

    cameras, videos = open_footage(capture, tracks)
    scans = tracked_scans(capture, tracks)
    backdrops = {name: one for name, one in open_backdrops(capture, offsets).items() if name in videos}
    make_folder(folder)
    done, total = 0, len(backdrops) * len(tracks.frames)
    for name, backdrop in backdrops.items():
        width, height = (side // 2 * 2 for side in backdrop.size_px)  # H.264 needs even image sizes
        with VideoWriter(folder / f"{name}.mp4", (width, height), capture.fps, quality_crf=_CRF) as out:
            for image in _drawn(tracks, backdrop, cameras[name], scans):
                out.write(image[:height, :width])
                done += 1
                progress("overlay", done, total)
    shown = np.unique(np.linspace(0, len(tracks.frames) - 1, _SHEET_FRAMES).round().astype(int))
    sheet = tracking_sheet(
        tracks, tracks.frames[shown].tolist(), [cameras[name] for name in backdrops], backdrops, *scans
    )
    save_png(folder / SHEET, sheet)


def _drawn(tracks: Tracks, backdrop: Backdrop, camera: Camera, scans: tuple[Mesh, Mesh]) -> Iterator[NDArray[np.uint8]]:
    """Yield the image of every tracked frame, (h, w, 3) RGB."""
    from jawusd.media.overlay import EMPTY_GRAY, draw_overlay, placed_scans

    for row, frame in enumerate(tracks.frames.tolist()):
        image = backdrop.picture(frame)
        if image is None:
            yield np.full((camera.size_px[1], camera.size_px[0], 3), EMPTY_GRAY, np.uint8)
        else:
            yield draw_overlay(image, camera, placed_scans(tracks, row, scans))


def _write_side_by_side(
    capture: Capture, offsets: Mapping[str, int], tracks: Tracks, path: Path, progress: Progress
) -> None:
    from jawusd.media.overlay import placed_scans
    from jawusd.media.side_by_side import StatusBar
    from jawusd.media.writers import VideoWriter

    scans = tracked_scans(capture, tracks)
    wall = open_wall(capture, offsets, tracks, scans, TILE_PX)
    bar = StatusBar(tracks, capture.fps, wall.size_px[0])
    height = wall.size_px[1] + bar.draw(0).shape[0]
    size = wall.size_px[0] // 2 * 2, height // 2 * 2
    make_folder(path.resolve().parent)
    with contextlib.closing(wall), VideoWriter(path, size, capture.fps, quality_crf=_CRF) as out:
        for row, frame in enumerate(tracks.frames.tolist()):
            image = np.vstack([wall.draw(frame, placed_scans(tracks, row, scans), fill=_FILL), bar.draw(row)])
            out.write(image[: size[1], : size[0]])
            progress("overlay", row + 1, len(tracks.frames))


def open_wall(
    capture: Capture, offsets: Mapping[str, int], tracks: Tracks, scans: tuple[Mesh, Mesh], tile_px: tuple[int, int]
) -> CameraWall:
    """Return a renderer of the images of all cameras side by side, each cropped to the teeth.

    Raises CaptureError or CalibrationError if no camera has video or masks, or if one cannot be read.
    """
    from jawusd.media.side_by_side import CameraWall

    backdrops = open_backdrops(capture, offsets)
    cameras = {camera.name: camera for camera in tracked_cameras(load_cameras(capture), tracks)}
    return CameraWall({name: cameras[name] for name in backdrops}, backdrops, tracks, scans, tile_px)
