"""Colour-based edge search in one camera's image: colour tables, motion blur and borders of contour samples.

All compiled functions release the GIL and are stateless.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.tracking.contour.samples import LENGTH, NX, NY, U, V, X, Y, Z, pixel, pixel_of, value_at
from jawusd.tracking.contour.scan import CROWN, GUM
from jawusd.tracking.contour.views import Drawn
from jawusd.tracking.region.colours import BINS, KINDS, TABLES
from jawusd.tracking.region.edges import colour_at, count_colours, search_borders, sharpen, steepest

_AHEAD_PX = 2.0  # distance outside a crown's silhouette at which the rendered label is tested for gum [px]

_SHUTTER = 0.5  # assumed exposure as a fraction of the frame time, as is typical of film
# Motion during the exposure at which the weight of a border is halved [px]: the variance of an edge position grows with
# the square of its blur. The weight is applied only in the final alignment: in earlier ones, the matched fraction of
# the contour determines whether teeth are lost.
_BLURRED_PX = 10.0
_LEARNED_PX = (2, 7)  # minimum and maximum distance from the contour of pixels whose colours are learned [px]
# Limits for estimating the gum-line offset: minimum weight of a border [-], maximum distance of a border from its
# sample [px], and number of samples that must be exceeded.
_SURE, _GUM_REACH_PX, _FEWEST_GUM = 0.3, 2.5, 30
_SHARPEN_PX = 5.0  # maximum search range for which borders are refined by colour [px]
# A contour is in sight where the mean log ratio at these distances inside it [px] exceeds this value [-].
_INNER_PX, _TOOTH_RATIO = (1.5, 2.5, 3.5, 4.5), 0.3
# Minimum difference between the brighter tooth and a dark line [8-bit steps]; weight of the edges found [-]; maximum
# reach for which they are searched for [px].
_CREASE_CONTRAST, _CREASE_WEIGHT, _CREASE_REACH_PX = 25.0, 0.5, 7.0
# Search range of dark lines around a sample, and of edges around a dark line [px]; number of half-pixel steps to either
# side from which a gradient is computed.
_CREASE_PX, _BESIDE_PX, _CREASE_ARM = 6.0, 3.0, 3


@numba.njit(nogil=True, cache=True)
def choose_tables(
    samples: Array, count: int, labels: NDArray[np.uint8], axes: Array, patches: Array, out: NDArray[np.int64]
) -> None:
    """Write the index of the log-ratio table of each contour sample: nearest patch, and tooth edge or gum line.

    Args:
        samples: shape (n, COLUMNS); the first `count` are on the silhouette.
        labels: rendered labels of the arch (CROWN, GUM or 0), shape (h, w).
        axes: rotation from scan to anatomical axes: left, up, front; shape (3, 3).
        patches: centres of the arch's patches, left and front [mm], shape (PATCHES, 2).
        out: result, shape (n,).
    """
    height, width = labels.shape
    for s in range(len(samples)):
        sample = samples[s]
        kind = 1
        if s < count:  # a silhouette in front of its own gum looks like a gum line
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
def measure_blur(samples: Array, before: Array, out: Array) -> None:
    """Write the motion of contour samples along their normals during the exposure [px], shape (n,).

    `before` (3, 4) projects the arch into this camera's image in the previous frame.
    """
    for s in range(len(samples)):
        sample = samples[s]
        u, v, _ = pixel(before, sample[X], sample[Y], sample[Z])
        out[s] = _SHUTTER * abs((sample[U] - u) * sample[NX] + (sample[V] - v) * sample[NY])


@numba.njit(nogil=True, cache=True)
def measure_in_sight(
    samples: Array, tables: NDArray[np.int64], bins: NDArray[np.uint16], ratio: NDArray[np.float32], clearness: Array
) -> float:
    """Return the length of contour beside which the image has tooth colours on the inner side [px].

    Args:
        samples, tables, bins, ratio: as in `search_borders`.
        clearness: weights of the borders, NaN where the other arch hides the sample, shape (n,).
    """
    height, width = bins.shape
    length = 0.0
    for s in range(len(samples)):
        sample = samples[s]
        if np.isnan(clearness[s]):
            continue
        total, count = 0.0, 0
        for depth in _INNER_PX:
            i, j = pixel_of(sample[U] - depth * sample[NX]), pixel_of(sample[V] - depth * sample[NY])
            if 0 <= i < width and 0 <= j < height:
                total += ratio[tables[s], bins[j, i]]
                count += 1
        if total > _TOOTH_RATIO * count:
            length += sample[LENGTH]
    return length


@numba.njit(nogil=True, cache=True)
def search_creases(
    samples: Array,
    rgb: NDArray[np.uint8],
    own_labels: NDArray[np.uint8],
    other_labels: NDArray[np.uint8],
    reach_px: float,
    out: Array,
    clearness: Array,
) -> None:
    """Find crown edges in front of the other arch: the steepest brightness change beside the dark line between crowns.

    Both crowns have the same colours. Shading may darken both towards the line, but gradually; the edge is sharp except
    for lens blur.

    Arguments are those of `edges.search_borders`; only samples without a border are processed.
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
        if value_at(other_labels, beyond_x, beyond_y) != CROWN or value_at(own_labels, beyond_x, beyond_y) == CROWN:
            continue
        for k in range(2 * n + 1):
            t = 0.5 * (k - n)
            red, green, blue = colour_at(rgb, u + t * nx, v + t * ny)
            line[k] = (red + green + blue) / 3
        low, at = np.inf, n
        for k in range(n - int(2 * reach), n + int(2 * reach) + 1):
            p = line[k] + 0.25 * abs(k - n)  # prefer the nearer of two dark lines
            if p < low:
                low, at = p, k
        least = line[at]
        before, behind = line[max(at - 8, 0)], line[min(at + 8, 2 * n)]
        if max(before, behind) - least < _CREASE_CONTRAST or min(before, behind) - least < 0.4 * _CREASE_CONTRAST:
            continue
        first, last = max(at - int(2 * _BESIDE_PX), _CREASE_ARM), min(at + int(2 * _BESIDE_PX), 2 * n - _CREASE_ARM)
        place = steepest(line, first, last, _CREASE_ARM, False, 0)
        if not np.isnan(place) and abs(place - n) <= 2 * reach:
            out[s] = 0.5 * (place - n)
            clearness[s] = _CREASE_WEIGHT


