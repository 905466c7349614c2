"""The footage of a build's take, shown beside the jaw in the viewer."""

from __future__ import annotations

import threading
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import FormatError, explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks, load_tracks
from jawusd.pipeline.cameras import load_cameras, open_backdrops, tracked_cameras, tracked_scans
from jawusd.pipeline.report import build_facts, is_build, recorded_offsets
from jawusd.pipeline.state import BuildState

if TYPE_CHECKING:
    from jawusd.media.side_by_side import CameraWall
    from jawusd.viewer.viewed import ViewedFootage

_TRACKS = "tracks.npz"
_TILE_PX = (480, 360)


def take_footage(folder: Path, tile_px: tuple[int, int] = _TILE_PX) -> ViewedFootage | None:
    """Return the footage, or the masks, of the take from which a rig was built, in images of a size (width, height).

    Returns None if the folder is not that of a build, or if a file of the build or the capture that it records cannot
    be read, as after the rig was moved.
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
    return ViewedFootage(tuple(names), frames, _Take(facts.capture, offsets, tracks, tile_px).picture)


class _Take:
    """Draws the images of a take, cropped to the teeth, with outlines of the tracked teeth; thread-safe."""

    def __init__(self, capture: Capture, offsets: dict[str, int], tracks: Tracks, tile_px: tuple[int, int]) -> None:
        self._capture, self._offsets, self._tracks, self._tile_px = capture, offsets, tracks, tile_px
        self._walls: dict[str, CameraWall] = {}
        self._lock = threading.Lock()

    @cached_property
    def _scans(self) -> tuple[Mesh, Mesh]:
        return tracked_scans(self._capture, self._tracks)

    @explain_missing_packages()
    def picture(self, name: str, frame: int) -> NDArray[np.uint8]:
        """Return a camera's image at a frame of the reference camera, RGB (h, w, 3); files are opened on first use.

        Raises:
            CaptureError, CalibrationError: the footage or the calibration cannot be read.
            MissingDependencyError: a package is missing.
        """
        from jawusd.media.overlay import placed_scans

        with self._lock:
            wall = self._walls.get(name) or self._opened(name)
        row = self._tracks.row_of(frame)
        scans = [] if row is None else placed_scans(self._tracks, row, self._scans)
        return wall.draw(frame, scans, fill=0.0)

    def _opened(self, name: str) -> CameraWall:
        from jawusd.media.side_by_side import CameraWall

        source = next(source for source in self._capture.cameras if source.name == name)
        one = self._capture.model_copy(update={"cameras": (source,)})
        cameras = {camera.name: camera for camera in tracked_cameras(load_cameras(self._capture), self._tracks)}
        backdrops = open_backdrops(one, self._offsets)
        self._walls[name] = CameraWall({name: cameras[name]}, backdrops, self._tracks, self._scans, self._tile_px)
        return self._walls[name]
