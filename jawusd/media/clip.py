"""Interface of clips, which videos and image sequences implement, and their timelines.

A timeline maps evenly spaced frames to the images of a video, whose presentation times may be irregular.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError
from jawusd.media.pixels import Colour, ColourPicture

_Item = TypeVar("_Item")


def read_backwards(frames: range, read: Callable[[range], Iterable[_Item]], first: int, most: int) -> Iterator[_Item]:
    """Yield the items of a range of frames in steps of -1, read forwards in chunks; `read` returns those of a chunk.

    The first chunk has `first` frames, and each is twice as long as the one before, up to `most`, since often only a
    few frames are needed.
    """
    start, count = 0, first
    while start < len(frames):
        held = list(read(frames[start : start + count][::-1]))
        while held:
            yield held.pop()
        start, count = start + count, min(2 * count, most)


def read_ahead(reads: Iterable[Callable[[], _Item]], threads: int, count: int) -> Iterator[_Item]:
    """Yield the results of reads in order; threads do up to `count` of them while the caller works."""
    coming = iter(reads)
    pool = ThreadPoolExecutor(threads, "jawusd-ahead")
    try:
        waiting = deque(pool.submit(read) for read in islice(coming, count))
        while waiting:
            result = waiting.popleft()
            waiting.extend(pool.submit(read) for read in islice(coming, 1))
            yield result.result()
    finally:
        pool.shutdown(cancel_futures=True)


class Timeline:
    """Assignment of the images of a video to a regular grid of frames by presentation time.

    Frame k is the image that is displayed k nominal frame durations after the first image; some frames may have no
    image.

    Attributes:
        numbers: frame number of each image, increasing, shape (n,).
        count: one past the frame number of the last image.
        stored: file number of each image, increasing, shape (n,); 0, 1, 2, ... for videos.
    """

    def __init__(self, times_s: Array, fps: float) -> None:
        """Fit the grid to presentation times (n,) [s]; for one or two images, use the file's average rate."""
        self._set(*_grid(times_s, fps), np.arange(len(times_s)))

    @classmethod
    def of_files(cls, stored: NDArray[np.int64], fps: float) -> Timeline:
        """Return the timeline of images with increasing numbers (n,): the first is frame 0; gaps have no image."""
        line = cls.__new__(cls)
        line._set(stored - stored[0], fps, stored)
        return line

    def _set(self, numbers: NDArray[np.int64], rate: float, stored: NDArray[np.int64]) -> None:
        self.numbers, self.rate, self.stored = numbers, rate, stored
        self.count = int(numbers[-1]) + 1
        # If two images belong to one frame, use the first.
        self._picture = dict(zip(numbers[::-1].tolist(), range(len(numbers) - 1, -1, -1)))

    @property
    def is_numbered(self) -> bool:
        """Whether the file numbers of the images differ from 0, 1, 2, ..."""
        return bool(self.stored[0] != 0 or self.stored[-1] != len(self.stored) - 1)

    def number(self, frame: int) -> int | None:
        """Return the file number of the image shown at a frame, or None."""
        picture = self.picture(frame)
        return None if picture is None else int(self.stored[picture])

    @property
    def missing(self) -> int:
        """Return the number of frames without an image."""
        return self.count - len(self._picture)

    def picture(self, frame: int) -> int | None:
        """Return the index of the image shown at a frame; None outside the video or without an image."""
        return self._picture.get(int(frame))


def _grid(times_s: Array, fps: float) -> tuple[NDArray[np.int64], float]:
    """Return the frame number of each image, and the frame rate [Hz]."""
    steps = np.diff(times_s)
    if len(steps) < 2 or not (median := float(np.median(steps))) > 0:
        return np.arange(len(times_s)), fps
    # Use the mean interval between adjacent frames: gaps would bias the mean of all intervals, and rounded time stamps
    # would bias the median.
    period = float(steps[(steps > 0.5 * median) & (steps < 1.5 * median)].mean())
    last = 16  # jitter causes an error of a few per mille, so refine the period on growing intervals
    while True:
        stretch = times_s[:last]
        numbers = np.round(stretch / period)
        period = float((numbers @ stretch) / (numbers @ numbers))
        if last >= len(times_s):
            return np.round(times_s / period).astype(np.int64), 1 / period
        last *= 2


