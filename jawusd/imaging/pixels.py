"""Decoded pictures as arrays: gray at full range, RGB, RGB with transparency; turned as the file asks."""

from __future__ import annotations

from typing import Literal, TypeAlias

import av
import cv2
import numpy as np
from numpy.typing import NDArray

Colour = Literal["gray", "rgb", "rgba"]
#: Rows and columns of a part of a picture.
Slices: TypeAlias = "tuple[slice[int, int, int], slice[int, int, int]]"

# ITU-R BT.709 / BT.601 video range: 16 is black, 235 is white.
_STRETCH = np.clip(np.round((np.arange(256) - 16.0) * 255 / 219), 0, 255).astype(np.uint8)
_FULL_RANGE = 2  # AVCOL_RANGE_JPEG
_PLANAR_VIDEO_RANGE = ("yuv420p", "yuv422p", "yuv444p", "nv12", "nv21")
_PLANAR_FULL_RANGE = ("gray", "yuvj420p", "yuvj422p", "yuvj444p")


def converted(frame: av.VideoFrame, colour: Colour, rotation_deg: int, window: Slices) -> NDArray[np.uint8]:
    """Return a window (h, w), (h, w, 3) or (h, w, 4) of a decoded picture after its turn."""
    if colour == "gray":
        return _gray(frame, rotation_deg, window)
    pixels = frame.to_ndarray(format="rgb24" if colour == "rgb" else "rgba")
    return np.ascontiguousarray(np.rot90(pixels, rotation_deg // 90)[window])


def _gray(frame: av.VideoFrame, rotation_deg: int, window: Slices) -> NDArray[np.uint8]:
    name = frame.format.name
    full = name in _PLANAR_FULL_RANGE or (name in _PLANAR_VIDEO_RANGE and frame.color_range == _FULL_RANGE)
    if not full and name not in _PLANAR_VIDEO_RANGE:
        frame = frame.reformat(format="gray")
    plane = frame.planes[0]
    stored = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)[: frame.height, : frame.width]
    image = np.rot90(stored, rotation_deg // 90)[window]
    if name in _PLANAR_VIDEO_RANGE and not full:
        return np.asarray(cv2.LUT(np.ascontiguousarray(image), _STRETCH), np.uint8)
    return image
