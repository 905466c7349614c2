"""Convert decoded images to arrays: full-range gray, RGB or RGBA, rotated as the file requires, of any bit depth.

`to_display` converts stored values to the 8-bit display values that the trackers use. Names of colour spaces:

- "display": display-referred values; more than 8 bits are rounded. This is the default for integers.
- "linear": values proportional to light, where 1 is white. They are clipped at 1 and encoded by the sRGB curve
  (IEC 61966-2-1). This is the default for floating point (EXR).
- "cineon": printing density of film scans with 10 bits: 685 is white, 95 is black, 0.002 density per step, gamma 0.6
  (Kodak, "Conversion of 10-bit Log Film Data To 8-bit Linear or Video Data", 1995). The result is treated as "linear".
- Any other name is a colour space of an OpenColorIO config, converted to the config's default display and view.
"""

from __future__ import annotations

import re
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Literal, Protocol, TypeAlias, cast

import av
import av.filter
import cv2
import numpy as np
from av.sidedata.sidedata import SideData
from av.video.reformatter import Interpolation
from numpy.typing import DTypeLike, NDArray

from jawusd.base.errors import CaptureError, explain_missing_packages

Stored = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float16] | NDArray[np.float32]

SPACES = ("display", "linear", "cineon")
_WHITE, _BLACK, _DENSITY, _GAMMA, _STEPS = 685.0, 95.0, 0.002, 0.6, 1023.0


def to_display(stored: Stored, largest: int, space: str | None, config: Path | None) -> NDArray[np.uint8]:
    """Convert an image to a display-referred one, (h, w) or (h, w, 3) uint8, 0 to 255.

    Args:
        stored: pixels as stored in the file: integers 0 to `largest` (white: 255, 1023, 4095 or 65535), or floating
            point.
        space: colour space of the pixels; None for "display" (integers) or "linear" (floating point).
        config: OpenColorIO config that defines other colour spaces.

    Raises:
        CaptureError: the colour space is unknown.
        MissingDependencyError: the colour space needs OpenColorIO, which is not installed.
    """
    fractions = stored.dtype.kind == "f"
    space = space or ("linear" if fractions else "display")
    if space not in SPACES or config is not None:
        values = np.asarray(stored, np.float32)
        return _by_config(values if fractions else values / np.float32(largest), space, config)
    if stored.dtype == np.float32:
        return _curve(np.asarray(stored, np.float32), space)
    # 16-bit types have only 65536 values, so a lookup table is the fastest method.
    codes = stored.view(np.uint16) if stored.dtype == np.float16 else stored
    return _table(stored.dtype.name, largest, space)[codes]


@lru_cache(maxsize=16)
def _table(kind: str, largest: int, space: str) -> NDArray[np.uint8]:
    if kind == "float16":
        return _curve(np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32), space)
    top = 1 << (8 if kind == "uint8" else 16)
    return _curve(np.minimum(np.arange(top, dtype=np.float32) / np.float32(largest), np.float32(1)), space)


def _curve(values: NDArray[np.float32], space: str) -> NDArray[np.uint8]:
    """Convert values, where 1 is white, to 8 bits; NaN becomes black."""
    with np.errstate(over="ignore", invalid="ignore"):
        light = np.nan_to_num(values.astype(np.float64), nan=0.0, posinf=1.0, neginf=0.0)
        if space == "cineon":
            black = 10 ** ((_BLACK - _WHITE) * _DENSITY / _GAMMA)
            density = (np.minimum(light, 1.0) * _STEPS - _WHITE) * _DENSITY / _GAMMA
            light = (10**density - black) / (1 - black)
        light = np.clip(light, 0.0, 1.0)
        if space != "display":
            light = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * light), np.uint8)


class _Processor(Protocol):
    """Part of OpenColorIO's interface, declared for type checkers because its package has no stubs."""

    def applyRGB(self, pixels: NDArray[np.float32]) -> None: ...