@dataclass(frozen=True, eq=False)
class Counts:
    """Statistics collected beside the borders matched in an image."""

    tooth: Array  # colours inside borders, shape (2, TABLES, BINS)
    outside: Array  # colours outside borders, shape (2, TABLES, BINS)
    gum_px: Array  # outward offset of observed gum lines from those of the scans [px], NaN if not measured, shape (2,)
    in_sight_px: Array  # length of contour beside which the image shows teeth in the last search [px], shape (2,)

    @classmethod
    def zeros(cls) -> Counts:
        """Return statistics without any counts."""
        return cls(np.zeros((2, TABLES, BINS)), np.zeros((2, TABLES, BINS)), np.full(2, np.nan), np.zeros(2))


@dataclass(frozen=True, eq=False)
class RegionView:
    """Part of an undistorted image with the colour model of teeth."""

    rgb: NDArray[np.uint8]  # 8-bit pixels, shape (h, w, 3)
    bins: NDArray[np.uint16]  # colour bins, shape (h, w)
    ratio: NDArray[np.float32]  # log-likelihood ratios of tooth to background, shape (2, TABLES, BINS)
    patches: Array  # centres of the patches of both arches, left and front [mm], shape (2, PATCHES, 2)
    axes: Array  # rotation from scan to anatomical axes, shape (3, 3)
    before: Array  # projections of both arches into this camera's image in the previous frame, shape (2, 3, 4)
    counts: Counts | None = None  # statistics to collect in the final alignment of a frame

    def likeness(self, arch: int) -> NDArray[np.float32]:
        """Return each pixel's log-likelihood ratio of tooth to background, mean of an arch's tables, shape (h, w)."""
        return np.asarray(self.ratio[arch].mean(0)[self.bins], np.float32)

    def search(
        self, samples: Array, count: int, arch: int, drawn: Drawn, limits: tuple[float, float, float]
    ) -> tuple[Array, Array]:
        """Return border distances and weights; see `EdgeSearch`."""
        tables, blur_px = np.empty(len(samples), np.int64), np.empty(len(samples))
        distances, clearness = np.empty(len(samples)), np.empty(len(samples))
        choose_tables(samples, count, drawn.own, self.axes, self.patches[arch], tables)
        measure_blur(samples, self.before[arch], blur_px)
        both = (drawn.own, drawn.other, drawn.other_inverse_depth)
        search_borders(samples, tables, self.bins, self.ratio[arch], *both, *limits, distances, clearness)
        if limits[0] <= _SHARPEN_PX:
            sharpen(samples, self.rgb, blur_px, distances, clearness)
        if limits[0] <= _CREASE_REACH_PX:
            search_creases(samples, self.rgb, drawn.own, drawn.other, limits[0], distances, clearness)
        if self.counts is not None:
            self._count(self.counts, arch, samples, tables, distances, clearness, drawn)
            clearness /= 1.0 + (blur_px / _BLURRED_PX) ** 2
        return distances, clearness

    def _count(
        self,
        counts: Counts,
        arch: int,
        samples: Array,
        tables: NDArray[np.int64],
        distances: Array,
        clearness: Array,
        drawn: Drawn,
    ) -> None:
        sums = (counts.tooth[arch], counts.outside[arch])
        labels = (drawn.own, drawn.other)
        count_colours(samples, tables, distances, clearness, self.bins, *labels, *_LEARNED_PX, *sums)
        counts.in_sight_px[arch] = measure_in_sight(samples, tables, self.bins, self.ratio[arch], clearness)
        line = (tables % KINDS == 1) & (clearness > _SURE) & (np.abs(distances) < _GUM_REACH_PX)
        if line.sum() > _FEWEST_GUM:
            counts.gum_px[arch] = np.median(distances[line])
