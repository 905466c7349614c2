"""Read image sequences as clips: one file per frame, of any bit depth, with gaps for missing files."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import CaptureError
from jawusd.formats.clips import ClipSource
from jawusd.formats.file_names import numbered_files
from jawusd.media.clip import Clip, VideoFrame
from jawusd.media.display import to_display
from jawusd.media.pictures import StoredPicture, read_header, read_stored
from jawusd.media.pixels import Colour, Slices, coloured
from jawusd.media.timeline import Timeline

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
        first = self._stored(0)
        height, width = first.pixels.shape[:2]
        self.size_px = (width, height)
        self.is_fractional = first.pixels.dtype.kind == "f"
        self.has_alpha, self.is_gray, self.is_rgb = False, first.pixels.ndim == 2, first.pixels.ndim == 3

    def stored(self, index: int) -> StoredPicture:
        """Return an image as stored.

        Raises:
            CaptureError: the image cannot be read, or differs in size from the first image.
        """
        found = self._stored(index)
        if found.pixels.shape[1::-1] != self.size_px:
            height, width = found.pixels.shape[:2]
            raise CaptureError(
                f"is {width} x {height} px, but the first image is {self.size_px[0]} x {self.size_px[1]} px.",
                path=self._files[index][1],
            )
        return found

    def light(self, index: int) -> NDArray[np.float32]:
        """Return a floating-point image as linear light, (h, w, 3) RGB float32.

        Raises:
            CaptureError: see `stored`.
        """
        pixels = np.asarray(self.stored(index).pixels, np.float32)
        return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)

    def _stored(self, index: int) -> StoredPicture:
        return read_stored(self._files[index][1])

    def _converted(self, first: int, last: int, colour: Colour, window: Slices, threads: int) -> Iterator[VideoFrame]:
        if threads == 1 or last - first < 2:
            for index in range(first, last):
                yield self._frame(index, colour, window)
            return
        waiting: deque[Future[VideoFrame]] = deque()
        with ThreadPoolExecutor(max_workers=_AHEAD) as pool:
            try:
                for index in range(first, last):
                    waiting.append(pool.submit(self._frame, index, colour, window))
                    if len(waiting) > _AHEAD:
                        yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)

    def _frame(self, index: int, colour: Colour, window: Slices) -> VideoFrame:
        stored = self.stored(index)
        try:
            shown = to_display(stored.pixels[window], stored.largest, self._space, self._source.colour_config)
        except CaptureError as error:
            error.path = error.path or str(self.path)
            raise
        image = coloured(shown, colour)
        image.flags.writeable = False
        return VideoFrame(index, float(self.times_s[index]), image)