@explain_missing_packages("colour")
def _by_config(values: NDArray[np.float32], space: str, config: Path | None) -> NDArray[np.uint8]:
    if config is None:
        raise CaptureError(
            f'the colour space "{space}" is unknown; expected {", ".join(SPACES)}, or a name in an OpenColorIO config.',
            hint='Set the config at the top of capture.toml: colour_config = "config.ocio".',
        )
    shown = np.ascontiguousarray(np.broadcast_to(values[..., None], (*values.shape, 3)) if values.ndim == 2 else values)
    shown = shown.astype(np.float32)
    _processor(config, space).applyRGB(shown)
    image = np.asarray(np.rint(255 * np.clip(np.nan_to_num(shown), 0, 1)), np.uint8)
    return image[..., 1] if values.ndim == 2 else image


@lru_cache(maxsize=16)
def _processor(config: Path, space: str) -> _Processor:
    import PyOpenColorIO as ocio

    try:
        known = ocio.Config.CreateFromFile(str(config))
        display = known.getDefaultDisplay()
        transform = ocio.DisplayViewTransform(space, display, known.getDefaultView(display))
        processor: _Processor = known.getProcessor(transform).getDefaultCPUProcessor()
        return processor
    except ocio.Exception as error:
        raise CaptureError(f'OpenColorIO cannot convert the colour space "{space}" ({error}).', path=config) from error


Colour = Literal["gray", "rgb", "rgba"]
#: Row slice and column slice of an image region.
Slices: TypeAlias = "tuple[slice[int, int, int], slice[int, int, int]]"

_BYTE_BITS = 8
# Flags of FFmpeg's conversion to RGB that enable rounding and chroma interpolation; without rounding, images are 1.3 of
# 255 levels too dark.
TO_RGB = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
_AROUND_PX = 8  # margin around a converted region, for chroma interpolation
_STEP_PX = 32  # start and end of a converted region are multiples of this
_ANY_TIME = Fraction(1, 1000)  # time base that FFmpeg's filters need; the value does not matter
_FULL_RANGE = 2  # FFmpeg's AVCOL_RANGE_JPEG, the full range
_PLANAR_VIDEO_RANGE = ("yuv420p", "yuv422p", "yuv444p", "nv12", "nv21")
_PLANAR_FULL_RANGE = ("gray", "yuvj420p", "yuvj422p", "yuvj444p")
# Little-endian planar formats of more than 8 bits; p010 and similar formats store values in the highest bits.
_DEEP = re.compile(r"(yuva?4\d\dp|p0)(10|12|14|16)le")


# Counter-clockwise rotations as in display matrices, whose rows map x and y.
_QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


def turn_deg(frame: av.VideoFrame) -> int:
    """Return the counter-clockwise rotation stored in a file: 0, 90, 180 or 270.

    Raises:
        CaptureError: the display matrix mirrors the image, or does not rotate it by a multiple of 90 degrees.
    """
    try:
        stored = frame.side_data.get("DISPLAYMATRIX")
    except ValueError:  # PyAV fails on unknown side data, such as Exif; the rotation is still available
        return frame.rotation % 360
    if stored is None:
        return 0
    rows = np.frombuffer(bytes(cast(SideData, stored)), np.int32, 9).reshape(3, 3)[:2, :2].astype(float)
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    if not lengths.all():
        return 0  # a zero matrix stands for no rotation
    rows /= lengths  # remove the scale, as players do
    for quarters in range(4):
        if np.allclose(rows, np.linalg.matrix_power(_QUARTER_TURN, quarters), atol=1e-3):
            return 90 * quarters
    if np.linalg.det(rows) < 0:
        raise CaptureError(
            "the display matrix in the file mirrors the image, which is not supported.",
            hint="Switch mirroring off in the camera. If the stored image is not mirrored, remove the flag: "
            "ffmpeg -display_rotation 0 -i IN -c copy OUT.",
        )
    raise CaptureError(
        f"the display matrix in the file rotates by {frame.rotation} degrees or skews; "
        "only rotations by multiples of 90 degrees are supported.",
        hint="Re-encode the file, for example: ffmpeg -i IN -c:v libx264 -crf 12 OUT.mp4.",
    )


