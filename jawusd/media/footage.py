"""Open the clip of a camera (a video or an image sequence), and read single frames from it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import CaptureError
from jawusd.formats.clips import ClipSource
from jawusd.formats.file_names import is_pattern
from jawusd.media.clip import Clip, VideoFrame
from jawusd.media.picture_sequence import PictureSequence
from jawusd.media.video import Video

_AHEAD = 24  # maximum number of images to skip by decoding; beyond that, seeking is faster
_BACK = 8  # number of images decoded together when images are read backwards
_KEPT_BYTES = 128 << 20


def open_clip(source: ClipSource | Path) -> Clip:
    """Open a video or an image sequence.

    Raises:
        CaptureError: the clip is missing or damaged.
    """
    source = source if isinstance(source, ClipSource) else ClipSource(source)
    if source.path.is_dir():
        raise CaptureError(
            "is a folder.", path=source.path, hint=f'Give the images in the folder, such as "{source.path.name}/*.png".'
        )
    clip: Clip = (
        PictureSequence(source)
        if is_pattern(source.path)
        else Video(source.path, source.colour_space, source.colour_config)
    )
    if source.timecode:
        clip.timecode, clip.timecode_fps = source.timecode, None
    clip.pixel_aspect = source.pixel_aspect or clip.pixel_aspect
    return clip


class FrameReader:
    """Random access to the images of one video; thread-safe.

    The decoder stays at the last image, so that reading the next one is fast. Recent images are cached. For other
    images, the reader seeks to the previous key frame.
    """

    def __init__(self, video: Clip) -> None:
        """Prepare to read images from a clip."""
        self.video = video
        width, height = video.size_px
        self._most = max(2, min(64, _KEPT_BYTES // (3 * width * height)))
        self._kept: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()
        self._running: Iterator[VideoFrame] | None = None
        self._next = self._last = 0
        self._lock = threading.Lock()

    def picture(self, index: int) -> NDArray[np.uint8]:
        """Return image number `index`, (h, w, 3) RGB uint8, read-only.

        Raises:
            CaptureError: the image lies outside the video or cannot be decoded.
        """
        if not 0 <= index < self.video.count:
            raise CaptureError(
                f"frame {index} is requested, but the video has frames 0 to {self.video.count - 1}.",
                path=self.video.path,
            )
        with self._lock:
            if index not in self._kept:
                self._read_to(index)
            self._kept.move_to_end(index)
            self._last = index
            return self._kept[index]

    def _read_to(self, index: int) -> None:
        running = self._running
        self._running = None  # if decoding fails, the next read opens the file again
        if running is None or not self._next <= index < self._next + _AHEAD:
            walks_back = self._last - _BACK <= index < self._last
            first = max(0, index - min(_BACK, self._most - 1)) if walks_back else index
            running, self._next = self.video.frames(first, colour="rgb"), min(first, index)
        for frame in running:
            self._kept[frame.index] = frame.image
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
            self._next = frame.index + 1
            if frame.index == index:
                break
        self._running = running
