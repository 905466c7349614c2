"""Tooth edges in a colour image: the most likely border along every contour normal.

Pixels inside the border should have tooth colours, pixels outside background colours. The sum of the log ratios on both
sides is the log likelihood of a border position (as in Stoiber et al. 2022). No mask is computed.

All compiled functions release the GIL and are stateless.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.tracking.contour.samples import INVERSE_DEPTH, NX, NY, U, V, is_nearer, pixel_of, value_at
from jawusd.tracking.contour.scan import CROWN

_MOST_STEPS = 10  # maximum number of search steps to either side of a sample
# minimum mean log ratio on both sides for full weight of a border [-], and fraction of it below which it is rejected
_CLEAR_RATIO, _LEAST_CLEAR = 1.0, 0.15
_CONTRAST, _SHARP_REACH_PX = 20.0, 2.0  # minimum contrast of refined borders [8-bit steps]; maximum refinement
# minimum and maximum motion blur that is compensated; gamma of the images
_LEAST_BLUR_PX, _MOST_BLUR_PX, _GAMMA = 1.0, 10.0, 2.2
_SMOOTH_PX = 1.0  # half the width over which image gradients are computed [px]
_PER_CODE = 8  # number of entries of the linearisation table per 8-bit step
_LIGHT = (np.arange(255 * _PER_CODE + 1) / (255 * _PER_CODE)) ** _GAMMA


@numba.njit(nogil=True, cache=True, inline="always")
def _within(bins: NDArray[np.uint16], x: float, y: float) -> bool:
    """Return whether an image position can be interpolated bilinearly."""
    return x >= 0 and y >= 0 and x < bins.shape[1] - 1 and y < bins.shape[0] - 1


@numba.njit(nogil=True, cache=True, inline="always")
def _ratio_at(bins: NDArray[np.uint16], table: NDArray[np.float32], x: float, y: float) -> float:
    """Interpolate the log ratio of a table bilinearly; outside the image, return the neutral value 0."""
    if not _within(bins, x, y):
        return 0.0
    # Unsigned indices avoid numba's check for negative indices.
    i = np.uint32(x)
    j = np.uint32(y)
    one = np.uint32(1)
    a = x - np.floor(x)
    b = y - np.floor(y)
    return (table[bins[j, i]] * (1 - a) + table[bins[j, np.uint32(i + one)]] * a) * (1 - b) + (
        table[bins[np.uint32(j + one), i]] * (1 - a) + table[bins[np.uint32(j + one), np.uint32(i + one)]] * a
    ) * b


@numba.njit(nogil=True, cache=True)
def search_borders(
    samples: Array,
    tables: NDArray[np.int64],
    bins: NDArray[np.uint16],
    ratio: NDArray[np.float32],
    own_labels: NDArray[np.uint8],
    other_labels: NDArray[np.uint8],
    other_inverse_depth: NDArray[np.float32],
    reach_px: float,
    tolerance_mm: float,
    cos_limit: float,
    out: Array,
    clearness: Array,
) -> None:
    """Write the signed distance [px] from every contour sample to the most likely tooth border on its normal.

    Args:
        samples: shape (n, COLUMNS).
        tables: index of every sample's row in `ratio`, shape (n,).
        bins: colour bin of every pixel, shape (h, w).
        ratio: bounded log likelihood ratio of tooth to background by colour bin [-], shape (T, B).
        own_labels, other_labels: rendered labels of this and of the other arch: CROWN, GUM or 0, shape (h, w).
        other_inverse_depth: rendered inverse depth of the other arch's scan [1/mm], 0 = empty, shape (h, w).
        reach_px: search distance on either side of the sample.
        tolerance_mm: minimum depth difference between the arches for occlusion.
        cos_limit: minimum cosine between the sample's normal and the direction in which the log ratio falls.
        out: result, shape (n,): distance, positive outwards; NaN where the sample is hidden or no border is found.
        clearness: result, shape (n,): weight, 0 .. 1; NaN where the other arch hides the sample.
    """
    step = max(1.0, reach_px / _MOST_STEPS)
    n = int(np.ceil(reach_px / step)) + 3
    r = np.empty(2 * n + 1)
    for s in range(len(samples)):
        out[s] = np.nan
        clearness[s] = 0.0
        sample = samples[s]
        x, y, nx, ny = sample[U], sample[V], sample[NX], sample[NY]
        if is_nearer(value_at(other_inverse_depth, x, y), sample[INVERSE_DEPTH], tolerance_mm):
            clearness[s] = np.nan
            continue
        table = ratio[tables[s]]
        _read_line(r, n, step, sample, bins, table, own_labels, other_labels)
        k = _likeliest(r, n, step, reach_px)
        if k < 0:
            continue
        clear = min(r[k - 3 : k].mean(), -r[k + 1 : k + 4].mean()) / _CLEAR_RATIO
        if clear <= _LEAST_CLEAR:
            continue
        d = _zero_crossing(r, n, step, k)
        ex, ey, e = x + d * nx, y + d * ny, max(1.5, step)
        gx = _ratio_at(bins, table, ex + e, ey) - _ratio_at(bins, table, ex - e, ey)
        gy = _ratio_at(bins, table, ex, ey + e) - _ratio_at(bins, table, ex, ey - e)
        if -(gx * nx + gy * ny) < cos_limit * np.sqrt(gx * gx + gy * gy):
            continue  # a border that crosses the contour belongs to a lip or a neighbouring tooth
        out[s] = d
        clearness[s] = min(1.0, clear)


@numba.njit(nogil=True, cache=True, inline="always")
def _read_line(
    r: Array,
    n: int,
    step: float,
    sample: Array,
    bins: NDArray[np.uint16],
    table: NDArray[np.float32],
    own_labels: NDArray[np.uint8],
    other_labels: NDArray[np.uint8],
) -> None:
    """Read the log ratios along a contour normal; they are 0 inwards of the sample's crown and beyond the next one."""
    x, y, nx, ny = sample[U], sample[V], sample[NX], sample[NY]
    r[:] = 0.0
    for i in range(n, 2 * n + 1):
        t = (i - n) * step
        px, py = x + t * nx, y + t * ny
        if not _within(bins, px, py):
            break
        row, column = np.uint32(py + 0.5), np.uint32(px + 0.5)
        if t > 1.0 and (own_labels[row, column] == CROWN or other_labels[row, column] == CROWN):
            break
        r[i] = _ratio_at(bins, table, px, py)
    for i in range(n - 1, -1, -1):
        t = (i - n) * step
        px, py = x + t * nx, y + t * ny
        if not _within(bins, px, py) or (t < -1.0 and own_labels[np.uint32(py + 0.5), np.uint32(px + 0.5)] != CROWN):
            break
        r[i] = _ratio_at(bins, table, px, py)