@lru_cache(maxsize=16)
def _deep_table(bits: int, high: bool, full: bool) -> NDArray[np.uint8]:
    """Return the gray value of each 16-bit luma value, (65536,) uint8; BT.709 video range is 16 to 235 in 8 bits."""
    luma = np.arange(1 << 16) / (1 << (16 - bits) if high else 1)
    low, span = (0.0, (1 << bits) - 1.0) if full else (16.0 * (1 << (bits - 8)), 219.0 * (1 << (bits - 8)))
    return np.asarray(np.clip(np.rint((luma - low) * 255 / span), 0, 255), np.uint8)


class DecodedPicture:
    """Decoded image (height, width, 3), accessed like an array; only accessed regions are converted to RGB."""

    def __init__(self, frame: av.VideoFrame, rotation_deg: int) -> None:
        self._frame, self._rotation_deg = frame, rotation_deg
        turned = rotation_deg in (90, 270)
        self.shape = (frame.width, frame.height, 3) if turned else (frame.height, frame.width, 3)

    def __getitem__(self, window: Slices) -> NDArray[np.uint8]:
        """Return the RGB pixels of a range of rows and columns, (h, w, 3)."""
        return converted(self._frame, "rgb", self._rotation_deg, window)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[np.uint8]:
        """Return the whole image as RGB."""
        whole = (slice(0, self.shape[0], 1), slice(0, self.shape[1], 1))
        return np.asarray(self[whole], dtype)


#: RGB image (h, w, 3) uint8: an array, or a decoded image that is converted on access.
ColourPicture: TypeAlias = "NDArray[np.uint8] | DecodedPicture"


