"""Draw the tracked scans over the footage, to be judged by eye (paper figs. 10 and 11)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import CaptureError, OutputError, explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera
from jawusd.pipeline.prepare import load_cameras, load_meshes, tracked_cameras
from jawusd.pipeline.state import Progress

if TYPE_CHECKING:
    from jawusd.imaging.video import Video

SHEET = "contact_sheet.png"
_SHEET_FRAMES = 6
_GRAY = 60  # where a camera has no picture
_CRF = 20  # H.264 quality for looking at, half the time of an archive


def overlay_files(capture: Capture, folder: Path) -> list[Path]:
    """Return the files `write_overlay` writes: a video per camera that has one, and the contact sheet.

    Args:
        capture: names the cameras.
        folder: where the files go.
    """
    return [folder / f"{camera.name}.mp4" for camera in capture.cameras if camera.video] + [folder / SHEET]


@explain_missing_packages()
def write_overlay(
    capture: Capture, offsets: dict[str, int], tracks: Tracks, folder: Path, progress: Progress
) -> list[Path]:
    """Write per camera an H.264 video of the tracked frames with both scans drawn over them, and a contact sheet.

    The videos run in step: where a camera has no picture it is gray. Lost rows are not drawn.

    Args:
        capture: gives footage, calibration and scans.
        offsets: frame offset by camera.
        tracks: the poses to draw.
        folder: where the files go; made if need be, files of the same name are overwritten.
        progress: told of every picture.

    Returns:
        The files written.

    Raises:
        CaptureError: no camera has a video, or one cannot be decoded.
        CalibrationError: a video has another shape than its camera's calibration.
        OutputError: the files cannot be written.
    """
    from jawusd.imaging.overlay import save_png, tracking_sheet
    from jawusd.imaging.video_writer import VideoWriter

    cameras, videos = open_footage(capture)
    cameras = {camera.name: camera for camera in tracked_cameras(list(cameras.values()), tracks)}
    meshes = load_meshes(capture)
    upper, lower = meshes["upper_teeth"], meshes["lower_teeth"]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write here: {error.strerror}.", path=folder) from error
    done, total = 0, len(videos) * len(tracks.frames)
    for name, video in videos.items():
        width, height = (side // 2 * 2 for side in video.size_px)  # H.264 halves the colours
        writer = VideoWriter(folder / f"{name}.mp4", (width, height), capture.fps, quality_crf=_CRF)
        with writer as out:
            for image in _drawn(tracks, video, offsets[name], cameras[name], upper, lower):
                out.write(image[:height, :width])
                done += 1
                progress("overlay", done, total)
    shown = np.unique(np.linspace(0, len(tracks.frames) - 1, _SHEET_FRAMES).round().astype(int))
    sheet = tracking_sheet(
        tracks, tracks.frames[shown].tolist(), [cameras[name] for name in videos], videos, offsets, upper, lower
    )
    save_png(folder / SHEET, sheet)
    return overlay_files(capture, folder)


def open_footage(capture: Capture) -> tuple[dict[str, Camera], dict[str, Video]]:
    """Return the calibrated cameras of a capture, and the videos of those that have one, by name.

    Raises:
        CaptureError: no camera has a video, or one cannot be decoded.
        CalibrationError: a video has another shape than its camera's calibration.
    """
    return {camera.name: camera for camera in load_cameras(capture)}, open_videos(capture)


@explain_missing_packages()
def open_videos(capture: Capture) -> dict[str, Video]:
    """Return the videos of a capture by the names of their cameras.

    Raises:
        CaptureError: no camera has a video, or one cannot be decoded.
    """
    from jawusd.imaging.video import Video

    sources = {source.name: source.video for source in capture.cameras if source.video}
    if not sources:
        raise CaptureError(
            "no camera has a video, so there is no footage.",
            path=capture.folder / "capture.toml",
            hint="Name the footage there (video = ...).",
        )
    return {name: Video(path) for name, path in sources.items()}


def _drawn(
    tracks: Tracks, video: Video, offset: int, camera: Camera, upper: Mesh, lower: Mesh
) -> Iterator[NDArray[np.uint8]]:
    """Yield the picture of every tracked frame, (h, w, 3) RGB."""
    from jawusd.imaging.overlay import LOWER_COLOUR, UPPER_COLOUR, PlacedScan, draw_overlay

    wanted = [video.timeline.picture(frame - offset) for frame in tracks.frames.tolist()]
    for row, image in enumerate(video.pictures(wanted, colour="rgb")):
        if image is None:
            yield np.full((camera.size_px[1], camera.size_px[0], 3), _GRAY, np.uint8)
            continue
        scans = [
            PlacedScan(upper, tracks.T_world_upper[row], UPPER_COLOUR),
            PlacedScan(lower, tracks.T_world_lower[row], LOWER_COLOUR),
        ]
        yield draw_overlay(image, camera, scans)
