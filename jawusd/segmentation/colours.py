"""Colour model of teeth and surroundings in one camera, with its saved state and its configuration.

The colour histograms adapt during the take. Their state is saved after every frame, so that resumed runs give the same
masks as uninterrupted runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.base.errors import FormatError
from jawusd.base.npz import read_arrays
from jawusd.formats.atomic import write_npz_atomic

_BINS = 32  # number of histogram bins per channel
_FLOOR = 12.0  # offset added to every channel [8-bit steps], which damps the noisy colour ratios of dark pixels
_RATIO_STEP = 0.03  # bin width of the log ratios [-]; the bins cover red over green from 0.6 to more than 1.6
_MOST = 6.0  # maximum magnitude of the log-odds from colour alone [-]
_ROUNDS, _STEPS = 5, 8  # number of reclassifications of the pixels under crowns, and number of Newton steps in each
_LIGHT = 1  # index of the lightness term
_RIDGE = 0.01  # ridge penalty on the weights, which keeps them finite if the colours are separable
# Two files are written alternately, since a run may be killed between saving the colours of a frame and recording the
# frame as done.
_FILES = ("colours_0.npz", "colours_1.npz")


@dataclass(frozen=True)
class SegmentationConfig:
    """Configuration of the segmentation; lengths in px are pixels of the working image."""

    # working resolution at the teeth, the same as that of the tracker
    working_px_per_mm: float = 7.2
    margin_mm: float = 4.0  # margin around the projected crowns: lips, gum and tongue, but no background
    inner_mm: float = 0.4  # minimum distance of tooth colours learned inside the projected crowns; above the pose error
    outer_mm: float = 1.0  # minimum distance of surrounding colours learned outside the projected crowns
    # maximum distance of tooth pixels outside the projected crowns, in the first iteration and after alignment
    reach_mm: tuple[float, ...] = (1.6, 1.0)
    memory_frames: float = 24.0  # time constant of the colour histograms; the light changes slowly, as the head moves
    # quantile of the log-odds in the surroundings that those of tooth colours must exceed [-], as the separability of
    # colours differs between subjects; and margin that is added to it where position gives no evidence [-]
    surroundings_share: float = 0.95
    doubt: float = 1.5
    doubt_range: tuple[float, float] = (-1.0, 1.0)  # minimum and maximum of the required log-odds [-]
    # increase of the log-odds of tooth per mm inside the projected outline [1/mm]; their minimum outside and their
    # maximum inside [-]
    place_per_mm: float = 2.0
    place_most: tuple[float, float] = (1.5, 1.0)
    # cost of a border per pixel of its length, in log-odds [-], and fraction of it that applies on the strongest edges
    border: float = 4.0
    border_on_edge: float = 0.15
    # log-odds of upper against lower arch per mm of distance from their projected common border [1/mm]
    rows_per_mm: float = 2.0
    # maximum displacement of a border by refinement, and width on each side in which colours are compared
    border_band_mm: float = 0.4
    border_side_mm: float = 0.8
    border_blur_px: float = 0.7  # sigma of the blur of the compared colours
    border_contrast: float = 2.0  # minimum colour separation at a visible border in standard deviations [-]
    # outward shift of the outlines of the upper and lower arch, learned from annotated masks, in widths of the soft
    # border, about 3 px [-]
    wider: tuple[float, float] = (0.0, 0.0)
    # minimum fraction of a part's outline on visible edges [-], and minimum area of a part; others are discarded
    founded_share: float = 0.5
    speck_px: int = 25
    steps: int = 40  # number of iterations of the cut
    arch_band_mm: float = 1.0  # search range for the border between the arches
    arch_steps: int = 60  # number of iterations of the cut that finds it
    key_weight: float = 12.0  # weight of an annotated mask in the colour histograms, as a number of frames
    # intersection over union with a finished mask below which the finished mask replaces the segmentation [-]
    key_overlap: float = 0.8
    least_px: int = 200  # minimum area of a mask, equal to 4 square millimetres


class ColourModel:
    """Colour model of teeth and their surroundings: log-odds that a colour is tooth.

    A logistic regression on the colours, their squares and products separates pixels under projected crowns from all
    others. Pixels under crowns that it classifies as surroundings (lips, cheeks, tongue) are relabelled, and the
    regression is repeated. With so few terms, it cannot overfit lip colours that occur only under crowns.

    Colours are lightness and the logs of red and blue over green. The ratios are invariant to shading (Finlayson et al.
    2006): shaded back teeth have the same ratios as lit front teeth.
    """

    def __init__(self, memory: float) -> None:
        """Start with empty histograms; `memory` is their time constant in frames."""
        self._keep = 1.0 - 1.0 / memory
        self._under = np.zeros((_BINS,) * 3)
        self._beyond = np.zeros((_BINS,) * 3)
        self._table: NDArray[np.float32] | None = None

    def learn(self, rgb: NDArray[np.uint8], under: Mask, beyond: Mask, weight: float = 1.0) -> None:
        """Update the histograms with an image (h, w, 3), given masks (h, w) well inside and well outside the crowns."""
        index = _bins(rgb)
        for counts, where in ((self._under, under), (self._beyond, beyond)):
            new = np.bincount(index[where], minlength=_BINS**3).reshape(counts.shape)
            counts *= self._keep**weight
            counts += weight * new / max(1, where.sum())
        self._table = None

    def is_trained(self) -> bool:
        """Return whether any image has been learned."""
        return bool(self._under.any() and self._beyond.any())

    def counts(self) -> tuple[NDArray[np.int64], Array]:
        """Return the state: colours, shape (N,), and their counts under and outside crowns, shape (2, N)."""
        both = np.stack([self._under.ravel(), self._beyond.ravel()])
        seen = np.flatnonzero(both.any(0))
        return seen, both[:, seen]

    def restore(self, seen: NDArray[np.int64], counts: Array) -> None:
        """Restore the state returned by `counts`."""
        for into, known in zip((self._under, self._beyond), counts, strict=True):
            into.ravel()[:] = 0
            into.ravel()[seen] = known
        self._table = None

    def log_odds(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the log-odds of tooth against surroundings at each pixel of an image, shape (h, w)."""
        return self._odds()[_bins(rgb)]

    def surroundings_quantile(self, share: float) -> float:
        """Return a quantile of the log-odds in the surroundings."""
        odds, counts = self._odds(), self._beyond.ravel()
        order = np.argsort(odds)
        return float(odds[order[np.searchsorted(np.cumsum(counts[order]), share * counts.sum())]])

    def _odds(self) -> NDArray[np.float32]:
        if self._table is None:
            weights = _fitted_weights(self._under.ravel(), self._beyond.ravel())
            self._table = np.clip(_terms() @ weights, -_MOST, _MOST).astype(np.float32)
        return self._table


