"""Colour model of teeth and surroundings in one camera: histograms of the whole image and of patches of each arch."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from jawusd.base.arrays import Array, Mask

PATCHES = 8  # number of patches per arch
KINDS = 2  # number of border kinds: tooth edge and gum line
TABLES = PATCHES * KINDS  # number of colour tables per arch; table = KINDS * patch + kind
_BITS = 4  # bits per colour channel; with more bits, most bins would stay empty
BINS = 1 << (3 * _BITS)

_BLUR = 0.7  # standard deviation of the blur kernel [bins]
_REACH = 2  # radius of the blur kernel [bins]
# Matrix that blurs along one axis of the colour cube; values are replicated at its border.
_SPREAD = gaussian_filter1d(np.eye(1 << _BITS), _BLUR, axis=0, mode="nearest", radius=_REACH)
_LOCAL = 0.5  # weight of a patch's own histogram in its colour model
_MOST = 3.0  # maximum magnitude of the log ratios, since no colour is conclusive
_LIPS = 0.2  # weight of skin and lips in the background model
_EMPTY = 2e-5  # probability assigned to unseen colours
_ENOUGH = 200.0  # minimum number of counts for a new histogram to have full weight
_ROUNDS = 3  # number of iterations that separate lips from teeth among the pixels under crowns


def colour_bins(rgb: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return the colour bin of every pixel of an image (h, w, 3), shape (h, w)."""
    out = np.empty(rgb.shape[:2], np.uint16)
    _write_bins(rgb, out)
    return out


@numba.njit(nogil=True, cache=True)
def _write_bins(rgb: NDArray[np.uint8], out: NDArray[np.uint16]) -> None:
    for j in range(rgb.shape[0]):
        for i in range(rgb.shape[1]):
            bin_ = 0
            for c in range(3):
                bin_ = (bin_ << _BITS) | (rgb[j, i, c] >> (8 - _BITS))
            out[j, i] = bin_


@dataclass(frozen=True, eq=False)
class Areas:
    """Masks of an image that select the training pixels of the initial model, shape (h, w) each."""

    crowns: Mask  # pixels well inside projected crowns
    ring: Mask  # pixels around projected crowns, within reach of the search
    gum: Mask  # pixels under projected gum, away from crowns
    far: Mask  # pixels away from the teeth: skin and lips


class CameraColours:
    """Colour model of teeth and surroundings: log likelihood ratios of colours."""

    def __init__(self, bins: NDArray[np.uint16], areas: Areas) -> None:
        """Train on a first image, given as colour bins of shape (h, w).

        Lips may hide the projected crowns, and other teeth may lie beside the crowns; repeated classification removes
        the pixels of lips and other teeth.
        """

        def count(where: Mask) -> Array:
            return np.bincount(bins[where].ravel(), minlength=BINS).astype(np.float64)

        under, ring, pink = count(areas.crowns), count(areas.ring), count(areas.gum)
        lips = _smooth(count(areas.far)) + 1e-2
        self._lips = lips / lips.sum()
        tooth, outside, gum = under, ring, pink
        for _ in range(_ROUNDS):
            t, o, g = (_smooth(h) / max(h.sum(), 1.0) + 1e-6 for h in (tooth, outside, gum))
            tooth = under * (t > np.maximum(o, self._lips))
            gum = pink * ((g > 1.3 * self._lips) & (g > t))
            outside = ring * (np.maximum(o, g) > self._lips)
        self._gum, self._tooth, self._outside = (_smooth(h) / max(h.sum(), 1.0) for h in (gum, tooth, outside))
        self._local_tooth = np.zeros((2, TABLES, BINS))
        self._local_outside = np.zeros((2, TABLES, BINS))
        self.ratio = self._ratio()

    def learn(self, tooth: Array, outside: Array, rates: tuple[float, float]) -> None:
        """Blend in the colours (2, TABLES, BINS) counted on both sides of matched borders, with weights 0 .. 1."""
        # Tooth edges and gum line of a patch belong to the same teeth, so their tooth colours are pooled.
        both = tooth.reshape(2, PATCHES, KINDS, BINS).sum(2)
        _blend(self._local_tooth.reshape(-1, KINDS, BINS), both.reshape(-1, BINS), rates[0])
        _blend(self._local_outside.reshape(-1, 1, BINS), outside.reshape(-1, BINS), rates[1])
        self._tooth = _blended(self._tooth, tooth.sum((0, 1)), rates[0])
        self._outside = _blended(self._outside, outside.sum((0, 1)), rates[1])
        self.ratio = self._ratio()

    def _ratio(self) -> NDArray[np.float32]:
        """Return the log ratio of tooth to background by arch, table and bin, shape (2, TABLES, BINS)."""
        out = np.empty((2 * TABLES, BINS), np.float32)
        beside = np.stack([self._outside, 0.5 * (self._gum + self._outside)])  # background histograms by kind of border
        inside, outside = self._local_tooth.reshape(-1, BINS), self._local_outside.reshape(-1, BINS)
        _write_ratios(inside, outside, self._tooth, beside, self._lips, out)
        return out.reshape(2, TABLES, BINS)


