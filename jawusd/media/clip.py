"""What a clip of a camera gives, whether it is one video file or numbered pictures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError
from jawusd.media.pixels import Colour, ColourPicture, Slices
from jawusd.media.timeline import Timeline

#: What is wrong with an interlaced clip, and what to do.
INTERLACED = "its pictures are marked as interlaced: each is woven of two instants, half a frame apart"
INTERLACED_HINT = (
    "Record progressive pictures; or make a picture of each instant and double fps, for all clips alike: "
    "ffmpeg -i IN -vf bwdif=mode=send_field -c:v libx264 -crf 12 OUT.mp4."
)


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """One decoded picture."""

    index: int  # number in order of presentation, the first is 0
    time_s: float  # presentation time after the first picture [s]
    image: NDArray[np.uint8]  # (h, w) gray, (h, w, 3) RGB or (h, w, 4) RGBA, uint8, 0..255, read-only


class Clip(ABC):
    """Give access to the pictures of a clip; holds no open file, so threads may share it.

    Attributes:
        path: the file, or the pattern of the files.
        count: number of pictures.
        times_s: presentation times after the first picture [s], shape (count,), increasing.
        timeline: which picture is shown at which frame.
        keys: numbers of pictures that decode by themselves, shape (n,).
        start_s: presentation time of the first picture in the file, where its sound counts from too [s].
        fps: average pictures per second.
        rotation_deg: counter-clockwise turn stored in the file: 0, 90, 180 or 270. It is applied to every picture.
        size_px: (width, height) after rotation.
        pixel_aspect: width of a pixel over its height, after rotation, as the file says; pictures are left as stored.
        timecode: of the first picture, as HH:MM:SS:FF; "" if the file has none.
        timecode_fps: how many frames per second it counts; None if the file does not say.
        is_interlaced: pictures, as far as they were decoded, are marked as woven of two instants.
        has_alpha: the pictures carry transparency.
        is_gray: they are stored as one channel.
        is_rgb: they are stored as red, green and blue.
    """

    path: Path
    count: int
    times_s: Array
    timeline: Timeline
    keys: NDArray[np.intp]
    start_s: float
    fps: float
    rotation_deg: int
    size_px: tuple[int, int]
    pixel_aspect: float
    timecode: str
    timecode_fps: float | None = None
    is_interlaced: bool = False
    has_alpha: bool
    is_gray: bool
    is_rgb: bool

    def frames(
        self,
        first: int = 0,
        last: int | None = None,
        *,
        colour: Colour = "gray",
        region: tuple[int, int, int, int] | None = None,
        threads: int = 0,
    ) -> Iterator[VideoFrame]:
        """Return an iterator over the pictures first, first + 1, .. last - 1.

        Gray is the luma at full range (black 0, white 255); for gray and full-range files it is the decoder's own
        buffer, without a copy.

        Args:
            first: number of the first picture.
            last: one after the last picture; None = to the end.
            colour: what the pictures come as.
            region: (x0, y0, x1, y1) [px], x1 and y1 exclusive, in the turned picture; None = all of it.
            threads: decoder threads; 0 lets the codec choose.

        Raises:
            CaptureError: a picture lies outside the file or cannot be decoded.
            ValueError: the region is empty or outside the picture.
        """
        last = self.count if last is None else last
        self._check_range(first, last)
        width, height = self.size_px
        x0, y0, x1, y1 = region or (0, 0, width, height)
        if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
            raise ValueError(f"region {region} is not inside the picture of {width} x {height} px")
        window = (slice(y0, y1), slice(x0, x1))
        return self._converted(first, last, colour, window, threads)

    def pictures(
        self, wanted: Sequence[int | None], *, colour: Colour = "gray", threads: int = 0
    ) -> Iterator[NDArray[np.uint8] | None]:
        """Yield a picture for each of increasing numbers, None for None, decoding what lies between only once.

        Args:
            wanted: numbers of pictures, rising, and None, for which nothing comes.
            colour: what the pictures come as.
            threads: decoder threads; 0 lets the codec choose.

        Raises:
            CaptureError: a picture lies outside the file or cannot be decoded.
        """
        known = [number for number in wanted if number is not None]
        decoded = self.frames(known[0], known[-1] + 1, colour=colour, threads=threads) if known else iter(())
        for number in wanted:
            yield None if number is None else next(frame.image for frame in decoded if frame.index == number)

    def colour_pictures(self, wanted: Sequence[int | None], *, threads: int = 0) -> Iterator[ColourPicture | None]:
        """Yield as `pictures` does, in RGB; pictures of videos are converted by the parts that are asked for.

        Raises:
            CaptureError: a picture lies outside the file or cannot be decoded.
        """
        yield from self.pictures(wanted, colour="rgb", threads=threads)

    def _check_range(self, first: int, last: int) -> None:
        if not 0 <= first <= last <= self.count:
            raise CaptureError(
                f"frames {first} to {last - 1} asked for, the video holds frames 0 to {self.count - 1}.",
                path=self.path,
                hint="Correct `frames` in capture.toml, or copy the video again if it should be longer.",
            )

    @abstractmethod
    def _converted(self, first: int, last: int, colour: Colour, window: Slices, threads: int) -> Iterator[VideoFrame]:
        """Yield the pictures first to last - 1."""
