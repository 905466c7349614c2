"""Find out from a few pictures which calibration board a clip shows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_WIDTH_PX = 960  # large enough for boards that fill a fifth of the picture
_FEWEST_PICTURES = 2  # that must agree
_FEWEST_MARKERS = 4
_FAMILIES = ("4X4", "5X5", "6X6", "7X7")
_SIZES = (50, 100, 250, 1000)  # OpenCV's smaller dictionaries are the beginnings of the larger ones


@dataclass(frozen=True)
class BoardSeen:
    """Hold what board clips show: inner corners of a chessboard, or the dictionary of markers."""

    pattern: str
    cols: int | None = None
    rows: int | None = None
    dictionary: str | None = None


def seen_board(pictures: Iterable[NDArray[np.uint8]]) -> BoardSeen | None:
    """Return the board in most of some gray pictures (h, w); None if none is in two of them."""
    boards: Counter[tuple[int, int]] = Counter()
    markers: Counter[str] = Counter()
    highest: dict[str, int] = {}
    for picture in pictures:
        small = _shrunk(picture)
        for family, largest in _markers(small):
            markers[family] += 1
            highest[family] = max(largest, highest.get(family, 0))
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
        ok, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags=flags)
        if ok:
            boards[max(meta.shape), min(meta.shape)] += 1
    family, times = markers.most_common(1)[0] if markers else ("", 0)
    if times >= _FEWEST_PICTURES:
        size = next(size for size in _SIZES if size > highest[family])
        return BoardSeen("charuco", dictionary=f"DICT_{family}_{size}")
    (cols, rows), times = boards.most_common(1)[0] if boards else ((0, 0), 0)
    return BoardSeen("chessboard", cols, rows) if times >= _FEWEST_PICTURES else None


def _shrunk(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = picture.shape
    if width <= _WIDTH_PX:
        return np.ascontiguousarray(picture)
    size = (_WIDTH_PX, round(height * _WIDTH_PX / width))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def _markers(picture: NDArray[np.uint8]) -> Iterable[tuple[str, int]]:
    """Yield each family of markers seen, with the highest number."""
    for family in _FAMILIES:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}_{_SIZES[-1]}"))
        numbers = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)[1]
        if numbers is not None and len(numbers) >= _FEWEST_MARKERS:
            yield family, int(numbers.max())
