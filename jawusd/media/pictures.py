"""Read single image files of any bit depth (PNG, TIFF, EXR, DPX, JPEG) and their headers.

References for headers: OpenEXR, "Reading and Writing Image Files",
https://openexr.com/en/latest/OpenEXRFileLayout.html; DPX, SMPTE ST 268-1.
"""

from __future__ import annotations

import struct
import warnings
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from jawusd.base.errors import CaptureError
from jawusd.base.inputs import check_input
from jawusd.media.containers import MOST_PX, PICTURES, open_container
from jawusd.media.pixels import TO_RGB, Stored

RawPicture = NDArray[np.uint8] | NDArray[np.uint16]

_PNG = b"\x89PNG\r\n\x1a\n"
_HINT = "Export the images again, as PNG, TIFF, EXR, DPX or JPEG."
_MOST_HEADER_BYTES = 1 << 16
#: Maximum number of pixels of an image, 8K: decoding takes up to 28 bytes per pixel that a small file declares.
MOST_STORED_PX = 36_000_000
_EXR, _DPX = b"\x76\x2f\x31\x01", (b"SDPX", b"XPDS")
_QUARTERS, _MIRRORED = {3: 2, 6: 3, 8: 1}, (2, 4, 5, 7)  # quarter turns by Exif orientation, and mirrored orientations
_DPX_LOG = (1, 3)  # DPX codes for "printing density" and "logarithmic" (SMPTE ST 268-1, table 5A)


def read_picture(path: Path, flags: int) -> NDArray[np.uint8] | NDArray[np.uint16] | None:
    """Return an image, or None if the file cannot be decoded."""
    try:
        check_input(path, CaptureError)
        if _pixels(path) > MOST_PX:
            return None
        image = cv2.imdecode(np.fromfile(path, np.uint8), flags)  # OpenCV's imread crashes on names that are not UTF-8
        if image is None or image.dtype == np.uint8:
            return None if image is None else np.asarray(image, np.uint8)
        return np.asarray(image, np.uint16)
    except (OSError, cv2.error, CaptureError):
        return None


def _pixels(path: Path) -> int:
    """Return the number of pixels stated in a file's header, 0 if unknown."""
    with open(path, "rb") as file:
        head = file.read(24)
    if head.startswith(_PNG):  # PNG headers are parsed here because that is faster
        return int.from_bytes(head[16:20]) * int.from_bytes(head[20:24])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                return image.width * image.height
    except Image.DecompressionBombError:
        return MOST_PX + 1
    except Exception:  # Pillow does not support the format; OpenCV enforces a limit of its own
        return 0


def read_gray(path: Path) -> NDArray[np.uint8] | None:
    """Return an image in 8-bit gray, shape (h, w), or None if the file cannot be decoded."""
    picture = read_picture(path, cv2.IMREAD_GRAYSCALE)
    return None if picture is None else np.asarray(picture, np.uint8)


def has_palette(path: Path) -> bool:
    """Return whether a file is a PNG with a palette."""
    with open(path, "rb") as file:
        head = file.read(26)
    return head.startswith(_PNG) and head[25:26] == b"\x03"  # colour type 3 in section 11.2.2 of the PNG specification


def read_palette_numbers(path: Path, picture: RawPicture) -> RawPicture:
    """Return the palette indices (h, w) of a PNG with a palette; otherwise the given image."""
    if not has_palette(path):
        return picture
    with Image.open(path) as image:
        return np.asarray(image, np.uint8) if image.mode == "P" else picture


@dataclass(frozen=True)
class PictureHeader:
    """Metadata of an image file; "" or None if missing."""

    timecode: str = ""
    fps: float | None = None
    pixel_aspect: float = 1.0
    colour_space: str | None = None


def read_stored(path: Path) -> tuple[Stored, int]:
    """Return the pixels of an image file as stored, (h, w) or (h, w, 3) RGB, and the integer value of white.

    Raises:
        CaptureError: the file is missing, damaged, or not an image.
    """
    check_input(path, CaptureError)
    try:
        with open_container(path, PICTURES, MOST_STORED_PX) as container:
            frame = next(container.decode(video=0))
            pixels, white = _stored_pixels(frame)
            return np.rot90(pixels, _quarters(path)), white
    except MemoryError as error:
        raise CaptureError("there is not enough memory for the image.", path=path, hint=_HINT) from error
    except (av.FFmpegError, OSError, StopIteration, IndexError, ValueError) as error:
        what = f"the image cannot be read: it is damaged or has more than {MOST_STORED_PX} px ({error!s:.100})."
        raise CaptureError(what, path=path, hint=_HINT) from error


def _quarters(path: Path) -> int:
    """Return the counter-clockwise quarter turns in the Exif orientation of an image.

    Raises:
        CaptureError: the orientation is mirrored.
    """
    try:
        with Image.open(path) as image:
            orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
    except Exception:  # formats that Pillow does not support (EXR, DPX) have no Exif data
        return 0
    if orientation in _MIRRORED:
        raise CaptureError("the orientation in the file is mirrored, which is not supported.", path=path, hint=_HINT)
    return _QUARTERS.get(orientation, 0)


