"""Images of all cameras by frame, and windows around the teeth, undistorted and downscaled."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import repeat
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import Camera
from jawusd.media.clip import Clip, read_ahead, read_backwards
from jawusd.media.pixels import ColourPicture
from jawusd.media.working_view import WorkingView, remap

_NODE_PX = 8  # spacing of the grid on which the undistortion map is computed
# First and largest number of frames that are buffered when reading backwards, and number of frames that are kept after
# reading. 16 frames take 50 MB per full HD camera.
_FIRST_CHUNK, _CHUNK, _KEPT = 2, 16, 6

Pictures: TypeAlias = "dict[str, ColourPicture | None]"
_Frames = range  # alias of the built-in type, because a class below has a method `range`


@dataclass(frozen=True, eq=False)
class Window:
    """A window: part of a working image."""

    camera: Camera  # pinhole camera of the window
    rgb: NDArray[np.uint8]  # 8-bit RGB pixels, shape (h, w, 3)
    corner: tuple[int, int]  # first column and row of the window in the working image [px]


class PictureFrame:
    """Factory of windows around the teeth in the images of one camera."""

    def __init__(self, source: Camera, centre_world: Array, px_per_mm: float) -> None:
        """Choose the working image size from the resolution at the teeth, near `centre_world` [mm]; never upsample."""
        self.source = source
        self._working, self.px_per_mm = WorkingView.near(source, centre_world, px_per_mm)
        self._back = _positions(source, self._working.camera)

    def window(self, image: ColourPicture, points_world: Array, margin_mm: float) -> Window | None:
        """Return the window around world points (N, 3) [mm] in a recorded image (H, W, 3); None if out of view."""
        camera = self._working.camera
        seen = camera.project_pinhole(points_world[camera.depth(points_world) > 0])
        if not len(seen):
            return None
        margin = margin_mm * self.px_per_mm
        limit = np.array(camera.size_px)
        low = np.clip(np.floor(seen.min(0) - margin), 0, limit).astype(int)
        high = np.clip(np.ceil(seen.max(0) + margin) + 1, 0, limit).astype(int)
        if (high - low < 8).any():
            return None
        part = self._working.part(image, (slice(low[1], high[1]), slice(low[0], high[0])))
        size = (int(high[0] - low[0]), int(high[1] - low[1]))
        cropped = camera.cropped(int(low[0]), int(low[1]), size)
        return Window(cropped, part, (int(low[0]), int(low[1])))

    def given(self, mask: NDArray[np.uint8], window: Window) -> NDArray[np.uint8]:
        """Return the part of a recorded mask (H, W), uint8, that lies in a window, shape (h, w)."""
        (x, y), (width, height) = window.corner, window.camera.size_px
        return self._working.part(mask, (slice(y, y + height), slice(x, x + width)))

    def recorded(self, shares: NDArray[np.float32], window: Window) -> NDArray[np.uint8]:
        """Convert the tooth coverage in a window, shape (h, w), to a mask at recorded size with values 0 and 255."""
        nodes = self._back[::_NODE_PX, ::_NODE_PX] - np.array(window.corner, np.float32)
        limit = np.array(shares.shape[::-1], np.float32) + _NODE_PX
        inside: Mask = np.all((nodes > -_NODE_PX) & (nodes < limit), axis=2)
        rows, columns = (np.flatnonzero(inside.any(axis)) * _NODE_PX for axis in (1, 0))
        out = np.zeros(self._back.shape[:2], np.uint8)
        if len(rows):
            box = (slice(rows[0], rows[-1] + _NODE_PX), slice(columns[0], columns[-1] + _NODE_PX))
            local = self._back[box] - np.array(window.corner, np.float32)
            out[box] = np.where(remap(shares, local) > 0.5, 255, 0)
        return out


def _positions(source: Camera, working: Camera) -> NDArray[np.float32]:
    """Return the working pixel of each recorded pixel, shape (H, W, 2)."""
    width, height = source.size_px
    columns, rows = (np.arange(0, size + _NODE_PX, _NODE_PX) for size in (width, height))
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).astype(np.float64)
    pinhole = source.undistort_pixels(grid)
    scale = np.array(working.size_px) / np.array(source.size_px)
    nodes = ((pinhole + 0.5) * scale - 0.5).astype(np.float32)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.asarray(cv2.remap(nodes, x / _NODE_PX, y / _NODE_PX, cv2.INTER_LINEAR), np.float32)


class ColourFootage:
    """Images of all cameras, which can be read in both directions of time."""

    def __init__(self, videos: Mapping[str, Clip], offsets: Mapping[str, int]) -> None:
        """Open the videos; `offsets` are reference frame number minus own frame number, by camera name."""
        self._videos, self._offsets = dict(videos), dict(offsets)
        self._latest: dict[int, Pictures] = {}  # the images read last, by frame

    def own(self, name: str, frame: int) -> int | None:
        """Return a camera's image index at a frame of the reference camera; None if the camera has no image there."""
        return self._videos[name].timeline.picture(frame - self._offsets[name])

    def number(self, name: str, frame: int) -> int | None:
        """Return the number of a camera's mask file at a frame of the reference camera; None without an image."""
        return self._videos[name].timeline.number(frame - self._offsets[name])

    def range(self) -> tuple[int, int]:
        """Return the first frame with images of at least two cameras, and the end of the range (exclusive)."""
        starts = sorted(self._offsets[name] for name in self._videos)
        stops = sorted(self._offsets[name] + video.timeline.count for name, video in self._videos.items())
        return max(0, starts[min(1, len(starts) - 1)]), stops[-min(2, len(stops))]

    def at(self, frame: int) -> Pictures:
        """Return the RGB images (H, W, 3) of the cameras at a frame of the reference camera, None where missing."""
        return next(self.walk(range(frame, frame + 1)))[1]

    def walk(self, frames: _Frames) -> Iterator[tuple[int, Pictures]]:
        """Yield frame numbers with their images; descending ranges are read forwards in chunks.

        The images read last are kept, since trackers often go back by a few frames.

        Raises:
            CaptureError: an image cannot be decoded.
        """
        start = 0
        while start < len(frames) and frames[start] in self._latest:
            yield frames[start], self._latest[frames[start]]
            start += 1
        rest = frames[start:]
        backwards = read_backwards(rest, self._forwards, _FIRST_CHUNK, _CHUNK)
        for frame, pictures in self._forwards(rest) if frames.step > 0 else backwards:
            self._latest[frame] = pictures
            while len(self._latest) > _KEPT:
                del self._latest[next(iter(self._latest))]
            yield frame, pictures

    def _forwards(self, frames: _Frames) -> Iterator[tuple[int, Pictures]]:
        wanted = {name: [self.own(name, frame) for frame in frames] for name in self._videos}
        readers = {name: self._videos[name].colour_pictures(own) for name, own in wanted.items()}

        def read() -> Pictures:
            return {name: next(reader) for name, reader in readers.items()}

        return zip(frames, read_ahead(repeat(read, len(frames)), 1, 1), strict=True)
