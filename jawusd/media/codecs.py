"""Which codecs can be decoded here."""

from __future__ import annotations

import av

_NAMES = ("h264", "hevc", "prores", "dnxhd", "ffv1", "vp9", "av1", "mjpeg", "png", "tiff", "exr", "dpx")


def decodable() -> dict[str, bool]:
    """Return whether each codec that footage comes in can be decoded, by ffmpeg's name."""
    return {name: _has(name) for name in _NAMES}


def _has(name: str) -> bool:
    try:
        av.Codec(name, "r")
    except (av.FFmpegError, ValueError):
        return False
    return True