def _stored_pixels(frame: av.VideoFrame) -> tuple[Stored, int]:
    name, bits = frame.format.name, max(part.bits for part in frame.format.components)
    if "f16" in name or "f32" in name:
        return _fractions(frame), 1
    if bits <= 8:
        return frame.to_ndarray(format="gray" if name == "gray" else "rgb24", interpolation=TO_RGB), 255
    if name.startswith("gray"):
        wide = frame if bits == 16 else frame.reformat(format=f"gray{bits}le")
        return np.asarray(wide.to_ndarray(), np.uint16), (1 << bits) - 1
    if frame.format.is_rgb:
        return frame.to_ndarray(format="rgb48le"), 65535
    return frame.to_ndarray(format="rgb24", interpolation=TO_RGB), 255


def _fractions(frame: av.VideoFrame) -> NDArray[np.float16] | NDArray[np.float32]:
    """Return floating-point planes as stored, in the order red, green, blue."""
    kind = np.dtype(np.float16 if "f16" in frame.format.name else np.float32)
    kind = kind.newbyteorder(">" if frame.format.name.endswith("be") else "<")
    count = len(frame.planes)
    pixels = np.empty((frame.height, frame.width, min(count, 3)), kind.newbyteorder("="))
    order = (0,) if count == 1 else (1, 2, 0)  # FFmpeg's order of planes is green, blue, red
    for plane, channel in zip(frame.planes, order):  # ignore a fourth plane, which is alpha
        rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
        pixels[..., channel] = np.ascontiguousarray(rows[: frame.height, : frame.width * kind.itemsize]).view(kind)
    return pixels[..., 0] if count == 1 else pixels


def read_header(path: Path) -> PictureHeader:
    """Return the metadata of an EXR or DPX file; empty for other formats.

    Raises:
        CaptureError: the file cannot be read.
    """
    check_input(path, CaptureError)
    try:
        with open(path, "rb") as file:
            head = file.read(_MOST_HEADER_BYTES)
    except OSError as error:
        raise CaptureError(f"cannot be read: {error.strerror}.", path=path) from error
    try:
        if head[:4] == _EXR:
            return _exr(head)
        if head[:4] in _DPX:
            return _dpx(head)
    except (struct.error, IndexError, ValueError):
        pass  # the decoder reports damaged headers
    return PictureHeader()


def _exr(head: bytes) -> PictureHeader:
    found: dict[bytes, bytes] = {}
    at = 8
    while head[at] != 0:
        name, kind, rest = head[at:].split(b"\0", 2)
        at += len(name) + len(kind) + 2
        (size,) = struct.unpack_from("<i", head, at)
        found[name] = head[at + 4 : at + 4 + size]
        at += 4 + size
    fps = struct.unpack("<iI", found[b"framesPerSecond"]) if b"framesPerSecond" in found else (0, 0)
    code = struct.unpack_from("<I", found[b"timeCode"])[0] if b"timeCode" in found else None
    aspect = struct.unpack("<f", found[b"pixelAspectRatio"])[0] if b"pixelAspectRatio" in found else 1.0
    return PictureHeader(
        "" if code is None else _timecode(code), fps[0] / fps[1] if fps[1] else None, _aspect(float(aspect))
    )


def _dpx(head: bytes) -> PictureHeader:
    order = ">" if head[:4] == b"SDPX" else "<"
    aspect = struct.unpack_from(f"{order}2I", head, 1628)
    (code,) = struct.unpack_from(f"{order}I", head, 1920)
    (fps,) = struct.unpack_from(f"{order}f", head, 1940)
    unknown = 0xFFFFFFFF
    known_aspect = unknown not in aspect and 0 not in aspect
    return PictureHeader(
        "" if code in (unknown, 0) else _timecode(code, bits_of_drop=False),
        float(fps) if np.isfinite(fps) and 0 < fps < 1e4 else None,
        _aspect(aspect[0] / aspect[1]) if known_aspect else 1.0,
        "cineon" if head[801] in _DPX_LOG else None,
    )


def _timecode(code: int, bits_of_drop: bool = True) -> str:
    """Return the SMPTE ST 12-1 time code of a BCD number: hours, minutes, seconds, frames, highest byte first."""
    tens = (0x3, 0x7, 0x7, 0x3)
    parts = [(code >> shift) & 0xFF for shift in (24, 16, 8, 0)]
    hours, minutes, seconds, frame = (10 * (part >> 4 & mask) + (part & 0xF) for part, mask in zip(parts, tens))
    sign = ";" if bits_of_drop and code & 0x40 else ":"
    return f"{hours:02}:{minutes:02}:{seconds:02}{sign}{frame:02}"


def _aspect(value: float) -> float:
    return value if 0.1 < value < 10 else 1.0
