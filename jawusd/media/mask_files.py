"""Read masks from numbered PNG files or videos, converted to coverage."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from jawusd.base.errors import CaptureError
from jawusd.formats.file_names import numbered_files
from jawusd.media.mask_levels import MaskImage, RawImage
from jawusd.media.mask_source import SourceLevels, load_png, mask_video, png_levels, video_levels
from jawusd.media.pictures import read_palette_numbers
from jawusd.media.pixels import Colour

#: Gray value of the requested arch and gray value of the other arch in label images; all other pixels must be 0.
LabelValues = tuple[int, int]

_FEW = 6  # maximum number of label values that a message lists


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

    @cached_property
    def levels(self) -> SourceLevels:
        """Find out which values are teeth and background, from samples of the whole take.

        Raises:
            CaptureError: the images have the wrong size or are not masks.
        """
        found = png_levels([self._path(k) for k in sorted(self._names)], self._is_other)
        for path, size in found.sizes_px:
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
            elif self.levels.levels is None:
                yield None
            else:
                image = read_palette_numbers(path, image) if self.levels.palette_numbers else image
                mask, odd = self.levels.levels.coverage(image)
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
        odd: reasons why images read so far were rejected, by number; rejected images count as not segmented.
    """

    def __init__(self, path: Path, size_px: tuple[int, int], labels: LabelValues | None = None) -> None:
        """Open the video; see `PngMasks` for the arguments.

        Raises:
            CaptureError: the video is missing or damaged, or has the wrong size.
        """
        self._video, self._labels = mask_video(path), labels
        self.odd: dict[int, str] = {}
        _check_size(path, self._video.size_px, size_px)
        self.count, self.timeline = self._video.count, self._video.timeline

    @cached_property
    def levels(self) -> SourceLevels:
        """Find out which values are teeth and background; see `PngMasks.levels`."""
        return video_levels(self._video.path)[0]

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
        found, colour = video_levels(self._video.path)
        if found.levels is None:
            yield from (None for _ in range(first, self.count))
            return
        for frame in self._video.frames(first, colour=colour, threads=1):
            mask, odd = found.levels.coverage(frame.image)
            if odd:
                self.odd[frame.index] = f"image {frame.index} {odd}"
            yield mask


@dataclass(frozen=True, eq=False)
class OneMask:
    """A mask in memory, of one frame."""

    frame: int  # frame number of the camera
    image: MaskImage  # 255 for tooth, 0 for background, shape (h, w)
    odd: dict[int, str] = field(default_factory=dict)  # reasons why images were rejected; always empty

    @property
    def count(self) -> int:
        """One past the last frame number."""
        return self.frame + 1

    def masks(self, first: int) -> Iterator[MaskImage | None]:
        """Yield the masks from a frame number on, (h, w) uint8, or None for other frames."""
        return (self.image if frame == self.frame else None for frame in range(first, self.count))


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
