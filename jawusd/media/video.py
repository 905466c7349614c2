"""Read videos by presentation time with PyAV.

Frame k is the k-th image in presentation order. The table of presentation times is read once from the packets, without
decoding. To read an image, the reader seeks to the previous key frame and decodes from there. Every decoded image is
identified by its time stamp, so that B-frames, edit lists and variable rates cannot shift the count.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import AnyPath, CaptureError, naming_file
from jawusd.base.inputs import check_input, why_unreadable
from jawusd.formats.clips import timecode_rates
from jawusd.media.clip import Clip, Timeline, VideoFrame
from jawusd.media.containers import MOST_PX, open_container, slices_are_whole
from jawusd.media.pixels import (
    Colour,
    ColourPicture,
    DecodedPicture,
    coloured,
    converted,
    deep_rgb,
    to_display,
    turn_deg,
)

_REENCODE = "Re-encode the video, for example: ffmpeg -i IN -c:v libx264 -crf 12 OUT.mp4."
_CUT_OFF = "Copy the file again from the camera; repair an interrupted recording first."
# Decoders, by codec, that read the alpha channel of WebM; the channel is in a second stream, indicated by a
# flag in the metadata.
_ALPHA_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9"}
# Decoders that report damage with any number of threads. Decoders with error concealment (H.264, MPEG-4) mark an image
# as damaged only after threads have returned it: with eight threads, a third of the damage in H.264 was missed.
_THREADED = ("hevc", "prores", "ffv1")
_PROGRESSIVE = (0, 1)  # FFmpeg's field orders "unknown" and "progressive"


class Video(Clip):
    """Video file, read as a clip."""

    def __init__(
        self,
        path: AnyPath,
        colour_space: str | None = None,
        colour_config: Path | None = None,
    ) -> None:
        """Read the table of images and decode the first one; see `pixels` for colour spaces.

        Raises:
            CaptureError: the file is missing, empty, truncated, not a video, or has no presentation times.
        """
        self.path = Path(path)
        self._space = None if colour_space == "display" else colour_space
        self._config = colour_config
        check_input(self.path, CaptureError)
        if not self.path.is_file():
            raise CaptureError("there is no such video.", path=path, hint="Check the path in capture.toml.")
        if self.path.stat().st_size == 0:
            raise CaptureError("the file is empty.", path=path, hint="Copy it again from the camera.")
        with self._open() as container:
            stream = container.streams.video[0]
            announced = stream.frames
            self._time_base = float(stream.time_base or 1)
            self._has_checksums = False  # FFV1 with a checksum in each slice
            self._pts, self._seek_dts, self._key_before, stored = self._packet_table(container, stream)
            self.fps = float(stream.average_rate or 0)
            stored_aspect = stream.sample_aspect_ratio
            self.timecode = _timecode(container, stream)
            rates = {float(rate) for rate in timecode_rates(self.path)} if self.timecode else set()
            self.timecode_fps = rates.pop() if len(rates) == 1 else None
            self.is_interlaced = stream.codec_context.field_order not in _PROGRESSIVE
            hidden = {key.lower(): value for key, value in stream.metadata.items()}.get("alpha_mode") == "1"
            self._alpha_decoder = _ALPHA_DECODERS.get(stream.codec_context.name) if hidden else None
        self.count = len(self._pts)
        if self.count == 0:
            raise CaptureError("the video has no images.", path=path, hint="Copy it again from the camera.")
        if announced > stored:
            raise CaptureError(
                f"frame {stored} of {announced} cannot be read: the file is truncated.",
                path=path,
                hint="Copy it again from the camera, or trim it to the intact part.",
            )
        self.keys = np.unique(self._key_before)
        self.start_s = float(self._pts[0] * self._time_base)
        self.times_s = (self._pts - self._pts[0]) * self._time_base
        self.timeline = Timeline(self.times_s, self.fps)
        first = next(self._decode(0, 1, threads=1))[1]
        with naming_file(path):
            self.rotation_deg = turn_deg(first)
        aspect = float(stored_aspect or 1) or 1.0  # an aspect ratio of 0 means unknown
        turned = self.rotation_deg in (90, 270)
        self.pixel_aspect = 1 / aspect if turned else aspect
        self.size_px = (first.height, first.width) if turned else (first.width, first.height)
        stored_as = first.format
        self.has_alpha = self._alpha_decoder is not None or any(part.is_alpha for part in stored_as.components)
        self.is_rgb = stored_as.is_rgb or stored_as.has_palette
        self.is_gray = not self.is_rgb and len(stored_as.components) == 1

    def colour_pictures(self, wanted: Sequence[int | None], *, threads: int = 0) -> Iterator[ColourPicture | None]:
        """Yield RGB images; see `Clip.colour_pictures`."""
        if self._space is not None:
            yield from super().colour_pictures(wanted, threads=threads)
            return
        known = [number for number in wanted if number is not None]
        if known:
            self._check_range(known[0], known[-1] + 1)
        decoded = self._decode(known[0], known[-1] + 1, threads=threads) if known else iter(())
        for number in wanted:
            if number is None:
                yield None
            else:
                frame = next(frame for index, frame in decoded if index == number)
                yield DecodedPicture(frame, self.rotation_deg)

    def _converted(self, first: int, last: int, colour: Colour, threads: int) -> Iterator[VideoFrame]:
        for index, frame in self._decode(first, last, threads, alpha=colour == "rgba"):
            image = self._image(frame, colour)
            image.flags.writeable = False  # the gray buffer may be a reference image of the decoder, so it is read-only
            yield VideoFrame(index, image)

    def _image(self, frame: av.VideoFrame, colour: Colour) -> NDArray[np.uint8]:
        if self._space is None:
            width, height = self.size_px
            return converted(frame, colour, self.rotation_deg, (slice(0, height), slice(0, width)))
        stored, white = deep_rgb(frame)
        turned = np.rot90(stored, self.rotation_deg // 90)
        return coloured(to_display(turned, white, self._space, self._config), colour)

    def _open(self) -> av.container.InputContainer:
        try:
            container = open_container(self.path)
        except (av.FFmpegError, OSError) as error:
            said, hint = why_unreadable(self.path) or (f"the video cannot be opened ({error.strerror}).", _CUT_OFF)
            raise CaptureError(said, path=self.path, hint=hint) from error
        with contextlib.ExitStack() as stack:
            stack.enter_context(container)
            if not container.streams.video:
                raise CaptureError(
                    "the file has no video stream.", path=self.path, hint="Check the path in capture.toml."
                )
            context = container.streams.video[0].codec_context
            if context is None:
                raise CaptureError("the video codec is not supported.", path=self.path, hint=_REENCODE)
            if context.width * context.height > MOST_PX:
                found = f"images are {context.width} x {context.height} px; at most {MOST_PX} px in total are allowed."
                raise CaptureError(found, path=self.path, hint="Scale the video down.")
            stack.pop_all()
        return container

    def _packet_table(
        self, container: av.container.InputContainer, stream: av.VideoStream
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.intp], int]:
        """Return each image's time stamp, its key frame's decoding time and index, and the number of stored images."""
        pts, dts, key, stored = [], [], [], 0
        may_have_checksums = stream.codec_context.name == "ffv1"
        try:
            for packet in container.demux(stream):
                if packet.size == 0:  # packet that marks the end of the stream
                    continue
                stored += 1
                if may_have_checksums and not self._has_checksums:
                    self._has_checksums = slices_are_whole(bytes(packet))
                if packet.pts is None:
                    raise CaptureError(f"frame {stored - 1} has no time stamp.", path=self.path, hint=_REENCODE)
                if not packet.is_discard:
                    pts.append(packet.pts)
                    dts.append(packet.pts if packet.dts is None else packet.dts)
                    key.append(packet.is_keyframe)
        except av.FFmpegError:
            pass  # a truncated file: use the images before the truncation, fewer than `announced`
        order = np.argsort(pts, kind="stable")
        times = np.array(pts, np.int64)[order]
        is_key = np.array(key, bool)[order]
        latest = np.maximum.accumulate(np.where(is_key, np.arange(len(order)), 0)) if len(order) else order
        return times, np.array(dts, np.int64)[order][latest], latest, stored

    def _decode(self, first: int, last: int, threads: int, alpha: bool = False) -> Iterator[tuple[int, av.VideoFrame]]:
        """Yield (index, decoded frame) for indices first to last - 1; raise an error if an image is missing."""
        wanted, key, damaged = first, self._pts[self._key_before[first]], False
        broken: set[int] = set()
        with self._open() as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            stream.codec_context.thread_count = threads if stream.codec_context.name in _THREADED else 1
            try:
                if first > 0:
                    self._seek(container, stream, first)
                for frame in self._decoded(container, stream, alpha, int(self._pts[first]), broken):
                    if wanted == last:
                        return
                    if frame.pts is None or frame.pts < key:
                        continue
                    # Later images may depend on the damaged image.
                    damaged = damaged or frame.is_corrupt or frame.pts in broken
                    if frame.pts < self._pts[wanted]:
                        continue
                    if frame.pts > self._pts[wanted] or damaged:
                        break
                    self.is_interlaced = self.is_interlaced or bool(frame.interlaced_frame)
                    yield wanted, frame
                    wanted += 1
            except av.FFmpegError as error:
                raise self._undecodable(wanted) from error
        if wanted < last:
            raise self._undecodable(wanted)

    def _seek(self, container: av.container.InputContainer, stream: av.VideoStream, index: int) -> None:
        """Seek to the last key frame that is shown no later than an image, or to an earlier key frame.

        Containers seek by presentation or by decoding time. A decoding time would lead to one key frame too early in
        MP4, so it is used only if the presentation time leads past the image.
        """
        for time in (self._pts[self._key_before[index]], self._seek_dts[index]):
            container.seek(int(time), stream=stream, backward=True)
            reached = next(container.demux(stream))
            container.seek(int(time), stream=stream, backward=True)
            if reached.is_keyframe and reached.pts is not None and reached.pts <= self._pts[index]:
                return

    def _decoded(
        self, container: av.container.InputContainer, stream: av.VideoStream, alpha: bool, first: int, broken: set[int]
    ) -> Iterator[av.VideoFrame]:
        """Yield decoded images from the current position on; before time stamp `first`, decode only reference images.

        Time stamps of packets that flags or checksums mark as damaged are added to `broken`, up to the next key frame.
        """
        if not (alpha and self._alpha_decoder):
            damaged = False
            for packet in container.demux(stream):
                whole = not packet.is_corrupt and (not self._has_checksums or slices_are_whole(bytes(packet)))
                damaged = not whole or (damaged and not packet.is_keyframe)
                if damaged and packet.pts is not None:
                    broken.add(packet.pts)
                early = packet.pts is not None and packet.pts < first
                stream.codec_context.skip_frame = "NONREF" if early else "DEFAULT"
                yield from packet.decode()
            return
        decoder = av.CodecContext.create(self._alpha_decoder, "r")
        for packet in container.demux(stream):
            found = packet if packet.size else None
            yield from decoder.decode(found)  # type: ignore[attr-defined]  # PyAV's stub lacks the decoder's class

    def _undecodable(self, index: int) -> CaptureError:
        return CaptureError(
            f"frame {index} of {self.count} (at {self.times_s[index]:.3f} s) cannot be decoded.",
            path=self.path,
            hint="Copy the video again from the camera, or trim it to the intact part.",
        )


def _timecode(container: av.container.InputContainer, stream: av.VideoStream) -> str:
    """Return the time code of the first image, stored in the video stream, a time code track or the file's metadata."""
    tables = [stream.metadata, *(other.metadata for other in container.streams), container.metadata]
    return next((table["timecode"] for table in tables if table.get("timecode")), "")