#: Message and hint for interlaced clips.
INTERLACED = "its images are marked as interlaced: each combines two fields, half a frame apart"
INTERLACED_HINT = (
    "Record progressive video; or convert every field to a frame and double fps, for all clips: "
    "ffmpeg -i IN -vf bwdif=mode=send_field -c:v libx264 -crf 12 OUT.mp4."
)


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """One decoded image of a clip."""

    index: int  # index of the image in presentation order, from 0
    image: NDArray[np.uint8]  # pixels (h, w) gray, (h, w, 3) RGB or (h, w, 4) RGBA, uint8, read-only


class Clip(ABC):
    """A video or image sequence. No file stays open, so threads may share a clip."""

    path: Path  # the video file, or the pattern of the image files
    count: int  # number of images
    times_s: Array  # increasing presentation times relative to the first image [s], shape (count,)
    timeline: Timeline  # maps frames to images
    keys: NDArray[np.intp]  # indices of key frames, shape (n,)
    start_s: float  # presentation time of the file's first image, on the same clock as its sound [s]
    fps: float  # average number of images per second
    rotation_deg: int  # counter-clockwise rotation stored in the file, 0, 90, 180 or 270, applied to every image
    size_px: tuple[int, int]  # (width, height) after rotation
    pixel_aspect: float  # stated width of a pixel divided by its height, after rotation; images are not resampled
    timecode: str  # time code of the first image, as HH:MM:SS:FF; "" if there is none
    timecode_fps: float | None = None  # frame rate of the time code [Hz]; None if unknown
    is_interlaced: bool = False  # whether any image decoded so far was marked as interlaced
    has_alpha: bool  # whether the images have an alpha channel
    is_gray: bool  # whether the images are stored as one channel
    is_rgb: bool  # whether the images are stored as RGB

    def frames(
        self,
        first: int = 0,
        last: int | None = None,
        *,
        colour: Colour = "gray",
        threads: int = 0,
    ) -> Iterator[VideoFrame]:
        """Return an iterator over the images with indices first to last - 1; by default, to the end of the clip.

        Gray images are the luma at full range (black 0, white 255); for gray and full-range files, they are the
        decoder's own buffer, without a copy. With 0 decoder threads, the codec chooses their number.

        Raises:
            CaptureError: an image lies outside the file or cannot be decoded.
        """
        last = self.count if last is None else last
        self._check_range(first, last)
        return self._converted(first, last, colour, threads)

    def pictures(
        self, wanted: Sequence[int | None], *, colour: Colour = "gray", threads: int = 0
    ) -> Iterator[NDArray[np.uint8] | None]:
        """Yield the image at each of the increasing indices, None for None; no image is decoded twice; see `frames`.

        Raises:
            CaptureError: an image lies outside the file or cannot be decoded.
        """
        known = [number for number in wanted if number is not None]
        decoded = self.frames(known[0], known[-1] + 1, colour=colour, threads=threads) if known else iter(())
        for number in wanted:
            yield None if number is None else next(frame.image for frame in decoded if frame.index == number)

    def colour_pictures(self, wanted: Sequence[int | None], *, threads: int = 0) -> Iterator[ColourPicture | None]:
        """Yield RGB images like `pictures`; for videos, only the accessed parts of an image are converted.

        Raises:
            CaptureError: an image lies outside the file or cannot be decoded.
        """
        yield from self.pictures(wanted, colour="rgb", threads=threads)

    def _check_range(self, first: int, last: int) -> None:
        if not 0 <= first <= last <= self.count:
            raise CaptureError(
                f"frames {first} to {last - 1} are requested, but the video has frames 0 to {self.count - 1}.",
                path=self.path,
                hint="Correct `frames` in capture.toml, or copy the video again if the video should be longer.",
            )

    @abstractmethod
    def _converted(self, first: int, last: int, colour: Colour, threads: int) -> Iterator[VideoFrame]:
        """Yield the images with indices first to last - 1."""
