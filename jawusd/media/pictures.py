"""Read single pictures, whatever is in the file."""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from jawusd.base.errors import CaptureError
from jawusd.base.inputs import check_input

RawPicture = NDArray[np.uint8] | NDArray[np.uint16]

_PNG = b"\x89PNG\r\n\x1a\n"
#: Most pixels of a picture, four times 8K: a few bytes can declare one that fills the memory.
MOST_PX = 1 << 27


def read_picture(path: Path, flags: int) -> NDArray[np.uint8] | NDArray[np.uint16] | None:
    """Return a picture, or None where the file is none that can be decoded."""
    try:
        check_input(path, CaptureError)
        if _pixels(path) > MOST_PX:
            return None
        image = cv2.imdecode(np.fromfile(path, np.uint8), flags)  # imread crashes over names that are not UTF-8
        if image is None or image.dtype == np.uint8:
            return None if image is None else np.asarray(image, np.uint8)
        return np.asarray(image, np.uint16)
    except (OSError, cv2.error, CaptureError):
        return None


def _pixels(path: Path) -> int:
    """Return how many pixels a file says it has; of formats that say so."""
    with open(path, "rb") as file:
        head = file.read(24)
    if head.startswith(_PNG):  # most are, and there are thousands
        return int.from_bytes(head[16:20]) * int.from_bytes(head[20:24])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                return image.width * image.height
    except Image.DecompressionBombError:
        return MOST_PX + 1
    except Exception:  # what Pillow does not know, OpenCV may: it has a limit of its own
        return 0


def read_gray(path: Path) -> NDArray[np.uint8] | None:
    """Return a picture in 8-bit gray, shape (h, w), or None where the file is none that can be decoded."""
    picture = read_picture(path, cv2.IMREAD_GRAYSCALE)
    return None if picture is None else np.asarray(picture, np.uint8)


def has_palette(path: Path) -> bool:
    """Tell whether a file is a PNG whose pixels are numbers of colours in a palette."""
    with open(path, "rb") as file:
        head = file.read(26)
    return head.startswith(_PNG) and head[25:26] == b"\x03"  # PNG specification, section 11.2.2


def read_palette_numbers(path: Path, picture: RawPicture) -> RawPicture:
    """Return the palette numbers (h, w) of a PNG that has a palette; else the given picture."""
    if not has_palette(path):
        return picture
    with Image.open(path) as image:
        return np.asarray(image, np.uint8) if image.mode == "P" else picture
