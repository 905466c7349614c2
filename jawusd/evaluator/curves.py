"""Piecewise cubic curves with given values and slopes, the building block of additive models and of bounds."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.curve_formula import cubic


@dataclass(frozen=True)
class HermiteCurve:
    """A C1 cubic Hermite curve of one variable that goes on as a straight line outside its knots.

    Attributes:
        knots: Rising parameter values, shape (n,), n >= 2.
        values: Points of the curve at the knots, shape (n, k).
        slopes: Derivatives at the knots, shape (n, k).
        starts: Knot that each interval's powers count from, the straight ends first and last, shape (n + 1,).
        coefficients: Powers 0..3 of (x - start) per interval, shape (n + 1, 4, k).
    """

    knots: Array
    values: Array
    slopes: Array
    starts: Array = field(init=False, repr=False)
    coefficients: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        # Per interval the powers 0..3 of s = x - knot; intervals 0 and n are the straight ends, so that no
        # evaluation has to treat them apart.
        y, m = self.values, self.slopes
        inner = np.stack(cubic(np.diff(self.knots)[:, None], y[:-1], y[1:], m[:-1], m[1:]), axis=1)
        straight = np.zeros((2, *inner.shape[1:]))
        straight[0, :2] = y[0], m[0]
        straight[1, :2] = y[-1], m[-1]
        object.__setattr__(self, "starts", np.concatenate([self.knots[:1], self.knots]))
        object.__setattr__(self, "coefficients", np.concatenate([straight[:1], inner, straight[1:]]))

    def value(self, x: Array) -> Array:
        """Return the points at x (n,), shape (n, k)."""
        c, s = self._locate(x)
        return ((c[:, 3] * s + c[:, 2]) * s + c[:, 1]) * s + c[:, 0]

    def value_and_slope(self, x: Array) -> tuple[Array, Array]:
        """Return the points and the derivatives at x (n,), both of shape (n, k)."""
        c, s = self._locate(x)
        c0, c1, c2, c3 = c[:, 0], c[:, 1], c[:, 2], c[:, 3] * s
        return ((c3 + c2) * s + c1) * s + c0, (3 * c3 + 2 * c2) * s + c1

    def slope(self, x: Array) -> Array:
        """Return the derivatives at x (n,), shape (n, k)."""
        c, s = self._locate(x)
        return (3 * c[:, 3] * s + 2 * c[:, 2]) * s + c[:, 1]

    def _locate(self, x: Array) -> tuple[Array, Array]:
        interval = self.knots.searchsorted(x, side="right")
        return self.coefficients[interval], (x - self.starts[interval])[:, None]