def log_chroma(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the logs of lightness, red over green and blue over green of an 8-bit image, shape (h, w, 3)."""
    red, green, blue = (_LOGS[rgb[..., k]] for k in range(3))
    return np.stack([(red + green + blue) / 3, red - green, blue - green], axis=-1)


_LOGS = np.log(np.arange(256, dtype=np.float32) + np.float32(_FLOOR))


def _bins(rgb: NDArray[np.uint8]) -> Indices:
    red, green, blue = (_LOGS[rgb[..., k]] for k in range(3))
    light = (rgb[..., 1].astype(np.intp) * _BINS) >> 8
    a, b = (
        np.clip((ratio * np.float32(1 / _RATIO_STEP)).astype(np.int32) + _BINS // 2, 0, _BINS - 1)
        for ratio in (red - green, blue - green)
    )
    return (light * _BINS + a) * _BINS + b


@cache
def _terms() -> Array:
    """Return the terms of the regression at the centre of every histogram bin, shape (bins, 7).

    Lightness enters only linearly, so that dark lips under crowns cannot raise the log-odds of dark colours.
    """
    step = np.arange(_BINS) + 0.5
    light, ratio = np.log(step * 256 / _BINS + _FLOOR), (step - _BINS // 2) * _RATIO_STEP
    light, a, b = np.meshgrid(light, ratio, ratio, indexing="ij")
    # Normalise the terms to about unit variance.
    light, a, b = (light.ravel() - 4.6) / 0.5, (a.ravel() - 0.15) / 0.1, b.ravel() / 0.1
    return np.stack([np.ones_like(a), light, a, b, a**2, b**2, a * b], axis=1)


def _fitted_weights(under: Array, beyond: Array) -> Array:
    """Fit the weights (7,) of the terms to the counts in every bin; the weight of lightness is never negative."""
    seen = np.flatnonzero(under + beyond)
    x = _terms()[seen]
    under, beyond = (c[seen] / max(c.sum(), 1e-12) for c in (under, beyond))
    weights = _regress(x, under, beyond)
    if weights[_LIGHT] < 0:
        x[:, _LIGHT] = 0
        weights = _regress(x, under, beyond)
    return weights


def _regress(x: Array, under: Array, beyond: Array) -> Array:
    """Fit coefficients of terms (N, 7) that separate two classes with weights (N,); the first class has outliers."""
    weights, ridge = np.zeros(x.shape[1]), _RIDGE * np.eye(x.shape[1])
    ridge[0, 0] = 1e-9
    tooth = np.ones(len(x))
    for _ in range(_ROUNDS):
        positive, negative = under * tooth, beyond + under * (1 - tooth)
        positive, negative = positive / max(positive.sum(), 1e-12), negative / max(negative.sum(), 1e-12)
        for _ in range(_STEPS):
            p = _logistic(x @ weights)
            gradient = x.T @ (positive * (1 - p) - negative * p) - ridge @ weights
            curvature = (x * ((positive + negative) * p * (1 - p))[:, None]).T @ x + ridge
            weights = weights + np.linalg.solve(curvature, gradient)
        tooth = _logistic(x @ weights)
    return weights


def _logistic(odds: Array) -> Array:
    return 1 / (1 + np.exp(-np.clip(odds, -30, 30)))


class ColourStates:
    """Files that hold the colour models of all cameras."""

    def __init__(self, folder: Path, colours: Mapping[str, ColourModel]) -> None:
        self._folder, self._colours = folder, dict(colours)

    def save(self, frame: int, step: int) -> None:
        """Save the colours after a frame; raises OutputError if the file cannot be written."""
        arrays: dict[str, ArrayLike] = {"frame": frame, "step": step}
        for name, model in self._colours.items():
            arrays[f"seen {name}"], arrays[f"counts {name}"] = model.counts()
        write_npz_atomic(self._folder / _FILES[frame % 2], arrays, packed=False)

    def restore(self, done: int, step: int) -> int | None:
        """Restore the colours saved last up to frame `done`; return their frame or None; step: 1 or -1 (backwards)."""
        for frame in (done, done - step):
            path = self._folder / _FILES[frame % 2]
            try:
                kept = read_arrays(path)
            except FormatError:  # a missing or damaged file: its frames are processed again
                continue
            if (int(kept["frame"]), int(kept["step"])) != (frame, step):
                continue
            for name, model in self._colours.items():
                model.restore(np.asarray(kept[f"seen {name}"], np.int64), kept[f"counts {name}"])
            return frame
        return None


def state_files(folder: Path) -> list[Path]:
    """Return the paths of the state files in a folder."""
    return [folder / name for name in _FILES]
