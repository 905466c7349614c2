"""The clips of calibration boards: videos, or numbered pictures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.errors import CalibrationError, CaptureError
from jawusd.imaging.pictures import read_picture
from jawusd.imaging.video import Video


class BoardClip:
    """Hold the board pictures of one camera: a video, or numbered pictures (a pattern with %d).

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
        if "%" in path.name:
            self._video = None
            self.numbers = _numbered(path)
            self.size_px = _read(Path(str(path) % self.numbers[0])).shape[::-1]
        else:
            self._video = Video(path)
            self.numbers = sorted(set(self._video.timeline.numbers.tolist()))
            self.size_px = self._video.size_px

    @property
    def is_video(self) -> bool:
        """Return whether successive pictures are moments of one motion."""
        return self._video is not None

    def pictures(self, wanted: list[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield (number, gray picture) of the given numbers, in order.

        Raises:
            CalibrationError: a picture has another size than the first.
            CaptureError: a picture cannot be read.
        """
        if self._video is None:
            for number in wanted:
                path = Path(str(self.path) % number)
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


def _numbered(pattern: Path) -> list[int]:
    numbers = []
    head, _, tail = pattern.name.partition("%")
    tail = tail[tail.find("d") + 1 :]
    for file in pattern.parent.iterdir():
        digits = file.name[len(head) : len(file.name) - len(tail)]
        if digits.isdigit() and file.name == pattern.name % int(digits):
            numbers.append(int(digits))
    if not numbers:
        raise CaptureError("no picture matches.", path=pattern, hint="Check [boards] videos in capture.toml.")
    return sorted(numbers)


def _read(path: Path) -> NDArray[np.uint8]:
    image = read_picture(path, cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise CaptureError("is not a picture that can be read.", path=path, hint="Use PNG, JPEG or TIFF.")
    return np.asarray(image, np.uint8)


def sharpness(image: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian (Pech-Pacheco et al. 2000), comparable between pictures of one camera."""
    return float(cv2.Laplacian(image, cv2.CV_16S).var()) + 1e-9
