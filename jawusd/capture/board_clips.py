"""The clips of calibration boards: videos, or numbered pictures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import CalibrationError, CaptureError
from jawusd.formats.numbered import is_pattern, numbered_files
from jawusd.media.display import to_display
from jawusd.media.pictures import read_picture
from jawusd.media.stored_picture import read_header, read_stored
from jawusd.media.video import Video


class BoardClip:
    """Hold the board pictures of one camera: a video, or numbered pictures.

    Attributes:
        path: video or pattern.
        numbers: picture numbers, increasing; in a video the frames at which the pictures are shown.
        size_px: (width, height) of every picture.
    """

    def __init__(self, path: Path) -> None:
        """Find the pictures.

        Raises:
            CaptureError: there are none, or the first cannot be read.
        """
        self.path = path
        self._files: dict[int, Path] = {}
        if is_pattern(path):
            self._video = None
            self._files = numbered_files(path)
            self.numbers = list(self._files)
            self.size_px = _read(self._files[self.numbers[0]]).shape[::-1]
        else:
            self._video = Video(path)
            self.numbers = sorted(set(self._video.timeline.numbers.tolist()))
            self.size_px = self._video.size_px

    @property
    def is_video(self) -> bool:
        """Return whether successive pictures are moments of one motion."""
        return self._video is not None

    @property
    def is_interlaced(self) -> bool:
        """Return whether pictures are marked as woven of two instants, as far as they were read."""
        return self._video is not None and self._video.is_interlaced

    def pictures(self, wanted: list[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield (number, gray picture) of the given numbers, in order.

        Raises:
            CalibrationError: a picture has another size than the first.
            CaptureError: a picture cannot be read.
        """
        if self._video is None:
            for number in wanted:
                path = self._files[number]
                image = _read(path)
                if image.shape[::-1] != self.size_px:
                    raise CalibrationError(
                        f"is {image.shape[1]} x {image.shape[0]} px, the first picture {self.size_px[0]} x "
                        f"{self.size_px[1]} px.",
                        path=path,
                    )
                yield number, image
            return
        shown = {self._video.timeline.picture(number): number for number in wanted}
        needed = {picture: number for picture, number in shown.items() if picture is not None}
        for frame in self._video.frames(min(needed), max(needed) + 1, threads=1):
            if frame.index in needed:
                yield needed[frame.index], frame.image


def _read(path: Path) -> NDArray[np.uint8]:
    image = read_picture(path, cv2.IMREAD_GRAYSCALE)
    if image is not None:
        return np.asarray(image, np.uint8)
    try:  # what OpenCV does not read: EXR, DPX
        stored = read_stored(path)
    except CaptureError as error:
        raise CaptureError(
            "is not a picture that can be read.", path=path, hint="Use PNG, JPEG, TIFF, EXR or DPX."
        ) from error
    shown = to_display(stored.pixels, stored.largest, read_header(path).colour_space, None)
    return shown if shown.ndim == 2 else np.asarray(cv2.cvtColor(shown, cv2.COLOR_RGB2GRAY), np.uint8)


def sharpness(image: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian (Pech-Pacheco et al. 2000), comparable between pictures of one camera."""
    return float(cv2.Laplacian(image, cv2.CV_16S).var()) + 1e-9
