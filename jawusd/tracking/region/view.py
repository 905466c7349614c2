"""What is known of contour samples from where they lie: the colours to expect beside them, and how far they moved.

Every compiled function here releases the GIL and keeps no state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.tracking.contour.samples import NX, NY, U, V, X, Y, Z, pixel_of
from jawusd.tracking.contour.scan import GUM
from jawusd.tracking.contour.views import Drawn
from jawusd.tracking.region.colours import BINS, KINDS, TABLES
from jawusd.tracking.region.creases import search_creases
from jawusd.tracking.region.edges import count_colours, search_borders, sharpen

_AHEAD_PX = 2.0  # outside of a crown's silhouette, where it is looked whether gum lies behind

_SHUTTER = 0.5  # share of a frame's time that it is exposed: unknown, usual for film
# Motion during the exposure at which a border counts half in the last look [px]: what is measured of a ramp of light is
# the less sure the longer it is, in variance as the square. Chosen on two path-traced mouths, two others were seen;
# NEES of all four 0.74, 0.35, 0.77, 0.31, without it 1.54, 0.44, 1.04, 0.40. Looks before the last tell by the share
# of the contour that fits whether teeth are lost, which fast ones are not.
_BLURRED_PX = 10.0
_LEARNED_PX = (2, 7)  # distances from borders between which colours are learned
# Of the place of the gum line: least weight of a border [-], farthest [px], fewest samples.
_SURE, _GUM_REACH_PX, _FEWEST_GUM = 0.3, 2.5, 30
_CLEAR_RATIO = 1.0  # mean log ratio on both sides from which a border counts in full [-]
_SHARPEN_PX = 5.0  # reach from which on borders are refined by colour
_CONTRAST, _SHARP_REACH_PX = 20.0, 2.0  # of colours half way [8-bit steps], [px]
_CREASE_CONTRAST, _CREASE_WEIGHT, _CREASE_REACH_PX = 25.0, 0.5, 7.0


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


@dataclass(frozen=True, eq=False)
class Counts:
    """Collect what the borders found in a picture teach."""

    tooth: Array  # colours inside of borders, shape (2, TABLES, BINS)
    outside: Array  # colours outside, shape (2, TABLES, BINS)
    gum_px: Array  # how far outside of the scans' gum line it was found [px], NaN where it was not, shape (2,)

    @classmethod
    def zeros(cls) -> Counts:
        """Return empty counts."""
        return cls(np.zeros((2, TABLES, BINS)), np.zeros((2, TABLES, BINS)), np.full(2, np.nan))


@dataclass(frozen=True, eq=False)
class RegionView:
    """Hold a part of an undistorted picture with the colours that tell teeth."""

    rgb: NDArray[np.uint8]  # shape (h, w, 3)
    bins: NDArray[np.uint16]  # colour bins, shape (h, w)
    ratio: NDArray[np.float32]  # log ratios of tooth over anything else, shape (2, TABLES, BINS)
    patches: Array  # middles of the patches of both arches, left and front [mm], shape (2, PATCHES, 2)
    axes: Array  # rotation from scan to anatomical axes, shape (3, 3)
    before: Array  # projections of both arches to this picture at the frame before, shape (2, 3, 4)
    counts: Counts | None = None  # collects what is found, in the last look at an instant

    def likeness(self, arch: int) -> NDArray[np.float32]:
        """Return how much every pixel looks like teeth of an arch rather than anything else, shape (h, w)."""
        return np.asarray(self.ratio[arch].mean(0)[self.bins], np.float32)

    def search(
        self, samples: Array, count: int, arch: int, drawn: Drawn, limits: tuple[float, float, float]
    ) -> tuple[Array, Array]:
        """Return distances and weights; see `EdgeSearch`."""
        tables, blur_px = np.empty(len(samples), np.int64), np.empty(len(samples))
        distances, clearness = np.empty(len(samples)), np.empty(len(samples))
        choose_tables(samples, count, drawn.own, self.axes, self.patches[arch], tables)
        measure_blur(samples, self.before[arch], _SHUTTER, blur_px)
        both = (drawn.own, drawn.other, drawn.other_inverse_depth)
        search_borders(samples, tables, self.bins, self.ratio[arch], *both, *limits, _CLEAR_RATIO, distances, clearness)
        if limits[0] <= _SHARPEN_PX:
            sharpen(samples, self.rgb, _CONTRAST, _SHARP_REACH_PX, blur_px, distances, clearness)
        if limits[0] <= _CREASE_REACH_PX:
            crease = (_CREASE_CONTRAST, _CREASE_WEIGHT)
            search_creases(samples, self.rgb, drawn.own, drawn.other, limits[0], *crease, distances, clearness)
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
        line = (tables % KINDS == 1) & (clearness > _SURE) & (np.abs(distances) < _GUM_REACH_PX)
        if line.sum() > _FEWEST_GUM:
            counts.gum_px[arch] = np.median(distances[line])