@numba.njit(nogil=True, cache=True, inline="always")
def _likeliest(r: Array, n: int, step: float, reach_px: float) -> int:
    """Return the index of the most likely border along a normal; -1 if it lies near an end of the search range."""
    total = 0.0
    best = -np.inf
    at = -1
    for i in range(2 * n + 1):
        t = (i - n) * step
        value = (total + 0.5 * r[i]) * min(step, 2.0) - 0.5 * (t / reach_px) ** 2
        total += r[i]
        if value > best:
            best = value
            at = i
    return at if 3 <= at <= 2 * n - 3 and abs(at - n) * step <= reach_px else -1


@numba.njit(nogil=True, cache=True, inline="always")
def _zero_crossing(r: Array, n: int, step: float, k: int) -> float:
    """Return the position [px] near index k at which the log ratio falls below 0, or else that of index k."""
    d = (k - n) * step
    near = np.inf
    for m in range(k - 2, k + 2):
        if r[m] > 0 >= r[m + 1]:
            place = (m - n + r[m] / (r[m] - r[m + 1])) * step
            if abs(place - d) < abs(near - d):
                near = place
    return near if near < np.inf else d


@numba.njit(nogil=True, cache=True, inline="always")
def colour_at(rgb: NDArray[np.uint8], x: float, y: float) -> tuple[float, float, float]:
    """Interpolate a colour bilinearly, clamping at the image border."""
    x = min(max(x, 0.0), rgb.shape[1] - 1.001)
    y = min(max(y, 0.0), rgb.shape[0] - 1.001)
    i = int(x)
    j = int(y)
    a = x - i
    b = y - j
    return (
        (rgb[j, i, 0] * (1 - a) + rgb[j, i + 1, 0] * a) * (1 - b)
        + (rgb[j + 1, i, 0] * (1 - a) + rgb[j + 1, i + 1, 0] * a) * b,
        (rgb[j, i, 1] * (1 - a) + rgb[j, i + 1, 1] * a) * (1 - b)
        + (rgb[j + 1, i, 1] * (1 - a) + rgb[j + 1, i + 1, 1] * a) * b,
        (rgb[j, i, 2] * (1 - a) + rgb[j, i + 1, 2] * a) * (1 - b)
        + (rgb[j + 1, i, 2] * (1 - a) + rgb[j + 1, i + 1, 2] * a) * b,
    )


@numba.njit(nogil=True, cache=True, inline="always")
def _light(code: float) -> float:
    """Linearise a gamma-encoded value, 0 .. 255, with an error of 1e-7; a table is much faster than pow()."""
    x = code * _PER_CODE
    k = min(int(x), 255 * _PER_CODE - 1)
    return _LIGHT[k] + (x - k) * (_LIGHT[k + 1] - _LIGHT[k])