def converted(frame: av.VideoFrame, colour: Colour, rotation_deg: int, window: Slices) -> NDArray[np.uint8]:
    """Return a window of a decoded image after rotation, (h, w, 3) or (h, w, 4); the whole image (h, w) if gray."""
    if colour == "gray":
        return _gray(frame, rotation_deg)
    part, inside = _around(frame, _stored_window(frame, rotation_deg, window))
    pixels: NDArray[np.uint8]
    if colour == "rgb" and max(one.bits for one in frame.format.components) > _BYTE_BITS:
        # FFmpeg's conversion from 10 to 8 bits is wrong by up to two levels; rounding from 16 bits is exact.
        pixels = to_display(*deep_rgb(part), None, None)
    elif colour == "rgb" and not part.format.is_rgb:
        # FFmpeg writes planar RGB twice as fast as packed RGB, with the same values.
        green, blue, red = (_plane(p) for p in part.reformat(format="gbrp", interpolation=TO_RGB).planes)
        pixels = np.asarray(cv2.merge([red, green, blue]), np.uint8)
    else:
        shape = "rgb24" if colour == "rgb" else "rgba"
        pixels = np.asarray(part.to_ndarray(format=shape, interpolation=TO_RGB), np.uint8)
    return np.ascontiguousarray(np.rot90(pixels[inside], rotation_deg // 90))


def _plane(plane: av.video.plane.VideoPlane) -> NDArray[np.uint8]:
    """Return an image plane as an array of bytes (h, w), without a copy."""
    return np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)[: plane.height, : plane.width]


def _stored_window(frame: av.VideoFrame, rotation_deg: int, window: Slices) -> Slices:
    """Return the rows and columns of a stored image that the rotation maps to a window."""
    turns = rotation_deg // 90
    height, width = (frame.width, frame.height) if turns % 2 else (frame.height, frame.width)
    rows, columns = (slice(*part.indices(side)[:2]) for part, side in zip(window, (height, width), strict=True))
    for _ in range(turns):
        rows, columns = columns, slice(height - rows.stop, height - rows.start)
        height, width = width, height
    return rows, columns


def _widened(part: slice[int, int, int], limit: int) -> tuple[int, int]:
    """Return a pixel range along one side of an image, widened by a margin and aligned for fast conversion."""
    start = max(0, part.start - _AROUND_PX) // _STEP_PX * _STEP_PX
    return start, min(limit, start + -(-(part.stop + _AROUND_PX - start) // _STEP_PX) * _STEP_PX)


def _around(frame: av.VideoFrame, window: Slices) -> tuple[av.VideoFrame, Slices]:
    """Return an image or its crop around a window with a margin, whichever is faster, and the window in it."""
    rows, columns = window
    (top, bottom), (left, right) = (_widened(*sides) for sides in zip(window, (frame.height, frame.width)))
    height, width = bottom - top, right - left
    if height * width > 0.5 * frame.height * frame.width:
        return frame, window
    # FFmpeg's crop filter preserves colour metadata and chroma location.
    graph = av.filter.Graph()
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=_ANY_TIME)
    crop = graph.add("crop", f"{width}:{height}:{left}:{top}:exact=1")
    sink = graph.add("buffersink")
    source.link_to(crop)
    crop.link_to(sink)
    graph.configure()
    graph.vpush(frame)
    inside = slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)
    return graph.vpull(), inside


def deep_rgb(frame: av.VideoFrame) -> tuple[NDArray[np.uint16], int]:
    """Return a decoded image as unrotated 16-bit RGB (h, w, 3), and the value of white."""
    stored = np.asarray(frame.to_ndarray(format="rgb48le", interpolation=TO_RGB), np.uint16)
    if frame.format.is_rgb:
        return stored, 65535
    bits = max(part.bits for part in frame.format.components)
    full = frame.color_range == _FULL_RANGE or len(frame.format.components) == 1
    # FFmpeg shifts values to 16 bits, so the low bits of white are 0.
    return stored, ((1 << bits) - 1) << (16 - bits) if full else 255 << 8


def _gray(frame: av.VideoFrame, rotation_deg: int) -> NDArray[np.uint8]:
    name = frame.format.name
    deep = _DEEP.fullmatch(name)
    if deep is not None:
        # FFmpeg's conversion to gray mixes in chroma, which causes errors of up to 11 of 255 levels.
        plane = frame.planes[0]
        stored = np.frombuffer(memoryview(plane), "<u2").reshape(-1, plane.line_size // 2)
        luma = np.rot90(stored[: frame.height, : frame.width], rotation_deg // 90)
        return _deep_table(int(deep[2]), deep[1] == "p0", frame.color_range == _FULL_RANGE)[luma]
    full = name in _PLANAR_FULL_RANGE or (name in _PLANAR_VIDEO_RANGE and frame.color_range == _FULL_RANGE)
    if not full and name not in _PLANAR_VIDEO_RANGE:
        frame = frame.reformat(format="gray")
    image = np.rot90(_plane(frame.planes[0]), rotation_deg // 90)
    if name in _PLANAR_VIDEO_RANGE and not full:
        return np.asarray(cv2.LUT(np.ascontiguousarray(image), _deep_table(8, False, False)[:256]), np.uint8)
    return image


def coloured(shown: NDArray[np.uint8], colour: Colour) -> NDArray[np.uint8]:
    """Convert an image (h, w) or (h, w, 3) RGB to the requested format; alpha is opaque."""
    if colour == "gray":
        gray = shown if shown.ndim == 2 else cv2.cvtColor(shown, cv2.COLOR_RGB2GRAY)
        return np.ascontiguousarray(gray, np.uint8)
    rgb = np.repeat(shown[..., None], 3, axis=2) if shown.ndim == 2 else shown
    if colour == "rgb":
        return np.ascontiguousarray(rgb)
    return np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
