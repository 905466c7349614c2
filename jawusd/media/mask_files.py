"""Read masks from numbered PNG files or videos, converted to coverage.

The meaning of the pixel values is found from samples of the whole take, once for each version of the files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from pathlib import Path

import cv2
import numpy as np

from jawusd.base.errors import CaptureError
from jawusd.formats.file_names import numbered_files
from jawusd.media.mask_levels import MaskImage, MaskLevels, NotMasks, RawImage, find_levels, spread_of_colours
from jawusd.media.pictures import has_palette, read_palette_numbers, read_picture
from jawusd.media.pixels import Colour
from jawusd.media.video import Video

#: Gray value of the requested arch and gray value of the other arch in label images; all other pixels must be 0.
LabelValues = tuple[int, int]

_FEW = 6  # maximum number of label values that a message lists
_SAMPLED = 10  # number of images sampled from a take
_FEWEST_OF_VIDEO = 4
_NEUTRAL = 12  # maximum difference [of 255] between the channels of a gray image after lossy coding

# Path, modification time [ns] and size [bytes] of a file, which identify its version; None if it is missing.
_Version = tuple[Path, int, int] | None


class PngMasks:
    """Masks stored as numbered PNG files.

    Attributes:
        count: one past the highest number.
        odd: reasons why images read so far were rejected, by number; rejected images count as not segmented.
    """

    def __init__(
        self,
        pattern: Path,
        size_px: tuple[int, int],
        labels: LabelValues | None = None,
        is_other: Callable[[RawImage], bool] | None = None,
    ) -> None:
        """Find the files (width, height) of a pattern; `is_other` detects images that are not masks.

        Raises:
            CaptureError: the folder is missing, or contains no file of this pattern.
        """
        self._pattern, self._size_px, self._labels, self._is_other = pattern, size_px, labels, is_other
        self.odd: dict[int, str] = {}
        # File names take less memory than paths; hours of footage from several cameras give a hundred thousand files.
        self._names = {number: path.name for number, path in numbered_files(pattern).items()}
        self.count = max(self._names) + 1

    @property
    def numbers(self) -> set[int]:
        """Return the numbers of the files."""
        return set(self._names)

    @property
    def levels(self) -> MaskLevels | None:
        """Find out which values are teeth and background; None if nothing is segmented.

        Raises:
            CaptureError: the images have the wrong size or are not masks.
        """
        return self._found.levels

    @cached_property
    def _found(self) -> _PngLevels:
        sample = _sampled(list(map(self._path, self._names)))
        found = _png_levels(self._pattern, len(self._names), tuple(map(_version, sample)), self._is_other)
        for size, path in found.sizes_px.items():
            _check_size(path, size, self._size_px)
        return found

    def masks(self, first: int) -> Iterator[MaskImage | None]:
        """Yield the masks from a number on, (h, w), or None if there is no file or nothing is segmented.

        Raises:
            CaptureError: a file cannot be decoded or has the wrong size, or the images are not masks.
        """
        for number in range(first, self.count):
            if number not in self._names:
                yield None
                continue
            path = self._path(number)
            image = load_png(path)
            _check_size(path, image.shape[1::-1], self._size_px)
            if self._labels is not None:
                image = image if image.ndim == 2 else read_palette_numbers(path, image)
                yield _labelled(image, self._labels, path, "")
            elif self.levels is None:
                yield None
            else:
                image = read_palette_numbers(path, image) if self._found.palette_numbers else image
                mask, odd = self.levels.coverage(image)
                if odd:
                    self.odd[number] = f"{path.name} {odd}"
                yield mask

    def _path(self, number: int) -> Path:
        return self._pattern.parent / self._names[number]


class VideoMasks:
    """Masks stored as a video, black and white or in its alpha channel.

    Attributes:
        count: number of images.
        timeline: maps frames to images.
        odd: see `PngMasks`.
    """

    def __init__(self, path: Path, size_px: tuple[int, int], labels: LabelValues | None = None) -> None:
        """Open the video; see `PngMasks` for the arguments.

        Raises:
            CaptureError: the video is missing or damaged, or has the wrong size.
        """
        self._version, self._labels = _version(path), labels
        self._video = _video(path, self._version)
        self.odd: dict[int, str] = {}
        _check_size(path, self._video.size_px, size_px)
        self.count, self.timeline = self._video.count, self._video.timeline

    @property
    def levels(self) -> MaskLevels | None:
        """Find out which values are teeth and background; see `PngMasks.levels`."""
        return _video_levels(self._video.path, self._version)[0]

    def masks(self, first: int) -> Iterator[MaskImage | None]:
        """Yield the masks from an image number on, (h, w), or None if nothing is segmented.

        Raises:
            CaptureError: an image cannot be decoded, or the images are not masks.
        """
        if self._labels is not None:  # luma where possible, because colour conversions change values
            colour: Colour = "rgb" if self._video.is_rgb else "gray"
            for frame in self._video.frames(first, colour=colour, threads=1):
                yield _labelled(frame.image, self._labels, self._video.path, f"image {frame.index}: ")
            return
        levels, colour = _video_levels(self._video.path, self._version)
        if levels is None:
            yield from (None for _ in range(first, self.count))
            return
        for frame in self._video.frames(first, colour=colour, threads=1):
            mask, odd = levels.coverage(frame.image)
            if odd:
                self.odd[frame.index] = f"image {frame.index} {odd}"
            yield mask


@dataclass(frozen=True, eq=False)
class OneMask:
    """A mask in memory, of one frame."""

    frame: int  # frame number of the camera
    image: MaskImage  # 255 for tooth, 0 for background, shape (h, w)
    odd: dict[int, str] = field(default_factory=dict)  # reasons why images were rejected; always empty
    levels: None = None

    @property
    def count(self) -> int:
        """One past the last frame number."""
        return self.frame + 1

    def masks(self, first: int) -> Iterator[MaskImage | None]:
        """Yield the masks from a frame number on, (h, w) uint8, or None for other frames."""
        return (self.image if frame == self.frame else None for frame in range(first, self.count))


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


def _check_size(path: Path, found: tuple[int, int], allowed: tuple[int, int]) -> None:
    if tuple(found) != tuple(allowed):
        raise CaptureError(
            f"the mask is {found[0]} x {found[1]} px, but the camera's images are {allowed[0]} x {allowed[1]} px.",
            path=path,
            hint="Export the masks at the size of the video.",
        )


def _labelled(image: RawImage, labels: LabelValues, path: Path, where: str) -> MaskImage:
    """Return a mask that is 255 where a label image shows the requested arch; reject unknown values."""
    plane = image if image.ndim == 2 else image[..., 0]
    if image.ndim == 3 and not all((image[..., c] == plane).all() for c in (1, 2)):
        raise CaptureError(
            f"{where}the label image is coloured; expected one gray value per dental arch.",
            path=path,
            hint="Export the labels as gray values (an index image without a palette).",
        )
    found = np.flatnonzero(np.bincount(plane.ravel()))
    if not np.isin(found, (0, *labels)).all():
        shown = ", ".join(map(str, found[:_FEW])) + (f" and {len(found) - _FEW} more" if len(found) > _FEW else "")
        low, high = sorted(labels)
        raise CaptureError(
            f"{where}the label image has the values {shown}; expected only 0, {low} and {high}.",
            path=path,
            hint="Correct masks.upper_value and masks.lower_value, or export without other labels, antialiasing or "
            "lossy compression.",
        )
    return np.where(plane == labels[0], np.uint8(255), np.uint8(0))


def _version(path: Path) -> _Version:
    return (path, path.stat().st_mtime_ns, path.stat().st_size) if path.is_file() else None


def _spread(count: int, most: int) -> list[int]:
    """Return at most `most` evenly spaced indices from 0 to `count` - 1."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def _sampled(files: Sequence[Path]) -> list[Path]:
    return [files[k] for k in _spread(len(files), _SAMPLED)]


