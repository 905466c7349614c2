"""Map frames, which lie evenly in time, to pictures of a video, which need not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.geometry.arrays import Array


class Timeline:
    """Place the pictures of a video on an even grid of frames by their presentation times.

    Frame k is the picture shown k nominal frame durations after the first one. At a constant rate that is picture k;
    a variable rate leaves frames without a picture.

    Attributes:
        numbers: frame of each picture, increasing, shape (n,).
        count: one past the frame of the last picture.
    """

    def __init__(self, times_s: Array, fps: float) -> None:
        """Fit the grid to presentation times (n,) [s]; the file's average rate is used for one or two pictures."""
        self.numbers, self.rate = _grid(times_s, fps)
        self.count = int(self.numbers[-1]) + 1
        # Of two pictures in one frame, the first counts.
        self._picture = dict(zip(self.numbers[::-1].tolist(), range(len(times_s) - 1, -1, -1)))

    @property
    def missing(self) -> int:
        """Return how many frames have no picture of their own."""
        return self.count - len(self._picture)

    def picture(self, frame: int) -> int | None:
        """Return the number of the picture shown at a frame; None outside the video and where there is none."""
        return self._picture.get(int(frame))


def _grid(times_s: Array, fps: float) -> tuple[NDArray[np.int64], float]:
    """Return the frame of each picture and frames per second."""
    steps = np.diff(times_s)
    if len(steps) < 2 or not (median := float(np.median(steps))) > 0:
        return np.arange(len(times_s)), fps
    # Frames next to each other; gaps would bias the mean, rounded time stamps the median.
    period = float(steps[(steps > 0.5 * median) & (steps < 1.5 * median)].mean())
    last = 16  # jitter still leaves it off by some per mille: fit longer and longer stretches
    while True:
        stretch = times_s[:last]
        numbers = np.round(stretch / period)
        period = float((numbers @ stretch) / (numbers @ numbers))
        if last >= len(times_s):
            return np.round(times_s / period).astype(np.int64), 1 / period
        last *= 2
