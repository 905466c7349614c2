"""Which frames a robust fit keeps."""

from __future__ import annotations

import numpy as np

from jawusd.geometry.arrays import Array, Mask


def within(residual_mm: Array, trim_mad: float, floor_mm: float) -> Mask:
    """Return the frames not farther than the median by `trim_mad` normalised median absolute deviations.

    Args:
        residual_mm: rms distance of the frames from the model, shape (N,).
        trim_mad: number of deviations (1.4826 MAD, the standard deviation of a normal distribution).
        floor_mm: residual below which a frame is never taken for a tracking failure.
    """
    middle = np.median(residual_mm)
    spread = 1.4826 * np.median(np.abs(residual_mm - middle))
    return residual_mm <= max(middle + trim_mad * spread, floor_mm)
