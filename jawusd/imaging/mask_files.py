"""Masks written by other programs: numbered PNG files and videos, and which pixels count as tooth."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.errors import CaptureError
from jawusd.imaging.pictures import read_picture
from jawusd.imaging.pixels import Colour
from jawusd.imaging.video import Video

MaskImage = NDArray[np.uint8]
RawImage = NDArray[np.uint8] | NDArray[np.uint16]  # as files store it
#: Gray values of the wanted arch and of the other one in label images; all else must be 0.
LabelValues = tuple[int, int]

_NUMBER = re.compile(r"%(0(\d+))?d")
_HEADER_BYTES, _COLOUR_TYPE, _WITH_ALPHA = 26, 25, (4, 6)  # PNG specification, section 11.2.2
# Soft edges are gray, and so is most of a photograph: with more than this share of pixels between a tenth and nine
# tenths of the brightest the picture is no mask.
_MOST_GRAY = 0.1
_FEW = 6  # label values listed in an error


class PngMasks:
    """Masks as numbered PNG files.

    Attributes:
        count: one past the highest number.
    """

    def __init__(self, pattern: Path, size_px: tuple[int, int] | None, labels: LabelValues | None = None) -> None:
        """Find the files of a pattern with one %d or %06d, all of one (width, height) unless `size_px` is None.

        Raises:
            CaptureError: the folder is missing or holds no such file, or all are opaque pictures.
        """
        self._pattern, self._size_px, self._labels = pattern, size_px, labels
        number = _NUMBER.search(pattern.name)
        if number is None or pattern.name.count("%") != 1:
            raise CaptureError(
                "the mask pattern needs one number such as %06d.", path=pattern, hint="Correct it in capture.toml."
            )
        if not pattern.parent.is_dir():
            raise CaptureError(
                f"there is no folder {pattern.parent}.", path=pattern, hint="Correct it in capture.toml."
            )
        digits = rf"\d{{{number[2]},}}" if number[2] else r"\d+"
        before, after = (re.escape(part) for part in (pattern.name[: number.start()], pattern.name[number.end() :]))
        name = re.compile(f"{before}({digits}){after}")
        found = (name.fullmatch(entry.name) for entry in os.scandir(pattern.parent))
        self._files = {int(match[1]): pattern.parent / match[0] for match in found if match}
        if not self._files:
            raise CaptureError(
                "no file of the folder has such a name.", path=pattern, hint="Correct `masks` in capture.toml."
            )
        self.count = max(self._files) + 1
        if labels is None and _png_has_alpha(self._files[min(self._files)]):
            _refuse_opaque((self._load(self._files[k]) for k in sorted(self._files)), pattern)

    def masks(self, first: int) -> Iterator[MaskImage | None]:
        """Yield the masks from a number on, (h, w) uint8, None where there is no file or nothing segmented.

        Raises:
            CaptureError: a file cannot be decoded, has another size or is no mask.
        """
        for number in range(first, self.count):
            path = self._files.get(number)
            yield None if path is None else _mask(self._load(path), self._labels, path, "")

    def first_size_px(self) -> tuple[int, int]:
        """Return the (width, height) of the first file."""
        height, width = self._load(self._files[min(self._files)]).shape[:2]
        return width, height

    def _load(self, path: Path) -> RawImage:
        image = read_picture(path, cv2.IMREAD_UNCHANGED)
        if image is None:
            raise CaptureError(
                "the mask cannot be decoded.", path=path, hint="Export it again, or delete it: that frame is skipped."
            )
        if self._size_px is not None:
            _check_size(path, image.shape[1::-1], self._size_px)
        return image


class VideoMasks:
    """Masks as the pictures of a video: black and white, or as its transparency.

    Attributes:
        count: number of pictures.
        timeline: which picture is shown at which frame.
    """

    def __init__(self, path: Path, size_px: tuple[int, int], labels: LabelValues | None = None) -> None:
        """Open the video; see `PngMasks` for the arguments.

        Raises:
            CaptureError: the video is missing or damaged, has another size, or all of its pictures are opaque.
        """
        self._video, self._labels = Video(path), labels
        _check_size(path, self._video.size_px, size_px)
        self.count, self.timeline = self._video.count, self._video.timeline
        self._colour: Colour
        if labels is not None:  # luma, unless there is none: conversions would change values
            self._colour = "rgb" if self._video.is_rgb else "gray"
        else:
            self._colour = "gray" if self._video.is_gray else "rgba" if self._video.has_alpha else "rgb"
        if self._colour == "rgba":
            _refuse_opaque_video(path, path.stat().st_mtime_ns)

    def masks(self, first: int) -> Iterator[MaskImage | None]:
        """Yield the masks from a picture on, (h, w) uint8, None where nothing is segmented.

        Raises:
            CaptureError: a picture cannot be decoded or is no mask.
        """
        for frame in self._video.frames(first, colour=self._colour, threads=1):
            yield _mask(frame.image, self._labels, self._video.path, f"picture {frame.index}: ")


def _check_size(path: Path, found: tuple[int, int], allowed: tuple[int, int]) -> None:
    if tuple(found) != tuple(allowed):
        raise CaptureError(
            f"the mask is {found[0]} x {found[1]} px, the camera's pictures are {allowed[0]} x {allowed[1]} px.",
            path=path,
            hint="Export the masks at the size of the video.",
        )


def _png_has_alpha(path: Path) -> bool:
    with open(path, "rb") as handle:
        header = handle.read(_HEADER_BYTES)
    return len(header) == _HEADER_BYTES and header[_COLOUR_TYPE] in _WITH_ALPHA


def _refuse_opaque(images: Iterator[RawImage], path: Path) -> None:
    """Raise if every picture with an alpha channel is an opaque photograph; usually the first one is not."""
    count = 0
    for image in images:
        if not _is_opaque_photograph(image):
            return
        count += 1
    raise CaptureError(
        f"the alpha channel is opaque in all {count} pictures: nothing is cut out.",
        path=path,
        hint="Export the matte itself, in black and white, or colour with its alpha (in After Effects: RGB + Alpha).",
    )


@lru_cache(maxsize=256)
def _refuse_opaque_video(path: Path, changed_ns: int) -> None:
    """Raise as `_refuse_opaque`, reading a video once; the time of its last change identifies its version."""
    _refuse_opaque((frame.image for frame in Video(path).frames(colour="rgba", threads=1)), path)


def _is_opaque_photograph(image: RawImage) -> bool:
    """Return whether alpha is opaque everywhere and the colours are no black-and-white mask either."""
    if image.ndim != 3 or image.shape[2] != 4:
        return False
    small = _eight_bits(image)
    return bool(small[..., 3].min() == 255) and _gray_share(small[..., :3].max(axis=2)) > _MOST_GRAY


def _mask(image: RawImage, labels: LabelValues | None, path: Path, where: str) -> MaskImage | None:
    if labels is not None:
        return _labelled(image, labels, path, where)
    if _is_opaque_photograph(image):
        return None  # as programs write frames that were not segmented
    return _coverage(_eight_bits(image), path, where)


def _coverage(image: MaskImage, path: Path, where: str) -> MaskImage:
    """Return 8-bit coverage: alpha where it is used, else the brightest colour; 0/1 becomes 0/255."""
    if image.ndim == 3:
        has_alpha = image.shape[2] == 4 and image[..., 3].min() < 255
        image = np.ascontiguousarray(image[..., 3]) if has_alpha else image[..., :3].max(axis=2)
    if (share := _gray_share(image)) > _MOST_GRAY:
        raise CaptureError(
            f"{where}{share:.0%} of it are gray, which is no mask: white is tooth and black is not.",
            path=path,
            hint="Check that `masks` in capture.toml names the masks and not the footage.",
        )
    return np.multiply(image, 255, dtype=np.uint8) if image.max() == 1 else image


def _labelled(image: RawImage, labels: LabelValues, path: Path, where: str) -> MaskImage:
    """Return 255 where a label image shows the wanted arch; refuse other values."""
    plane = image if image.ndim == 2 else image[..., 0]
    if image.ndim == 3 and not all((image[..., c] == plane).all() for c in (1, 2)):
        raise CaptureError(
            f"{where}the label image is coloured; one gray value per row of teeth is needed.",
            path=path,
            hint="Export the labels as gray values (an index image without palette).",
        )
    found = np.flatnonzero(np.bincount(plane.ravel()))
    if not np.isin(found, (0, *labels)).all():
        shown = ", ".join(map(str, found[:_FEW])) + (f" and {len(found) - _FEW} more" if len(found) > _FEW else "")
        low, high = sorted(labels)
        raise CaptureError(
            f"{where}the label image has the values {shown}; 0, {low} and {high} are allowed.",
            path=path,
            hint="Correct masks.upper_value and masks.lower_value, or export without other labels, smooth edges and "
            "lossy compression.",
        )
    return np.where(plane == labels[0], np.uint8(255), np.uint8(0))


def _eight_bits(image: RawImage) -> MaskImage:
    return np.asarray(image >> 8 if image.dtype == np.uint16 else image, np.uint8)


def _gray_share(image: MaskImage) -> float:
    white = int(image.max())
    return cv2.countNonZero(cv2.inRange(image, white // 10 + 1, white - white // 10 - 1)) / image.size