@dataclass(frozen=True)
class _PngLevels:
    """Meaning of the pixel values of numbered files."""

    levels: MaskLevels | None
    palette_numbers: bool = False  # whether palette indices are used because all palette colours are equal
    sizes_px: dict[tuple[int, int], Path] = field(default_factory=dict)  # one sampled file by size (width, height)


@lru_cache(maxsize=256)
def _png_levels(
    pattern: Path, count: int, versions: tuple[_Version, ...], is_other: Callable[[RawImage], bool] | None
) -> _PngLevels:
    """Find the levels of `count` files; the versions of the sampled ones identify that of all."""
    files = list(numbered_files(pattern).values())
    sample = _sampled(files)
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

    others = [path for path in files if path not in sample]
    for palette_numbers in (False, True) if any(map(has_palette, sample)) else (False,):
        read.clear()
        try:
            found = find_levels(pictures(sample, palette_numbers), False, partial(pictures, others, palette_numbers))
        except NotMasks as error:
            where = read[error.index] if error.index is not None else pattern.parent
            raise CaptureError(error.reason, path=where, hint=error.hint) from error
        if not read:
            return _PngLevels(MaskLevels())  # if all files are unreadable, an error is raised when a frame is read
        if found is not None:
            return _PngLevels(found, palette_numbers, sizes)
    return _PngLevels(None, sizes_px=sizes)


@lru_cache(maxsize=64)
def _video(path: Path, version: _Version) -> Video:
    """Return a mask video, which a take opens a dozen times."""
    return Video(path)


@lru_cache(maxsize=64)
def _video_levels(path: Path, version: _Version) -> tuple[MaskLevels | None, Colour]:
    """Find the levels of a mask video from samples, and the pixel format to decode."""
    video = _video(path, version)
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
    # Luma has the full resolution.
    return found, "gray" if lossy and neutral[0] else colour
