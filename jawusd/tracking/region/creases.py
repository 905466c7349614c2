"""Edges of crowns in front of the other arch's crowns, where foreground and background have the same colour.

All compiled functions release the GIL and are stateless.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.tracking.contour.samples import NX, NY, U, V, pixel_of
from jawusd.tracking.contour.scan import CROWN
from jawusd.tracking.region.edges import colour_at

# Search range of dark lines around a sample, and of edges around a dark line [px]; number of half-pixel steps to either
# side from which a gradient is computed.
_CREASE_PX, _BESIDE_PX, _CREASE_ARM = 6.0, 3.0, 3


@numba.njit(nogil=True, cache=True)
def search_creases(
    samples: Array,
    rgb: NDArray[np.uint8],
    own_labels: NDArray[np.uint8],
    other_labels: NDArray[np.uint8],
    reach_px: float,
    contrast: float,
    weight: float,
    out: Array,
    clearness: Array,
) -> None:
    """Find crown edges in front of the other arch: the steepest brightness change beside the dark line between crowns.

    Shading may darken both crowns towards the line, but gradually; the edge is sharp except for lens blur.

    Args:
        contrast: minimum difference between the brighter tooth and the line [8-bit steps].
        weight: weight of the edges found [-].
        Other arguments are those of `edges.search_borders`; only samples without a border are processed.
    """
    reach = min(reach_px, _CREASE_PX)
    n = 2 * int(reach + _BESIDE_PX) + _CREASE_ARM
    line = np.empty(2 * n + 1)
    for s in range(len(samples)):
        sample = samples[s]
        if clearness[s] != 0.0:  # a border was found, or the sample is hidden
            continue
        u, v, nx, ny = sample[U], sample[V], sample[NX], sample[NY]
        beyond_x, beyond_y = u + 3 * nx, v + 3 * ny
        if _label(other_labels, beyond_x, beyond_y) != CROWN or _label(own_labels, beyond_x, beyond_y) == CROWN:
            continue
        for k in range(2 * n + 1):
            t = 0.5 * (k - n)
            line[k] = _light(rgb, u + t * nx, v + t * ny)
        low, at = np.inf, n
        for k in range(n - int(2 * reach), n + int(2 * reach) + 1):
            p = line[k] + 0.25 * abs(k - n)  # prefer the nearer of two dark lines
            if p < low:
                low, at = p, k
        least = line[at]
        before, behind = line[max(at - 8, 0)], line[min(at + 8, 2 * n)]
        if max(before, behind) - least < contrast or min(before, behind) - least < 0.4 * contrast:
            continue
        place = _sharpest(line, at, int(2 * _BESIDE_PX))
        if not np.isnan(place) and abs(place - n) <= 2 * reach:
            out[s] = 0.5 * (place - n)
            clearness[s] = weight


@numba.njit(nogil=True, cache=True, inline="always")
def _sharpest(line: Array, at: int, steps: int) -> float:
    """Return the interpolated index of the steepest change near index `at` of a profile; NaN if there is none."""
    best, place = 0.0, np.nan
    before, slope = np.nan, np.nan
    first = max(at - steps, _CREASE_ARM)
    for k in range(first, min(at + steps, len(line) - 1 - _CREASE_ARM) + 1):
        after = 0.0
        for i in range(1, _CREASE_ARM + 1):
            after += (line[k + i] - line[k - i]) * min(i, _CREASE_ARM + 1 - i)
        after = abs(after)
        if k > first + 1 and slope > best and slope >= before and slope >= after:
            best = slope
            bend = before - 2 * slope + after
            place = k - 1 + (0.5 * (before - after) / bend if bend < 0 else 0.0)
        before, slope = slope, after
    return place


@numba.njit(nogil=True, cache=True, inline="always")
def _light(rgb: NDArray[np.uint8], x: float, y: float) -> float:
    red, green, blue = colour_at(rgb, x, y)
    return (red + green + blue) / 3


@numba.njit(nogil=True, cache=True, inline="always")
def _label(labels: NDArray[np.uint8], x: float, y: float) -> int:
    i = pixel_of(x)
    j = pixel_of(y)
    if i < 0 or j < 0 or j >= labels.shape[0] or i >= labels.shape[1]:
        return 0
    return labels[j, i]
