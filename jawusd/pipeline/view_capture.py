"""Give the viewer a capture: footage with the teeth drawn over it, scans, cameras, and picks to be written."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import FormatError, explain_missing_packages
from jawusd.formats.capture import Bootstrap, Capture
from jawusd.formats.capture_edit import write_bootstrap
from jawusd.formats.mesh import Mesh, crown_face_mask
from jawusd.formats.tracks import Tracks, load_tracks
from jawusd.geometry import Camera
from jawusd.geometry.arrays import Array
from jawusd.pipeline.overlay import open_videos
from jawusd.pipeline.prepare import find_anatomy, load_cameras, load_meshes, open_capture, tracked_cameras
from jawusd.pipeline.report import calibrated, is_build
from jawusd.pipeline.stages import sync_cameras
from jawusd.pipeline.state import BuildState, Progress

if TYPE_CHECKING:
    from jawusd.imaging.frame_reader import FrameReader
    from jawusd.imaging.video import Video
    from jawusd.viewer.server import CaptureViewer
    from jawusd.viewer.viewed import ViewedCapture


CAPTURE_FILE = "capture.toml"
_TRACKS = "tracks.npz"
_GRAY = 60  # where a camera has no picture
_SPECKS_PERCENT = 0.5
_FILL = {"outlines": 0.0, "tinted": 0.3}


def is_capture(path: Path) -> bool:
    """Tell whether a path is a capture, and not a rig."""
    return path.suffix == ".toml" or (path / CAPTURE_FILE).is_file()


@explain_missing_packages()
def open_capture_viewer(
    path: str | os.PathLike[str],
    tracks: Path | None,
    host: str,
    port: int,
    progress: Progress,
    *,
    allow_outside: bool = False,
) -> CaptureViewer:
    """Serve a capture to browsers; see `viewed_capture` for what it raises.

    Args:
        path: capture.toml or its folder.
        tracks: as for `viewed_capture`.
        host: address to listen on.
        port: port to listen on.
        progress: told of the work.
        allow_outside: let paths in the capture leave its folder.

    Raises:
        MissingDependencyError: the viewer is not installed.
    """
    from jawusd.viewer.server import CaptureViewer

    return CaptureViewer(viewed_capture(path, tracks, progress, allow_outside=allow_outside), host, port)


def viewed_capture(
    path: str | os.PathLike[str], tracks: Path | None, progress: Progress, *, allow_outside: bool = False
) -> ViewedCapture:
    """Read what the viewer shows of a capture.

    Args:
        path: capture.toml or its folder.
        tracks: folder of a build made from it, or its tracks.npz; None shows the footage alone.
        progress: told of the work.
        allow_outside: let paths in the capture leave its folder.

    Raises:
        FormatError: the capture or the tracks cannot be read, or the tracks are of other cameras.
        CaptureError: there is no footage, or a file cannot be decoded.
        SyncError: the cameras cannot be aligned in time.
    """
    from jawusd.imaging.frame_reader import FrameReader
    from jawusd.viewer.viewed import ViewedCapture

    path = Path(path)
    capture = open_capture(path, allow_outside=allow_outside)
    build = tracks if tracks is not None and is_build(tracks) else None
    if build is not None:
        capture = calibrated(capture, build)
    poses = _poses(capture, tracks)
    videos = open_videos(capture)
    cameras = [] if capture.calibration is None else load_cameras(capture)
    if poses is not None:
        cameras = tracked_cameras(cameras, poses)
    meshes = load_meshes(capture)
    offsets = _offsets(capture, build, progress)
    footage = _Footage(
        capture=capture,
        readers={name: FrameReader(video) for name, video in videos.items()},
        cameras={camera.name: camera for camera in cameras},
        offsets=offsets,
        scans={row: meshes[f"{row}_teeth"] for row in ("upper", "lower")},
    )
    return ViewedCapture(
        name=capture.name,
        fps=capture.fps,
        frames=_frames(capture, poses, videos, offsets),
        offsets=offsets,
        sizes_px={name: video.size_px for name, video in videos.items()},
        cameras=footage.cameras,
        scans=footage.scans,
        crowns={row: crown_face_mask(mesh) for row, mesh in footage.scans.items()},
        T_anatomical_skull=find_anatomy(capture, meshes).T_anatomical_skull,
        tracks=poses,
        picks=capture.bootstrap,
        picture=footage.picture,
        teeth_region=footage.teeth_region,
        poses_of_picks=footage.poses_of_picks,
        save_picks=partial(write_bootstrap, path / CAPTURE_FILE if path.is_dir() else path),
    )


def _poses(capture: Capture, tracks: Path | None) -> Tracks | None:
    if tracks is None:
        return None
    found = load_tracks(tracks / _TRACKS if tracks.is_dir() else tracks)
    names = [camera.name for camera in capture.cameras]
    if list(found.camera_names) != names:
        raise FormatError(
            f"is of the cameras {', '.join(found.camera_names)}; the capture has {', '.join(names)}.",
            path=tracks,
            hint="Name the build of this capture.",
        )
    return found


def _offsets(capture: Capture, build: Path | None, progress: Progress) -> dict[str, int]:
    """Return the frame offsets the build found, else find them."""
    if build is not None:
        record = BuildState(build).stages.get("sync")
        if record is not None:
            return dict(record.result["offsets"])
    return sync_cameras(capture, progress)["offsets"]


def _frames(
    capture: Capture, poses: Tracks | None, videos: Mapping[str, Video], offsets: Mapping[str, int]
) -> tuple[int, int]:
    """Return the first and the last frame of the reference camera to step through."""
    if poses is not None and len(poses.frames):
        return int(poses.frames[0]), int(poses.frames[-1])
    if capture.frames is not None:
        return capture.frames[0], capture.frames[1] - 1
    # From the first picture of any camera to the last.
    return (
        max(0, min(offsets[name] for name in videos)),
        max(offsets[name] + video.timeline.count - 1 for name, video in videos.items()),
    )


@dataclass(frozen=True, eq=False)
class _Footage:
    """Answer what a page asks of a capture; several threads may ask."""

    capture: Capture
    readers: Mapping[str, FrameReader]
    cameras: Mapping[str, Camera]
    offsets: Mapping[str, int]
    scans: Mapping[str, Mesh]

    def picture(self, name: str, frame: int, poses: tuple[Array, Array] | None, look: str) -> NDArray[np.uint8]:
        """Return a camera's picture at a frame of the reference camera, with the teeth drawn over it."""
        from jawusd.imaging.overlay import LOWER_COLOUR, UPPER_COLOUR, PlacedScan, draw_overlay

        reader = self.readers[name]
        own = reader.video.timeline.picture(frame - self.offsets[name])
        if own is None:
            width, height = reader.video.size_px
            return np.full((height, width, 3), _GRAY, np.uint8)
        image = reader.picture(own)
        if poses is None or look == "footage" or name not in self.cameras:
            return image
        colours = UPPER_COLOUR, LOWER_COLOUR
        placed = [PlacedScan(*scan) for scan in zip(self.scans.values(), poses, colours, strict=True)]
        return draw_overlay(image, self.cameras[name], placed, fill=_FILL[look])

    def teeth_region(self, name: str, frame: int) -> tuple[float, float, float, float] | None:
        """Return left, top, right and bottom [px] of what the masks of a camera show at a frame, None without any."""
        from jawusd.imaging.masks import open_masks

        source = next(camera for camera in self.capture.cameras if camera.name == name)
        if source.masks is None:
            return None
        seen = []
        for reader in open_masks(source, self.readers[name].video.size_px):
            with reader as masks:
                mask = masks.read(frame - self.offsets[name])
            if mask is not None:
                y, x = np.nonzero(mask > 127)
                seen.append(np.column_stack([x, y]))
        if not any(map(len, seen)):
            return None
        # Specks far from the teeth do not count.
        low, high = np.percentile(np.vstack(seen), (_SPECKS_PERCENT, 100 - _SPECKS_PERCENT), axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def poses_of_picks(self, picks: Bootstrap) -> tuple[tuple[Array, Array], list[str]]:
        """Return the poses that agree with picks, and the names of those that do not fit."""
        from jawusd.tracking.initialization.bootstrap import pose_from_picks

        poses, wrong = [], []
        for row, mesh in self.scans.items():
            pose, bad = pose_from_picks(getattr(picks, row), mesh.vertices, self.cameras, row)
            poses.append(pose)
            wrong += [f"{row[0].upper()}{number}" for number in bad]
        return (poses[0], poses[1]), wrong
