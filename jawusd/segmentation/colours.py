"""What teeth and their surroundings look like in one camera: colour histograms that follow the take."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

_BINS = 32  # per channel: 8 steps of lightness, 4 of each chroma channel
_CHROMA = (64, 4)  # first step and width of a chroma bin, of 8-bit Lab
_MOST = 6.0  # no colour alone is surer than this
_ROUNDS, _STEPS = 5, 8  # times covered crowns are told apart, and Newton steps each time
_RIDGE = 0.01  # keeps weights finite where colours do not overlap


class ColourModel:
    """Learn the colours of teeth and of everything around them, and weigh colours by it.

    What lies under projected crowns is teeth and, where lips, cheeks or tongue hide them, surroundings; what lies
    beyond them is surroundings. A logistic regression on the colours, their squares and products tells the two apart;
    what it finds to be surroundings under the crowns changes sides, and it is fitted again. So few terms cannot follow
    colours of lips that happen to lie under crowns only.
    """

    def __init__(self, memory: float) -> None:
        """Know nothing yet.

        Args:
            memory: frames over which colours are remembered.
        """
        self._keep = 1.0 - 1.0 / memory
        self._under = np.zeros((_BINS,) * 3)
        self._beyond = np.zeros((_BINS,) * 3)
        self._table: NDArray[np.float32] | None = None

    def learn(self, lab: NDArray[np.uint8], under: NDArray[np.bool_], beyond: NDArray[np.bool_], weight=1.0) -> None:
        """Take in a picture.

        Args:
            lab: (h, w, 3) 8-bit CIE Lab.
            under: pixels well inside projected crowns, shape (h, w).
            beyond: pixels well outside all of them, shape (h, w).
            weight: what the picture counts, in frames.
        """
        index = _bins(lab)
        for counts, where in ((self._under, under), (self._beyond, beyond)):
            new = np.bincount(index[where], minlength=_BINS**3).reshape(counts.shape)
            counts *= self._keep**weight
            counts += weight * new / max(1, where.sum())
        self._table = None

    def knows(self) -> bool:
        """Tell whether any picture was seen."""
        return bool(self._under.any() and self._beyond.any())

    def weigh(self, lab: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the log of how many times likelier each pixel is tooth than surroundings, shape (h, w)."""
        return self._odds()[_bins(lab)]

    def surroundings_reach(self, share: float) -> float:
        """Return the log-odds that the given share of the surroundings stays below."""
        odds, counts = self._odds(), self._beyond.ravel()
        order = np.argsort(odds)
        return float(odds[order[np.searchsorted(np.cumsum(counts[order]), share * counts.sum())]])

    def _odds(self) -> NDArray[np.float32]:
        if self._table is None:
            weights = _tell_apart(self._under.ravel(), self._beyond.ravel())
            self._table = np.clip(_terms() @ weights, -_MOST, _MOST).astype(np.float32)
        return self._table


def to_lab(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an RGB picture as 8-bit CIE Lab, shape (h, w, 3)."""
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)


def _bins(lab: NDArray[np.uint8]) -> NDArray[np.intp]:
    first, width = _CHROMA
    light = lab[..., 0].astype(np.intp) * _BINS // 256
    a, b = (np.clip((lab[..., k].astype(np.intp) - first) // width, 0, _BINS - 1) for k in (1, 2))
    return (light * _BINS + a) * _BINS + b


@cache
def _terms() -> NDArray[np.float64]:
    """Return the terms of the regression for the centre of every bin, shape (bins, 10)."""
    first, width = _CHROMA
    centre = np.arange(_BINS) + 0.5
    light, a, b = np.meshgrid(centre * 256 / _BINS, *[first + width * centre] * 2, indexing="ij")
    # Brought to about unit spread: mid grey, and the chroma of skin.
    light, a, b = (light.ravel() - 128) / 60, (a.ravel() - 138) / 10, (b.ravel() - 138) / 10
    return np.stack([np.ones_like(a), light, a, b, light**2, a**2, b**2, light * a, light * b, a * b], axis=1)


def _tell_apart(under: NDArray[np.float64], beyond: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights of the terms from the counts of every bin, shape (10,)."""
    seen = np.flatnonzero(under + beyond)
    x = _terms()[seen]
    under, beyond = (c[seen] / max(c.sum(), 1e-12) for c in (under, beyond))
    weights, ridge = np.zeros(x.shape[1]), _RIDGE * np.eye(x.shape[1])
    ridge[0, 0] = 1e-9
    tooth = np.ones(len(seen))
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


def _logistic(odds: NDArray[np.float64]) -> NDArray[np.float64]:
    return 1 / (1 + np.exp(-np.clip(odds, -30, 30)))
