"""Map evenly spaced frames to the images of a video, whose presentation times may be irregular."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array


class Timeline:
    """Assignment of the images of a video to a regular grid of frames by presentation time.

    Frame k is the image that is displayed k nominal frame durations after the first image. At a constant rate this is
    image k; at a variable rate, some frames have no image.

    Attributes:
        numbers: frame number of each image, increasing, shape (n,).
        count: one past the frame number of the last image.
        stored: file number of each image, increasing, shape (n,); 0, 1, 2, ... for videos.
    """

    def __init__(self, times_s: Array, fps: float) -> None:
        """Fit the grid to presentation times (n,) [s]; for one or two images, use the file's average rate."""
        self._set(*_grid(times_s, fps), np.arange(len(times_s)))

    @classmethod
    def of_files(cls, stored: NDArray[np.int64], fps: float) -> Timeline:
        """Return the timeline of images with increasing numbers (n,): the first is frame 0; gaps have no image."""
        line = cls.__new__(cls)
        line._set(stored - stored[0], fps, stored)
        return line

    def _set(self, numbers: NDArray[np.int64], rate: float, stored: NDArray[np.int64]) -> None:
        self.numbers, self.rate, self.stored = numbers, rate, stored
        self.count = int(numbers[-1]) + 1
        # If two images belong to one frame, use the first.
        self._picture = dict(zip(numbers[::-1].tolist(), range(len(numbers) - 1, -1, -1)))

    @property
    def is_numbered(self) -> bool:
        """Whether the file numbers of the images differ from 0, 1, 2, ..."""
        return bool(self.stored[0] != 0 or self.stored[-1] != len(self.stored) - 1)

    def number(self, frame: int) -> int | None:
        """Return the file number of the image shown at a frame, or None."""
        picture = self.picture(frame)
        return None if picture is None else int(self.stored[picture])

    @property
    def missing(self) -> int:
        """Return the number of frames without an image."""
        return self.count - len(self._picture)

    def picture(self, frame: int) -> int | None:
        """Return the index of the image shown at a frame; None outside the video or without an image."""
        return self._picture.get(int(frame))


def _grid(times_s: Array, fps: float) -> tuple[NDArray[np.int64], float]:
    """Return the frame number of each image, and the frame rate [Hz]."""
    steps = np.diff(times_s)
    if len(steps) < 2 or not (median := float(np.median(steps))) > 0:
        return np.arange(len(times_s)), fps
    # Use the mean over adjacent frames: gaps would bias the mean of all, and rounded time stamps would bias the median.
    period = float(steps[(steps > 0.5 * median) & (steps < 1.5 * median)].mean())
    last = 16  # jitter causes an error of a few per mille, so refine the period on growing intervals
    while True:
        stretch = times_s[:last]
        numbers = np.round(stretch / period)
        period = float((numbers @ stretch) / (numbers @ numbers))
        if last >= len(times_s):
            return np.round(times_s / period).astype(np.int64), 1 / period
        last *= 2
