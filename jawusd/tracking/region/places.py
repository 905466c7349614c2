"""What is known of contour samples from where they lie: the colours to expect beside them, and how far they moved.

Every compiled function here releases the GIL and keeps no state.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.tracking.contour.samples import NX, NY, U, V, X, Y, Z, pixel_of
from jawusd.tracking.contour.scan import GUM
from jawusd.tracking.region.colours import KINDS

_AHEAD_PX = 2.0  # outside of a crown's silhouette, where it is looked whether gum lies behind


@numba.njit(nogil=True, cache=True)
def choose_tables(
    samples: Array, count: int, labels: NDArray[np.uint8], axes: Array, patches: Array, out: NDArray[np.int64]
) -> None:
    """Write the table of log ratios for each sample: of the nearest patch, for a free edge or the gum line.

    Args:
        samples: shape (n, COLUMNS); the first `count` are silhouette.
        labels: what is seen of the arch: CROWN, GUM or 0, shape (h, w).
        axes: rotation from scan to anatomical axes: left, up, front; shape (3, 3).
        patches: middles of the arch's patches, left and front [mm], shape (PATCHES, 2).
        out: receives, shape (n,).
    """
    height, width = labels.shape
    for s in range(len(samples)):
        sample = samples[s]
        kind = 1
        if s < count:  # crowns before their own gum look like the gum line
            i = min(max(pixel_of(sample[U] + _AHEAD_PX * sample[NX]), 0), width - 1)
            j = min(max(pixel_of(sample[V] + _AHEAD_PX * sample[NY]), 0), height - 1)
            kind = 1 if labels[j, i] == GUM else 0
        left = axes[0, 0] * sample[X] + axes[0, 1] * sample[Y] + axes[0, 2] * sample[Z]
        front = axes[2, 0] * sample[X] + axes[2, 1] * sample[Y] + axes[2, 2] * sample[Z]
        best, at = np.inf, 0
        for k in range(len(patches)):
            apart = (left - patches[k, 0]) ** 2 + (front - patches[k, 1]) ** 2
            if apart < best:
                best, at = apart, k
        out[s] = KINDS * at + kind


@numba.njit(nogil=True, cache=True)
def measure_blur(samples: Array, before: Array, shutter: float, out: Array) -> None:
    """Write how far the samples move along their normals during the exposure [px], shape (n,).

    Args:
        samples: shape (n, COLUMNS).
        before: projection of the arch to this picture at the frame before, shape (3, 4).
        shutter: share of a frame's time that it is exposed [-].
        out: receives, shape (n,).
    """
    for s in range(len(samples)):
        sample = samples[s]
        x, y, z = sample[X], sample[Y], sample[Z]
        w = before[2, 0] * x + before[2, 1] * y + before[2, 2] * z + before[2, 3]
        u = (before[0, 0] * x + before[0, 1] * y + before[0, 2] * z + before[0, 3]) / w
        v = (before[1, 0] * x + before[1, 1] * y + before[1, 2] * z + before[1, 3]) / w
        out[s] = shutter * abs((sample[U] - u) * sample[NX] + (sample[V] - v) * sample[NY])
