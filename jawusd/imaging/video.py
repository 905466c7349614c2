"""Read videos by presentation time with PyAV.

Frame k is the k-th picture in order of presentation, whatever order the file stores them in. The table of times is
read from the packets once, without decoding; seeking goes to the key frame before and decodes from there, and every
decoded picture is placed by its time stamp, so that B-frames, edit lists and variable rates cannot shift the count.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from jawusd.errors import CaptureError
from jawusd.imaging.pixels import Colour, Slices, converted
from jawusd.imaging.timeline import Timeline

_REENCODE = "Re-encode it, for example: ffmpeg -i IN -c:v libx264 -crf 12 OUT.mp4."
# WebM keeps transparency in a second stream, which only these decoders read; announced in the file's meta data.
_ALPHA_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9"}


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """One decoded picture."""

    index: int  # number in order of presentation, the first is 0
    time_s: float  # presentation time after the first picture [s]
    image: NDArray[np.uint8]  # (h, w) gray, (h, w, 3) RGB or (h, w, 4) RGBA, uint8, 0..255, read-only


class Video:
    """Give access to the pictures of a video file; holds no open file, so threads may share it.

    Attributes:
        count: number of pictures.
        times_s: presentation times after the first picture [s], shape (count,), increasing.
        timeline: which picture is shown at which frame.
        keys: numbers of pictures that decode by themselves, shape (n,).
        start_s: presentation time of the first picture in the file, where its sound counts from too [s].
        fps: average pictures per second.
        rotation_deg: counter-clockwise turn stored in the file: 0, 90, 180 or 270. It is applied to every picture.
        size_px: (width, height) after rotation.
        has_alpha: the pictures carry transparency.
        is_gray: they are stored as one channel.
        is_rgb: they are stored as red, green and blue.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Read the table of frames and the first picture.

        Raises:
            CaptureError: the file is missing, empty, truncated, not a video, or carries no presentation times.
        """
        self.path = Path(path)
        if not self.path.is_file():
            raise CaptureError("no such video.", path=path, hint="Check the path in capture.toml.")
        if self.path.stat().st_size == 0:
            raise CaptureError("the file is empty.", path=path, hint="Copy it again from the camera.")
        with self._open() as container:
            stream = container.streams.video[0]
            announced = stream.frames
            self._time_base = float(stream.time_base or 1)
            self._pts, self._seek_dts, stored = self._packet_table(container, stream)
            self.fps = float(stream.average_rate or 0)
            hidden = {key.lower(): value for key, value in stream.metadata.items()}.get("alpha_mode") == "1"
            self._alpha_decoder = _ALPHA_DECODERS.get(stream.codec_context.name) if hidden else None
        self.count = len(self._pts)
        if self.count == 0:
            raise CaptureError("the video holds no pictures.", path=path, hint="Copy it again from the camera.")
        if announced > stored:
            raise CaptureError(
                f"frame {stored} of {announced} cannot be read: the file is truncated.",
                path=path,
                hint="Copy it again from the camera, or cut it to the part that is whole.",
            )
        self.keys = np.unique(self._seek_dts, return_index=True)[1]
        self.start_s = float(self._pts[0] * self._time_base)
        self.times_s = (self._pts - self._pts[0]) * self._time_base
        self.timeline = Timeline(self.times_s, self.fps)
        self.rotation_deg = 0
        first = next(self._decode(0, 1, threads=1))[1]
        if first.rotation % 90:
            raise CaptureError(
                f"the file asks for a turn by {first.rotation} degrees; only quarter turns can be honoured.",
                path=path,
                hint=_REENCODE,
            )
        self.rotation_deg = first.rotation % 360
        turned = self.rotation_deg in (90, 270)
        self.size_px = (first.height, first.width) if turned else (first.width, first.height)
        stored_as = first.format
        self.has_alpha = self._alpha_decoder is not None or any(part.is_alpha for part in stored_as.components)
        self.is_rgb = stored_as.is_rgb or stored_as.has_palette
        self.is_gray = not self.is_rgb and len(stored_as.components) == 1

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
            last: one after the last picture; None = to the end.
            region: (x0, y0, x1, y1) [px], x1 and y1 exclusive, in the turned picture; None = all of it.
            threads: decoder threads; 0 lets the codec choose.

        Raises:
            CaptureError: a picture lies outside the file or cannot be decoded.
            ValueError: the region is empty or outside the picture.
        """
        last = self.count if last is None else last
        if not 0 <= first <= last <= self.count:
            raise CaptureError(
                f"frames {first} to {last - 1} asked for, the video holds frames 0 to {self.count - 1}.",
                path=self.path,
                hint="Correct `frames` in capture.toml, or copy the video again if it should be longer.",
            )
        width, height = self.size_px
        x0, y0, x1, y1 = region or (0, 0, width, height)
        if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
            raise ValueError(f"region {region} is not inside the picture of {width} x {height} px")
        window = (slice(y0, y1), slice(x0, x1))
        return self._converted(first, last, colour, window, threads)

    def pictures(self, wanted: Sequence[int | None], *, colour: Colour = "gray") -> Iterator[NDArray[np.uint8] | None]:
        """Yield a picture for each of increasing numbers, None for None, decoding what lies between only once.

        Raises:
            CaptureError: a picture lies outside the file or cannot be decoded.
        """
        known = [number for number in wanted if number is not None]
        decoded = self.frames(known[0], known[-1] + 1, colour=colour) if known else iter(())
        for number in wanted:
            yield None if number is None else next(frame.image for frame in decoded if frame.index == number)

    def _converted(self, first: int, last: int, colour: Colour, window: Slices, threads: int) -> Iterator[VideoFrame]:
        for index, frame in self._decode(first, last, threads, alpha=colour == "rgba"):
            image = converted(frame, colour, self.rotation_deg, window)
            image.flags.writeable = False  # the gray buffer may be a reference the decoder still needs
            yield VideoFrame(index, float(self.times_s[index]), image)

    def _open(self) -> av.container.InputContainer:
        try:
            container = av.open(str(self.path), metadata_errors="replace")
        except (av.FFmpegError, OSError) as error:
            raise CaptureError(
                f"the video cannot be opened ({error.strerror}).",
                path=self.path,
                hint="Copy it again from the camera; a recording that was cut off has to be repaired first.",
            ) from error
        if not container.streams.video:
            container.close()
            raise CaptureError("the file holds no video stream.", path=self.path, hint="Check capture.toml.")
        if container.streams.video[0].codec_context is None:
            container.close()
            raise CaptureError("the pictures are in a codec that is not known here.", path=self.path, hint=_REENCODE)
        return container

    def _packet_table(
        self, container: av.container.InputContainer, stream: av.VideoStream
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
        """Return per picture its time stamp and where to seek for it, and how many pictures the file stores."""
        pts, dts, key, stored = [], [], [], 0
        try:
            for packet in container.demux(stream):
                if packet.size == 0:  # end of stream
                    continue
                stored += 1
                if packet.pts is None:
                    raise CaptureError(f"frame {stored - 1} has no time stamp.", path=self.path, hint=_REENCODE)
                if not packet.is_discard:
                    pts.append(packet.pts)
                    dts.append(packet.pts if packet.dts is None else packet.dts)
                    key.append(packet.is_keyframe)
        except av.FFmpegError:
            # A truncated file: what precedes the break counts; `announced` shows whether more was promised.
            pass
        order = np.argsort(pts, kind="stable")
        times = np.array(pts, np.int64)[order]
        # Seeking by the decoding time of the last key frame shown no later than the picture: it decodes before it.
        is_key = np.array(key, bool)[order]
        latest = np.maximum.accumulate(np.where(is_key, np.arange(len(order)), 0)) if len(order) else order
        return times, np.array(dts, np.int64)[order][latest], stored

    def _decode(self, first: int, last: int, threads: int, alpha: bool = False) -> Iterator[tuple[int, av.VideoFrame]]:
        """Yield (index, decoded frame) for every index of [first, last), or raise naming the one that is missing."""
        wanted = first
        with self._open() as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            stream.codec_context.thread_count = threads
            if first > 0:
                container.seek(int(self._seek_dts[first]), stream=stream, backward=True)
            try:
                for frame in self._decoded(container, stream, alpha):
                    if wanted == last:
                        return
                    if frame.pts is None or frame.pts < self._pts[wanted]:
                        continue
                    if frame.pts > self._pts[wanted] or frame.is_corrupt:
                        break
                    yield wanted, frame
                    wanted += 1
            except av.FFmpegError as error:
                raise self._undecodable(wanted) from error
        if wanted < last:
            raise self._undecodable(wanted)

    def _decoded(
        self, container: av.container.InputContainer, stream: av.VideoStream, alpha: bool
    ) -> Iterator[av.VideoFrame]:
        if not (alpha and self._alpha_decoder):
            yield from container.decode(stream)
            return
        decoder = av.CodecContext.create(self._alpha_decoder, "r")
        for packet in container.demux(stream):
            # PyAV's stub lacks the decoder's class.
            yield from decoder.decode(packet if packet.size else None)  # type: ignore[attr-defined]

    def _undecodable(self, index: int) -> CaptureError:
        return CaptureError(
            f"frame {index} of {self.count} (at {self.times_s[index]:.3f} s) cannot be decoded.",
            path=self.path,
            hint="Copy the video again from the camera, or cut it to the part that is whole.",
        )
