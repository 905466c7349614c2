"""Videos of the tracked scans drawn over the footage: one per camera with a contact sheet, or all cameras in one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera
from jawusd.pipeline.cameras import load_cameras, tracked_cameras
from jawusd.pipeline.media import check_same_cameras, open_backdrops, open_footage, tracked_scans
from jawusd.pipeline.state import Progress, make_folder

if TYPE_CHECKING:
    from jawusd.media.backdrop import Backdrop
    from jawusd.media.side_by_side import CameraWall

SHEET = "contact_sheet.png"
#: Suffix of an overlay that is one video of all cameras.
VIDEO = ".mp4"
_SHEET_FRAMES = 6
_CRF = 20  # H.264 quality for looking at, half the time of an archive
TILE_PX = (640, 480)
_FILL = 0.12  # opacity of the crowns: outlines tell more


def overlay_files(capture: Capture, path: Path) -> list[Path]:
    """Return the files `write_overlay` writes: the video named, or in a folder one per camera and a contact sheet."""
    if path.suffix.lower() == VIDEO:
        return [path]
    return [path / f"{camera.name}.mp4" for camera in capture.cameras if camera.video] + [path / SHEET]


@explain_missing_packages()
def write_overlay(
    capture: Capture, offsets: Mapping[str, int], tracks: Tracks, path: Path, progress: Progress
) -> list[Path]:
    """Write H.264 video of the tracked frames with both scans drawn over them. Returns `overlay_files`.

    A folder gets a video of whole pictures per camera that has footage, in step and gray where the camera has no
    picture, and a contact sheet. A file that ends in .mp4 shows all cameras side by side, cut to the teeth; cameras
    without footage show their masks. Files of the same name are overwritten.

    Args:
        offsets: frame offset by camera.

    Raises:
        CaptureError, CalibrationError: see `open_footage`.
        FormatError: the tracks are of another capture.
        OutputError: the files cannot be written.
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
        width, height = (side // 2 * 2 for side in backdrop.size_px)  # H.264 halves the colours
        writer = VideoWriter(folder / f"{name}.mp4", (width, height), capture.fps, quality_crf=_CRF)
        with writer as out:
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
    """Yield the picture of every tracked frame, (h, w, 3) RGB."""
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
    capture: Capture,
    offsets: Mapping[str, int],
    tracks: Tracks,
    scans: tuple[Mesh, Mesh],
    tile_px: tuple[int, int],
) -> CameraWall:
    """Return what draws all cameras of a capture side by side, each cut to the teeth of its tracks.

    Raises:
        CaptureError, CalibrationError: no camera has video or masks, or one cannot be read.
    """
    from jawusd.media.side_by_side import CameraWall

    backdrops = open_backdrops(capture, offsets)
    cameras = {camera.name: camera for camera in tracked_cameras(load_cameras(capture), tracks)}
    return CameraWall({name: cameras[name] for name in backdrops}, backdrops, tracks, scans, tile_px)