@numba.njit(nogil=True, cache=True)
def _write_ratios(
    local_tooth: Array, local_outside: Array, tooth: Array, outside: Array, lips: Array, out: NDArray[np.float32]
) -> None:
    """Write the log ratios of colour tables (T, B) from a mixture of local, global and lip histograms.

    Args:
        local_tooth, local_outside: histograms by table, shape (T, B); all zero where nothing was learned.
        tooth: histogram of all teeth, shape (B,).
        outside: histogram of the background next to borders of each kind, shape (KINDS, B).
        lips: histogram of skin and lips, shape (B,).
        out: result, shape (T, B).
    """
    for t in range(len(out)):
        inner = _LOCAL if local_tooth[t].any() else 0.0
        outer = _LOCAL if local_outside[t].any() else 0.0
        for b in range(BINS):
            p = inner * local_tooth[t, b] + (1 - inner) * tooth[b]
            q = outer * local_outside[t, b] + (1 - outer) * outside[t % KINDS, b]
            q = (1 - _LIPS) * q + _LIPS * lips[b]
            out[t, b] = min(max(np.log((p + _EMPTY) / (q + _EMPTY)), -_MOST), _MOST)


@numba.njit(nogil=True, cache=True)
def _blend(known: Array, counts: Array, rate: float) -> None:
    """Blend blurred counts (T, B), weighted by their number, into histograms (T, K, B); all K are updated alike."""
    blurred = np.empty(BINS)
    for t in range(len(known)):
        total = counts[t].sum()
        if total == 0.0:
            continue
        _blur(counts[t], blurred)
        share = (rate if known[t].any() else 1.0) * min(1.0, total / _ENOUGH)
        for k in range(known.shape[1]):
            for b in range(BINS):
                known[t, k, b] = (1 - share) * known[t, k, b] + share / total * blurred[b]


@numba.njit(nogil=True, cache=True)
def _blur(histogram: Array, out: Array) -> None:
    """Blur a sparse histogram (B,) over neighbouring colours."""
    out[:] = 0.0
    side, reach = len(_SPREAD), _REACH
    for b in range(len(histogram)):
        if histogram[b] == 0.0:
            continue
        red, green, blue = b // (side * side), b // side % side, b % side
        for i in range(max(red - reach, 0), min(red + reach + 1, side)):
            for j in range(max(green - reach, 0), min(green + reach + 1, side)):
                part = histogram[b] * _SPREAD[i, red] * _SPREAD[j, green]
                for k in range(max(blue - reach, 0), min(blue + reach + 1, side)):
                    out[(i * side + j) * side + k] += part * _SPREAD[k, blue]


def _blended(known: Array, counts: Array, rate: float) -> Array:
    """Return a histogram (BINS,) with new counts blended in; unchanged if the counts are too few."""
    total = counts.sum()
    return known if total < 2 * _ENOUGH else (1 - rate) * known + rate * _smooth(counts / total)


def _smooth(histogram: Array) -> Array:
    """Blur a histogram (BINS,) over neighbouring colours."""
    out = np.empty(BINS)
    _blur(histogram, out)
    return out
