"""Find the meaning of pixel values in mask files and mask videos; results are cached for each version of a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial, wraps
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from jawusd.base.errors import CaptureError
from jawusd.media.mask_levels import MaskLevels, NotMasks, RawImage, find_levels, spread_of_colours
from jawusd.media.pictures import has_palette, read_palette_numbers, read_picture
from jawusd.media.pixels import Colour
from jawusd.media.video import Video

_T = TypeVar("_T")
_SAMPLED = 10  # number of images sampled from a take
_FEWEST_OF_VIDEO = 4
_NEUTRAL = 12  # maximum difference [of 255] between the channels of a gray image after lossy coding


@dataclass(frozen=True)
class SourceLevels:
    """Meaning of the pixel values of one mask source.

    `palette_numbers` is true if palette indices are used because all palette colours are equal. `sizes_px` has one of
    the sampled files for each size (width, height).
    """

    levels: MaskLevels | None
    palette_numbers: bool = False
    sizes_px: tuple[tuple[Path, tuple[int, int]], ...] = ()


def png_levels(files: Sequence[Path], is_other: Callable[[RawImage], bool] | None = None) -> SourceLevels:
    """Find the levels of numbered files from samples; `is_other` detects images that are not masks.

    Raises:
        CaptureError: the images are not masks.
    """
    chosen = _spread(len(files), _SAMPLED)
    sample = [files[k] for k in chosen]
    versions = tuple((stat.st_mtime_ns, stat.st_size) for stat in (path.stat() for path in sample))
    others = _Others([path for k, path in enumerate(files) if k not in chosen])
    try:
        return _png_levels_of_version(tuple(sample), versions, others, is_other)
    finally:
        others.files = []  # the cache keeps this object; free its list of up to tens of thousands of files


def _by_version(read: Callable[[Path], _T]) -> Callable[[Path], _T]:
    """Return a cached function of a file; its modification time and size identify the version of the file."""

    @lru_cache(maxsize=64)
    def of_version(path: Path, version: tuple[int, int] | None) -> _T:
        return read(path)

    @wraps(read)
    def current(path: Path) -> _T:
        found = path.stat() if path.is_file() else None  # the reader reports a missing file
        return of_version(path, found and (found.st_mtime_ns, found.st_size))

    return current


@_by_version
def mask_video(path: Path) -> Video:
    """Return a mask video, which a take opens a dozen times.

    Raises:
        CaptureError: see `Video`.
    """
    return Video(path)


class _Others:
    """Files of a take that are not sampled; equal if equal in number, so that the cache need not compare the files."""

    def __init__(self, files: list[Path]) -> None:
        self.files, self._count = files, len(files)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Others) and self._count == other._count

    def __hash__(self) -> int:
        return self._count


def _spread(count: int, most: int) -> list[int]:
    """Return at most `most` evenly spaced indices from 0 to `count` - 1."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


@lru_cache(maxsize=256)
def _png_levels_of_version(
    sample: tuple[Path, ...],
    versions: tuple[tuple[int, int], ...],
    others: _Others,
    is_other: Callable[[RawImage], bool] | None,
) -> SourceLevels:
    """Find the levels of files; modification times and sizes of the sampled files identify the version."""
    read: list[Path] = []
    sizes: dict[tuple[int, int], Path] = {}

    def pictures(paths: Sequence[Path], as_numbers: bool) -> Iterator[RawImage]:
        for path in paths:
            try:
                image = load_png(path)
            except CaptureError:
                continue  # an error is raised later, when the frame is read
            if is_other is None or not is_other(image):
                read.append(path)
                sizes.setdefault((image.shape[1], image.shape[0]), path)
                yield read_palette_numbers(path, image) if as_numbers else image

    for palette_numbers in (False, True) if any(map(has_palette, sample)) else (False,):
        read.clear()
        more = partial(pictures, others.files, palette_numbers)
        try:
            found = find_levels(pictures(sample, palette_numbers), False, more)
        except NotMasks as error:
            where = read[error.index] if error.index is not None else sample[0].parent
            raise CaptureError(error.reason, path=where, hint=error.hint) from error
        if not read:
            return SourceLevels(MaskLevels())  # if all files are unreadable, an error is raised when a frame is read
        if found is not None:
            return SourceLevels(found, palette_numbers, tuple((path, size) for size, path in sizes.items()))
    return SourceLevels(None, sizes_px=tuple((path, size) for size, path in sizes.items()))


@_by_version
def video_levels(path: Path) -> tuple[SourceLevels, Colour]:
    """Find the levels of a mask video from samples, and the pixel format to decode.

    Raises:
        CaptureError: the video cannot be decoded, or the images are not masks.
    """
    video = mask_video(path)
    colour: Colour = "gray" if video.is_gray else "rgba" if video.has_alpha else "rgb"
    # Key frames are sampled because they are fast to decode; several, because some are empty, often the first.
    sample = [int(video.keys[k]) for k in _spread(len(video.keys), _SAMPLED)]
    if len(sample) < _FEWEST_OF_VIDEO:
        sample = sorted({*sample, *_spread(video.count, _FEWEST_OF_VIDEO)})
    numbers: list[int] = []
    neutral = [True]

    def pictures(chosen: Sequence[int] | None) -> Iterator[RawImage]:
        spans = [(0, video.count)] if chosen is None else [(k, k + 1) for k in chosen]
        for first, stop in spans:
            for frame in video.frames(first, stop, colour=colour, threads=1):
                if chosen is None and frame.index in sample:
                    continue
                numbers.append(frame.index)
                if colour != "gray":
                    neutral[0] &= spread_of_colours(frame.image) <= _NEUTRAL
                yield frame.image

    lossy = not (video.is_gray or video.is_rgb or video.has_alpha)
    try:
        found = find_levels(pictures(sample), lossy, partial(pictures, None))
    except NotMasks as error:
        where = "" if error.index is None else f"image {numbers[error.index]}: "
        raise CaptureError(where + error.reason, path=path, hint=error.hint) from error
    if lossy and neutral[0]:
        colour = "gray"  # luma has the full resolution
    return SourceLevels(found), colour


def load_png(path: Path) -> RawImage:
    """Read a mask image as stored.

    Raises:
        CaptureError: the mask cannot be decoded.
    """
    image = read_picture(path, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise CaptureError(
            "the mask cannot be decoded.", path=path, hint="Export the mask again, or delete it to skip the frame."
        )
    return image
