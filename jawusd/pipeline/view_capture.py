"""Show a capture in the viewer, or the footage of a rig: images or masks with teeth drawn over them, picks, labels."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError, explain_missing_packages, naming_file
from jawusd.formats.capture import Bootstrap, Capture
from jawusd.formats.capture_writing import write_bootstrap
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks, load_tracks
from jawusd.geometry import Camera
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import check_same_cameras, load_cameras, open_backdrops, tracked_cameras, tracked_scans
from jawusd.pipeline.pictures import open_wall
from jawusd.pipeline.report import as_built, build_facts, is_build, recorded_offsets
from jawusd.pipeline.scans import save_reviewed
from jawusd.pipeline.state import BuildState, Progress
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.view import CAPTURE_FILE
from jawusd.pipeline.workspace import open_capture

if TYPE_CHECKING:
    from jawusd.media.overlay import Backdrop
    from jawusd.media.side_by_side import CameraWall
    from jawusd.viewer.viewed import ViewedCapture, ViewedFootage


_TRACKS = "tracks.npz"
_TILE_PX = (480, 360)  # maximum size of a camera's tile; three tiles fill the width of the page


def viewed_capture(
    path: AnyPath, tracks: Path | None, progress: Progress, *, allow_outside: bool = False
) -> ViewedCapture:
    """Load a capture for the viewer.

    Args:
        path: capture.toml or its folder.
        tracks: folder of a build of the capture, or tracks.npz; None: only the footage is shown.

    Raises:
        FormatError: the capture or the tracks cannot be read, or the tracks use cameras that the capture lacks.
        CaptureError, SyncError: there is no footage, a file cannot be decoded, or the cameras cannot be aligned.
    """
    from jawusd.media.side_by_side import CameraWall
    from jawusd.viewer.viewed import ViewedCapture

    path = Path(path)
    capture = open_capture(path, allow_outside=allow_outside)
    own_scans = capture.scans
    build = tracks if tracks is not None and is_build(tracks) else None
    if build is not None:
        capture = as_built(capture, build)
    poses = _poses(capture, tracks)
    cameras = [] if capture.calibration is None else load_cameras(capture)
    meshes = load_meshes(capture, None if poses is None else poses.meta)
    if poses is not None:
        cameras = tracked_cameras(cameras, poses)
    offsets = _offsets(capture, build, progress)
    backdrops = open_backdrops(capture, offsets)
    by_name = {camera.name: camera for camera in cameras}
    scans = {arch: meshes[f"{arch}_teeth"] for arch in ("upper", "lower")}
    return ViewedCapture(
        source=capture,
        frames=_frames(capture, poses, backdrops, offsets),
        offsets=offsets,
        backdrops=backdrops,
        all_cameras=CameraWall(
            by_name, backdrops, poses, tuple(scans.values()), _tile_px(backdrops, poses is not None)
        ),
        cameras=by_name,
        scans=scans,
        T_anatomical_skull=subject_of_capture(capture, meshes).T_anatomical_skull,
        tracks=poses,
        poses_of_picks=partial(_poses_of_picks, scans, by_name),
        save_picks=partial(write_bootstrap, path / CAPTURE_FILE if path.is_dir() else path),
        save_labels=partial(save_reviewed, own_scans, scans),
    )


def _tile_px(backdrops: Mapping[str, Backdrop], cut: bool) -> tuple[int, int]:
    """Return the size of each camera's tile; tiles of whole images have the aspect ratio of the first camera."""
    if cut:
        return _TILE_PX
    width, height = next(iter(backdrops.values())).size_px
    scale = min(_TILE_PX[0] / max(width, height), 1.0)
    return max(round(width * scale), 1), max(round(height * scale), 1)


def _poses(capture: Capture, tracks: Path | None) -> Tracks | None:
    if tracks is None:
        return None
    found = load_tracks(tracks / _TRACKS if tracks.is_dir() else tracks)
    with naming_file(tracks):
        check_same_cameras(capture, found)
    return found


def _offsets(capture: Capture, build: Path | None, progress: Progress) -> dict[str, int]:
    """Return the frame offsets recorded by the build, or estimate them."""
    found = recorded_offsets(BuildState(build)) if build is not None else {}
    return found or sync_cameras(capture, progress)["offsets"]


def _frames(
    capture: Capture, poses: Tracks | None, backdrops: Mapping[str, Backdrop], offsets: Mapping[str, int]
) -> tuple[int, int]:
    """Return the first and the last frame of the reference camera to show."""
    if poses is not None and len(poses.frames):
        return int(poses.frames[0]), int(poses.frames[-1])
    if capture.frames is not None:
        return capture.frames[0], capture.frames[1] - 1
    last = max(offsets[name] + backdrop.count - 1 for name, backdrop in backdrops.items())
    return max(0, min(offsets[name] for name in backdrops)), last


def _poses_of_picks(
    scans: Mapping[str, Mesh], cameras: Mapping[str, Camera], picks: Bootstrap
) -> tuple[tuple[Array, Array], list[str]]:
    """Return the poses estimated from picks, and the names of outlier picks."""
    from jawusd.tracking.initialization.bootstrap import pose_from_picks

    upper, lower = (pose_from_picks(getattr(picks, arch), mesh.vertices, cameras, arch) for arch, mesh in scans.items())
    wrong = [f"{arch}{number}" for arch, (_, bad) in (("U", upper), ("L", lower)) for number in bad]
    return (upper[0], lower[0]), wrong


def take_footage(folder: Path, tile_px: tuple[int, int] = _TILE_PX) -> ViewedFootage | None:
    """Return the footage, or the masks, of the take from which a rig was built, in images of a size (width, height).

    Returns None without a build, and if its files or its capture cannot be read, as after the rig was moved.
    """
    from jawusd.viewer.viewed import ViewedFootage

    if not is_build(folder) or not (folder / _TRACKS).is_file():
        return None
    try:
        state = BuildState(folder)
        facts, offsets = build_facts(folder, state, None), recorded_offsets(state)
        tracks = load_tracks(folder / _TRACKS)
    except FormatError:  # `jawusd validate` reports it; the rig can still be shown
        return None
    if facts.capture is None:
        return None
    names = [source.name for source in facts.capture.cameras if source.video or source.masks]
    if not names or not set(names) <= set(offsets) or not len(tracks.frames):
        return None
    frames = int(tracks.frames[0]), int(tracks.frames[-1])
    return ViewedFootage(tuple(names), frames, _outlines(facts.capture, offsets, tracks, tile_px))


def _outlines(
    capture: Capture, offsets: dict[str, int], tracks: Tracks, tile_px: tuple[int, int]
) -> Callable[[str, int], NDArray[np.uint8]]:
    """Return a thread-safe function that draws a camera's image, cropped to the teeth, with their outlines."""
    lock = threading.Lock()

    @cache
    def scans() -> tuple[Mesh, Mesh]:
        return tracked_scans(capture, tracks)

    @cache
    def wall(name: str) -> CameraWall:
        sources = tuple(source for source in capture.cameras if source.name == name)
        return open_wall(capture.model_copy(update={"cameras": sources}), offsets, tracks, scans(), tile_px)

    @explain_missing_packages()
    def picture(name: str, frame: int) -> NDArray[np.uint8]:
        from jawusd.media.overlay import placed_scans

        with lock:
            opened = wall(name)
        row = tracks.row_of(frame)
        return opened.draw(frame, [] if row is None else placed_scans(tracks, row, scans()), fill=0.0)

    return picture
