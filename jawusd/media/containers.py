"""Open media files in self-contained containers, list decodable codecs, and read sound as one channel."""

from __future__ import annotations

import os
import zlib
from typing import NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import AnyPath, CaptureError
from jawusd.base.inputs import check_input

#: Maximum number of pixels of an image, four times 8K; a small header can declare an image that exhausts memory.
MOST_PX = 1 << 27
# Self-contained file formats; playlists (HLS, DASH, concat, SDP) are excluded: they refer to other files and URLs.
FORMATS = (
    "mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm", "avi", "mpegts", "mpeg", "mpegvideo", "mxf", "flv", "ogg", "asf", "nut",
    "ivf", "dv", "h264", "hevc", "av1", "obu", "m4v", "mjpeg", "yuv4mpegpipe", "gif", "apng", "rm", "gxf", "wtv", "y4m",
    "wav", "w64", "aiff", "au", "caf", "flac", "mp3", "aac", "ac3", "mp2",
)  # fmt: skip


#: FFmpeg's single-image formats.
PICTURES = (
    "image2", "png_pipe", "exr_pipe", "dpx_pipe", "tiff_pipe", "bmp_pipe", "jpeg_pipe", "j2k_pipe", "webp_pipe",
    "pam_pipe", "pgm_pipe", "ppm_pipe", "sgi_pipe", "cin_pipe", "hdr_pipe",
)  # fmt: skip


# Decoder options for strict error detection, including checksums. They are enabled only where they help: the TIFF
# decoder would reject valid files, and other decoders would not detect more errors.
_STRICT = {"err_detect": "crccheck+bitstream+buffer+explode"}
_STRICT_CODECS = ("hevc", "mjpeg", "png")
_REVERSED = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))
_NAMES = ("h264", "hevc", "prores", "dnxhd", "ffv1", "vp9", "av1", "mjpeg", "png", "tiff", "exr", "dpx")


def open_container(
    path: AnyPath, formats: tuple[str, ...] = FORMATS, most_px: int = MOST_PX
) -> av.container.InputContainer:
    """Open a video or audio file, or a file in one of the given formats.

    Decoders raise errors for damaged images or mark them as corrupt, and reject images of more than `most_px` pixels.

    Raises:
        av.FFmpegError: the format is not allowed, or the file refers to other files.
        OSError: the file cannot be read.
    """
    limit = {"max_pixels": str(most_px)}
    options = {"format_whitelist": ",".join(formats), "protocol_whitelist": "file"}
    container = av.open(
        os.fspath(path), metadata_errors="replace", options=options | limit
    )  # `av.open` also decodes a few images
    for stream in container.streams.video:
        if stream.codec_context is not None:  # the context is None for unknown codecs
            strict = _STRICT if stream.codec_context.name in _STRICT_CODECS else {}
            stream.codec_context.options = limit | strict
    return container


def slices_are_whole(packet: bytes) -> bool:
    """Return whether all slices of an FFV1 image have correct checksums; false if slices have no checksums.

    FFmpeg silently replaces damaged slices with those of the previous image. RFC 9043, 4.9: a slice ends with its size
    (3 bytes), a status (1) and a CRC (4; polynomial 0x04C11DB7, highest bit first, initial value 0).
    """
    end = len(packet)
    while end >= 8:
        size = int.from_bytes(packet[end - 8 : end - 5], "big") + 8
        # zlib processes the lowest bit first, and inverts the result.
        if size > end or zlib.crc32(packet[end - size : end].translate(_REVERSED), 0xFFFFFFFF) != 0xFFFFFFFF:
            return False
        end -= size
    return end == 0


def decodable() -> dict[str, bool]:
    """Return whether each common codec can be decoded, by FFmpeg's codec name."""
    return {name: _has(name) for name in _NAMES}


def _has(name: str) -> bool:
    try:
        av.Codec(name, "r")
    except (av.FFmpegError, ValueError):
        return False
    return True


class Sound(NamedTuple):
    """Sound of a media file, as one channel."""

    samples: NDArray[np.float32]  # samples of a single channel, shape (n,)
    rate_hz: int  # sampling rate
    start_s: float  # presentation time of the first sample


def read_sound(path: AnyPath, rate_hz: int) -> Sound | None:
    """Return the first sound track of a file, or None if there is none.

    Raises:
        CaptureError: the file or its sound cannot be decoded.
    """
    parts: list[NDArray[np.float32]] = []
    start_s = 0.0
    check_input(path, CaptureError)
    try:
        with open_container(path) as container:
            if not container.streams.audio:
                return None
            resampler = av.AudioResampler(format="flt", layout="mono", rate=rate_hz)
            for frame in container.decode(container.streams.audio[0]):
                if not parts and frame.pts is not None and frame.time_base is not None:
                    start_s = float(frame.pts * frame.time_base)
                parts += [piece.to_ndarray()[0] for piece in resampler.resample(frame)]
            parts += [piece.to_ndarray()[0] for piece in resampler.resample(None)]
    except (av.FFmpegError, OSError) as error:
        raise CaptureError(
            f"the sound cannot be decoded ({error.strerror}).", path=path, hint="Copy it again from the camera."
        ) from error
    return Sound(np.concatenate(parts), rate_hz, start_s) if parts else None
