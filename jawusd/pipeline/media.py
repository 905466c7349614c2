"""Pictures and meshes for people and DCCs: scans over the footage (paper figs. 10, 11), plates, the report's replay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import CaptureError, FormatError, explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.model import JawModel
from jawusd.formats.report import Overlay, ReplayPart
from jawusd.formats.tracks import Tracks, uncovered_percent, worst_frames
from jawusd.geometry import Camera, transform_points
from jawusd.pipeline.cameras import load_cameras, tracked_cameras
from jawusd.pipeline.meshes import load_meshes, registered_meshes
from jawusd.pipeline.state import Progress, make_folder

if TYPE_CHECKING:
    from jawusd.media.backdrop import Backdrop
    from jawusd.media.clip import Clip

_UNCOVERED, _UNCERTAIN = 3, 2  # frames shown for either reason; one typical frame is added, to compare with
_MOST_CAMERAS = 4
_TILE_PX = (400, 225)
_QUALITY = 82
_MOST_FACES = 6000  # per mesh of the report


@explain_missing_packages()
def open_videos(capture: Capture) -> dict[str, Clip]:
    """Return the videos of a capture by the names of their cameras.

    Raises:
        CaptureError: no camera has a video, or one cannot be decoded.
    """
    from jawusd.media.footage import open_clip

    sources = {source.name: source.clip for source in capture.cameras if source.clip}
    if not sources:
        raise CaptureError(
            "no camera has a video, so there is no footage.",
            path=capture.folder / "capture.toml",
            hint="Name the footage there (video = ...).",
        )
    return {name: open_clip(clip) for name, clip in sources.items()}


def open_footage(capture: Capture, tracks: Tracks | None = None) -> tuple[dict[str, Camera], dict[str, Clip]]:
    """Return the calibrated cameras of a capture, and the videos of those that have one, by name.

    Args:
        tracks: cameras as these corrected them.

    Raises:
        CaptureError: no camera has a video, or one cannot be decoded.
        CalibrationError: a video has another shape than its camera's calibration.
    """
    cameras = load_cameras(capture)
    placed = cameras if tracks is None else tracked_cameras(cameras, tracks)
    return {camera.name: camera for camera in placed}, open_videos(capture)


@explain_missing_packages()
def open_backdrops(capture: Capture, offsets: Mapping[str, int]) -> dict[str, Backdrop]:
    """Return what lies behind drawn scans, footage or else masks, by the name of each camera that has either.

    Args:
        offsets: frame offset by camera.

    Raises:
        CaptureError: no camera has video or masks, or one cannot be decoded.
    """
    from jawusd.media.backdrop import Backdrop

    sources = [source for source in capture.cameras if source.video or source.masks]
    if not sources:
        raise CaptureError(
            "no camera has a video or masks, so there is nothing to draw over.",
            path=capture.folder / "capture.toml",
            hint="Name the footage there (video = ...).",
        )
    return {source.name: Backdrop(source, offsets[source.name]) for source in sources}


def draw_worst_frames(capture: Capture, offsets: Mapping[str, int], tracks: Tracks) -> tuple[Overlay, ...]:
    """Draw the scans over the footage where they fit it worst, and once where they fit as usual; the worst first.

    Args:
        offsets: frame offset by camera.

    Raises:
        CaptureError, CalibrationError: see `open_footage`.
        FormatError: the tracks are of another capture.
    """
    check_same_cameras(capture, tracks)
    cameras, videos = open_footage(capture, tracks)
    backdrops = {name: one for name, one in open_backdrops(capture, offsets).items() if name in videos}
    return draw_frames(chosen_frames(tracks, capture.fps), tracks, cameras, backdrops, tracked_scans(capture, tracks))


def check_same_cameras(capture: Capture, tracks: Tracks) -> None:
    """Check that tracks may be of a capture; cameras without masks are not tracked with.

    Raises:
        FormatError: they name a camera it does not have.
    """
    names = [camera.name for camera in capture.cameras]
    if not set(tracks.camera_names) <= set(names):
        raise FormatError(
            f"the tracks are of the cameras {', '.join(tracks.camera_names)}; the capture has {', '.join(names)}."
        )


def tracked_scans(capture: Capture, tracks: Tracks) -> tuple[Mesh, Mesh]:
    """Return the teeth scans of a capture, upper and lower, that the poses of tracks belong to [mm].

    Raises:
        CaptureError, FormatError: see `load_meshes`.
    """
    meshes = registered_meshes(load_meshes(capture), tracks.meta)
    return meshes["upper_teeth"], meshes["lower_teeth"]


def draw_frames(
    chosen: Sequence[tuple[int, str]],
    tracks: Tracks,
    cameras: Mapping[str, Camera],
    backdrops: Mapping[str, Backdrop],
    scans: tuple[Mesh, Mesh],
) -> tuple[Overlay, ...]:
    """Draw the scans into the pictures of some frames, given by row of the tracks and reason.

    Raises:
        CaptureError: a picture cannot be decoded.
    """
    from jawusd.media.overlay import encode_jpeg, tracking_sheet

    shown = [cameras[name] for name in backdrops][:_MOST_CAMERAS]
    found = []
    for row, reason in chosen:
        frame = int(tracks.frames[row])
        sheet = tracking_sheet(tracks, [frame], shown, backdrops, *scans, tile_px=_TILE_PX)
        found.append(Overlay(frame, reason, encode_jpeg(sheet, _QUALITY)))
    return tuple(found)


def chosen_frames(tracks: Tracks, fps: float) -> list[tuple[int, str]]:
    """Return indices of frames to look at, each with the reason, the worst first."""
    tracked = tracks.tracked()
    uncovered = np.where(tracked, np.fmax.reduce(uncovered_percent(tracks), axis=1), np.nan)
    sigma_mm = np.where(tracked, tracks.sigma_mm.max(axis=1), np.nan)
    found: list[tuple[int, str]] = []
    for values, count, words in (
        (uncovered, _UNCOVERED, "{:.2f} % of the worse arch's masks left uncovered"),
        (sigma_mm, _UNCERTAIN, "expected error of {:.2f} mm at the worst landmark"),
    ):
        worst = worst_frames(values, tracks.frames, fps, count, [index for index, _ in found])
        found += [(index, words.format(values[index])) for index in worst]
    known = np.flatnonzero(np.isfinite(uncovered))
    if len(known):
        usual = known[np.argsort(uncovered[known])[len(known) // 2]]
        found.append((int(usual), f"a usual one, {uncovered[usual]:.2f} % of the worse arch's masks left uncovered"))
    return found


@explain_missing_packages()
def write_plates(
    capture: Capture, offsets: Mapping[str, int], frames: NDArray[np.int64], folder: Path, progress: Progress
) -> list[str]:
    """Write a picture per frame and camera, EXR of EXR and JPEG else, where `cameras.usda` says, numbered by time code.

    Args:
        offsets: frame offset by camera.
        frames: frames of the reference camera, increasing, shape (F,). Where a camera has no picture there is
            no plate.
        folder: the rig's folder.

    Returns:
        The file pattern of every camera, below the folder.

    Raises:
        CaptureError, CalibrationError: see `open_footage`.
        OutputError: the files cannot be written.
    """
    from jawusd.media.picture_sequence import PictureSequence
    from jawusd.media.writers import PlateWriter
    from jawusd.rig.cameras import LIGHT_PLATE, PLATE

    cameras, videos = open_footage(capture)
    light = {name for name, video in videos.items() if isinstance(video, PictureSequence) and video.is_fractional}
    patterns = {name: (LIGHT_PLATE if name in light else PLATE).format(name=name) for name in videos}
    done, total = 0, len(videos) * len(frames)
    for name, video in videos.items():
        plates = PlateWriter(cameras[name])
        files = str(folder / patterns[name])
        make_folder(Path(files).parent)
        wanted = [video.timeline.picture(frame - offsets[name]) for frame in frames.tolist()]
        if isinstance(video, PictureSequence) and name in light:
            for frame, index in zip(frames.tolist(), wanted):
                if index is not None:
                    plates.write_light(files % frame, video.light(index))
                done += 1
                progress("plates", done, total)
            continue
        for frame, image in zip(frames.tolist(), video.pictures(wanted, colour="rgb")):
            if image is not None:
                plates.write(files % frame, image)
            done += 1
            progress("plates", done, total)
    return [patterns[name] for name in videos]


def replay_parts(folder: Path, model: JawModel) -> tuple[ReplayPart, ...]:
    """Return the meshes of a rig thinned for the page, anatomical frame, in the closed bite [mm].

    Raises:
        RigError: there is no geometry.
    """
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
        for part, faces in ((kind, mesh.faces[~gum]), ("gum", mesh.faces[gum])):
            if len(faces):
                small = _small(Mesh(mesh.vertices, faces))
                placed = Mesh(transform_points(place, small.vertices), small.faces)
                found.append(ReplayPart(name, part, moves, placed))
    return tuple(found)


def _small(mesh: Mesh) -> Mesh:
    from jawusd.meshes.remeshing import decimated

    return Mesh(*decimated(mesh.vertices, mesh.faces, min(_MOST_FACES, len(mesh.faces))))
