"""Open the clip of a camera (a video or an image sequence), and read single frames from it.

Image sequences have one file per frame, of any bit depth, with gaps for missing files.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import CaptureError, naming_file
from jawusd.formats.clips import ClipSource
from jawusd.formats.file_names import is_pattern, numbered_files
from jawusd.media.clip import Clip, Timeline, VideoFrame, read_ahead
from jawusd.media.pictures import read_header, read_stored
from jawusd.media.pixels import Colour, Stored, coloured, to_display
from jawusd.media.video import Video

#: Frame rate [Hz] if neither the capture nor the files state one.
_USUAL_RATE = 24.0
_FASTEST_COUNT = 30.0  # maximum frame rate [Hz] of time codes in headers
_AHEAD = 2  # number of images that are decoded ahead


class PictureSequence(Clip):
    """An image sequence; see `Clip`.

    Attributes:
        numbers: numbers of the files, increasing, shape (count,).
        is_fractional: whether pixels are floating-point linear light, as in EXR.
    """

    def __init__(self, source: ClipSource) -> None:
        """Find the files and read the first one.

        Raises:
            CaptureError: there are no files, or the first file cannot be read.
        """
        self._source = source
        self.path = source.path
        self._files = list(numbered_files(source.path).items())
        self.numbers = np.array([number for number, _ in self._files], np.int64)
        self.count = len(self._files)
        header = read_header(self._files[0][1])
        self.fps = source.fps or header.fps or _USUAL_RATE
        self.timeline = Timeline.of_files(self.numbers, self.fps)
        self.times_s = (self.numbers - self.numbers[0]) / self.fps
        self.keys = np.arange(self.count)
        self.start_s, self.rotation_deg = 0.0, 0
        self.timecode = header.timecode
        # The time code in a header is limited to frame numbers below 40; at higher rates, several images have the same
        # number (SMPTE ST 12-3).
        self.timecode_fps = self.fps / math.ceil(self.fps / _FASTEST_COUNT - 0.01)
        self.pixel_aspect = header.pixel_aspect
        self._space = source.colour_space or header.colour_space
        first, _ = read_stored(self._files[0][1])
        height, width = first.shape[:2]
        self.size_px = (width, height)
        self.is_fractional = first.dtype.kind == "f"
        self.has_alpha, self.is_gray, self.is_rgb = False, first.ndim == 2, first.ndim == 3

    def _stored(self, index: int) -> tuple[Stored, int]:
        """Return an image as stored, and the value of white; raises CaptureError if it differs in size."""
        pixels, white = read_stored(self._files[index][1])
        if pixels.shape[1::-1] != self.size_px:
            height, width = pixels.shape[:2]
            raise CaptureError(
                f"is {width} x {height} px, but the first image is {self.size_px[0]} x {self.size_px[1]} px.",
                path=self._files[index][1],
            )
        return pixels, white

    def light(self, index: int) -> NDArray[np.float32]:
        """Return a floating-point image as linear light, (h, w, 3) RGB float32.

        Raises:
            CaptureError: the image cannot be read, or differs in size from the first image.
        """
        pixels = np.asarray(self._stored(index)[0], np.float32)
        return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)

    def _converted(self, first: int, last: int, colour: Colour, threads: int) -> Iterator[VideoFrame]:
        reads = (partial(self._frame, index, colour) for index in range(first, last))
        one_by_one = threads == 1 or last - first < 2
        return (read() for read in reads) if one_by_one else read_ahead(reads, _AHEAD, _AHEAD)

    def _frame(self, index: int, colour: Colour) -> VideoFrame:
        stored, white = self._stored(index)
        with naming_file(self.path):
            shown = to_display(stored, white, self._space, self._source.colour_config)
        image = coloured(shown, colour)
        image.flags.writeable = False
        return VideoFrame(index, image)


_MOST_SKIPPED = 24  # maximum number of images to skip by decoding; beyond that, seeking is faster
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

    The decoder stays at the last image, so that reading the next one is fast; recent images are cached.
    """

    def __init__(self, video: Clip) -> None:
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
        if running is None or not self._next <= index < self._next + _MOST_SKIPPED:
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