@numba.njit(nogil=True, cache=True)
def sharpen(samples: Array, rgb: NDArray[np.uint8], blur_px: Array, out: Array, clearness: Array) -> None:
    """Move every border to the steepest colour change between its inside and outside.

    The midpoint between both colours would be biased, since crowns darken towards their edges.

    Args:
        blur_px: motion along the normals during the exposure, which is the width of a blurred edge, shape (n,).
        out, clearness: results of `search_borders`, updated in place; borders without a steepest point get a lower
            weight.
    """
    inner = np.empty(3)
    outer = np.empty(3)
    line = np.empty(8 * int(_SHARP_REACH_PX + _SMOOTH_PX + _MOST_BLUR_PX) + 8)
    for s in range(len(samples)):
        if not clearness[s] > 0:
            continue
        u, v, nx, ny, d = samples[s, U], samples[s, V], samples[s, NX], samples[s, NY], out[s]
        wide = min(0.5 * blur_px[s], _MOST_BLUR_PX)
        inner[:] = 0.0
        outer[:] = 0.0
        for q in range(3):
            t = 1.75 + q + wide
            within, beyond = (
                colour_at(rgb, u + (d - t) * nx, v + (d - t) * ny),
                colour_at(rgb, u + (d + t) * nx, v + (d + t) * ny),
            )
            for c in range(3):
                inner[c] += within[c] / 3
                outer[c] += beyond[c] / 3
        if ((inner - outer) ** 2).sum() < _CONTRAST * _CONTRAST:
            continue
        # A moving edge is a ramp in linear light, not in gamma-encoded values. The middle of the ramp is its steepest
        # point after a second blur of the same width.
        power = _GAMMA if blur_px[s] > _LEAST_BLUR_PX else 1.0
        norm = 0.0
        for c in range(3):
            inner[c], outer[c] = (inner[c] / 255) ** power, (outer[c] / 255) ** power
            norm += (inner[c] - outer[c]) ** 2
        arm = int(2 * (_SMOOTH_PX + wide)) + 1
        steps = int(2 * (_SHARP_REACH_PX + wide))
        for q in range(2 * (steps + arm) + 1):
            t = d + 0.5 * (q - steps - arm)
            colour = colour_at(rgb, u + t * nx, v + t * ny)
            p = 0.0
            for c in range(3):
                value = colour[c] / 255 if power == 1.0 else _light(colour[c])
                p += (value - outer[c]) * (inner[c] - outer[c])
            line[q] = p / norm
        place = steepest(line, arm, arm + 2 * steps, arm, True, arm + steps)
        if np.isnan(place):
            clearness[s] *= 0.3
        else:
            out[s] = d + 0.5 * place


@numba.njit(nogil=True, cache=True, inline="always")
def steepest(line: Array, first: int, last: int, arm: int, falls: bool, origin: int) -> float:
    """Return the interpolated index of the steepest change of a profile minus `origin`; NaN without a local maximum.

    Args:
        first, last: range of indices that are searched.
        arm: number of samples on either side from whose linearly weighted difference the gradient is computed.
        falls: whether only descents count.
    """
    before, slope = np.nan, np.nan
    best, place = 0.0, np.nan
    for k in range(first, last + 1):
        after = 0.0
        for i in range(1, arm + 1):
            after += (line[k - i] - line[k + i]) * min(i, arm + 1 - i)
        if not falls:
            after = abs(after)
        if k > first + 1 and slope > best and slope >= before and slope >= after:
            best = slope
            bend = before - 2 * slope + after
            place = k - 1 - origin + (0.5 * (before - after) / bend if bend < 0 else 0.0)
        before, slope = slope, after
    return place


@numba.njit(nogil=True, cache=True)
def count_colours(
    samples: Array,
    tables: NDArray[np.int64],
    distances: Array,
    clearness: Array,
    bins: NDArray[np.uint16],
    own_labels: NDArray[np.uint8],
    other_labels: NDArray[np.uint8],
    near_px: int,
    far_px: int,
    tooth: Array,
    outside: Array,
) -> None:
    """Count the colours on both sides of borders found within 2 px.

    Pixels from `near_px` to `far_px` away from the contour are added to the counts `tooth` and `outside` (T, B).
    """
    for s in range(len(samples)):
        if not clearness[s] > 0.3 or not abs(distances[s]) < 2:
            continue
        u, v, nx, ny = samples[s, U], samples[s, V], samples[s, NX], samples[s, NY]
        for t in range(near_px, far_px + 1):
            i, j = pixel_of(u - t * nx), pixel_of(v - t * ny)
            if i < 0 or j < 0 or j >= bins.shape[0] or i >= bins.shape[1] or own_labels[j, i] != CROWN:
                break
            tooth[tables[s], bins[j, i]] += clearness[s]
        for t in range(near_px, far_px + 1):
            i, j = pixel_of(u + t * nx), pixel_of(v + t * ny)
            if i < 0 or j < 0 or j >= bins.shape[0] or i >= bins.shape[1]:
                break
            if own_labels[j, i] == CROWN or other_labels[j, i] == CROWN:
                break
            outside[tables[s], bins[j, i]] += clearness[s]
