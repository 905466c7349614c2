"""Open files of pictures and sound: one that is what it holds, and names no others."""

from __future__ import annotations

import os

import av

from jawusd.imaging.pictures import MOST_PX

#: Formats of one file. FFmpeg also follows playlists (HLS, DASH, concat, SDP), which name other files and addresses.
FORMATS = (
    "mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm", "avi", "mpegts", "mpeg", "mpegvideo", "mxf", "flv", "ogg", "asf", "nut",
    "ivf", "dv", "h264", "hevc", "av1", "obu", "m4v", "mjpeg", "yuv4mpegpipe", "gif", "apng", "rm", "gxf", "wtv", "y4m",
    "wav", "w64", "aiff", "au", "caf", "flac", "mp3", "aac", "ac3", "mp2",
)  # fmt: skip


#: Formats of single pictures.
PICTURES = (
    "image2", "png_pipe", "exr_pipe", "dpx_pipe", "tiff_pipe", "bmp_pipe", "jpeg_pipe", "j2k_pipe", "webp_pipe",
    "pam_pipe", "pgm_pipe", "ppm_pipe", "sgi_pipe", "cin_pipe", "hdr_pipe",
)  # fmt: skip


def open_container(
    path: str | os.PathLike[str], formats: tuple[str, ...] = FORMATS, most_px: int = MOST_PX
) -> av.container.InputContainer:
    """Open a video or sound file, or one of other formats. Decoders refuse pictures of more than so many pixels.

    Raises:
        av.FFmpegError: it is none, or one that names other files.
        OSError: it cannot be read.
    """
    limit = {"max_pixels": str(most_px)}
    options = {"format_whitelist": ",".join(formats), "protocol_whitelist": "file"}
    container = av.open(os.fspath(path), metadata_errors="replace", options=options | limit)  # it decodes some, too
    for stream in container.streams.video:
        if stream.codec_context is not None:  # of codecs that are not known
            stream.codec_context.options = limit
    return container
