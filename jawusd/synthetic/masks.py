"""Teeth masks with the defects of manual segmentation: jittering outlines, small holes, specks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask

# Size of the jitter [px] and of its cells at a picture height of 1080; a constant share, the rest correlated in time.
_WOBBLE_PX, _CELL_PX = 0.7, 36.0
_REFERENCE_HEIGHT = 1080.0
_CONSTANT_SHARE = 0.5
_KEEP = 0.6
_HOLE_CHANCE, _SPECK_CHANCE = 0.12, 0.08
_FINE = 4


class Outline:
    """The jitter of one mask's outline over time, as a displacement field."""

    def __init__(self, size_px: tuple[int, int], rng: np.random.Generator) -> None:
        """Start the jitter of masks of a width and height."""
        scale = size_px[1] / _REFERENCE_HEIGHT
        self._rng = rng
        cells = tuple(int(np.ceil(s / (_CELL_PX * scale))) + 3 for s in size_px[::-1])
        self._amplitude_px = _WOBBLE_PX * scale
        self._constant = rng.normal(size=(*cells, 2))
        self._varying = rng.normal(size=(*cells, 2))

    def next(self) -> Array:
        """Return the displacement field of the next frame [px], shape (rows, columns, 2), over the picture."""
        fresh = self._rng.normal(size=self._varying.shape)
        self._varying = _KEEP * self._varying + np.sqrt(1.0 - _KEEP**2) * fresh
        field = np.sqrt(_CONSTANT_SHARE) * self._constant + np.sqrt(1.0 - _CONSTANT_SHARE) * self._varying
        field = _refined(_refined(field, 0), 1)
        return self._amplitude_px * field


def _refined(field: Array, axis: int) -> Array:
    """Interpolate along an axis with cosine weights; the inverse norm keeps the variance even between the nodes."""
    t = np.arange(_FINE) / _FINE
    b = 0.5 - 0.5 * np.cos(np.pi * t)
    a = 1.0 - b
    norm = np.hypot(a, b)
    field = np.moveaxis(field, axis, 0)
    shape = (1, _FINE) + (1,) * (field.ndim - 1)
    between = (a / norm).reshape(shape) * field[:-1, None] + (b / norm).reshape(shape) * field[1:, None]
    return np.moveaxis(between.reshape(-1, *field.shape[1:]), 0, axis)


def drawn_mask(coverage: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a mask (h, w), 0 or 255, from the coverage (h, w), 0..255, at times with a small hole or speck."""
    mask = coverage > 127
    hole, speck = rng.random() < _HOLE_CHANCE, rng.random() < _SPECK_CHANCE
    place, radius = rng.random(2), rng.uniform(1.2, 3.5, 2) * len(mask) / _REFERENCE_HEIGHT * 1.5
    if mask.any():
        rows, columns = np.nonzero(mask)
        pick = int(place[0] * len(rows))
        if hole:
            _ellipse(mask, rows[pick], columns[pick], radius, False)
        if speck:
            drop = (8.0 + 22.0 * place[1]) * len(mask) / _REFERENCE_HEIGHT
            _ellipse(mask, rows.max() + drop, columns[pick], radius, True)
    return np.where(mask, np.uint8(255), np.uint8(0))


def _ellipse(mask: Mask, row: float, column: float, radius: Array, value: bool) -> None:
    """Set the pixels of a small ellipse."""
    y, x = np.ogrid[: mask.shape[0], : mask.shape[1]]
    mask[((y - row) / radius[0]) ** 2 + ((x - column) / radius[1]) ** 2 <= 1.0] = value
