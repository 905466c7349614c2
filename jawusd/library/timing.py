"""Preserve the timing of a retargeted curve, so that it rises and falls where the original curve does.

The result is the least-squares nearest curve that moves in the same direction as the original between any two samples:
isotonic regression (Barlow et al. 1972) whose direction follows the original's steps. It is found by dynamic
programming over the derivative of the cost as a function of the last value, as in R. Tibshirani, H. Hoefling,
R. Tibshirani, Nearly-Isotonic Regression, Technometrics 53 (2011).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from jawusd.base.arrays import Array, Mask

STILL_MM = 1e-6  # maximum step of the original curve that counts as having no direction


def follow(original: Array, carried: Array, least: float) -> Array:
    """Return the curve (F,) [mm] nearest to a retargeted curve among all curves that rise and fall with the original.

    Args:
        least: Minimum step of the result per 1 mm step of the original, > 0; it keeps peaks from becoming plateaus.
    """
    steps = np.diff(original)
    still = np.flatnonzero(np.abs(steps) < STILL_MM) + 1
    kept = np.empty_like(carried)
    for run in np.split(np.arange(len(carried)), still):
        if len(run):
            offset = least * (original[run] - original[run[0]])
            kept[run] = offset + _zigzag(np.diff(original[run]) > 0, carried[run] - offset)
    return kept


def _zigzag(rising: Mask, wanted: Array) -> Array:
    """Return values z (n,) nearest to ``wanted`` (n,) with z[i + 1] >= z[i] where ``rising`` (n - 1,), <= elsewhere."""
    cost = _Slopes()
    cost.add(wanted[0])
    limits = np.empty(len(rising))
    for i, up in enumerate(rising):
        limits[i] = cost.cut(up)
        cost.add(wanted[i + 1])
    z = np.empty_like(wanted)
    z[-1] = cost.cut(True)
    for i in range(len(rising) - 1, -1, -1):
        z[i] = (min if rising[i] else max)(z[i + 1], limits[i])
    return z


class _Slopes:
    """Derivative of a convex, piecewise quadratic cost, stored as line segments between knots.

    A line is (slope, offset). A knot has a position and the changes of slope and offset there; knots run from left to
    right.
    """

    def __init__(self) -> None:
        self._first, self._last = (0.0, 0.0), (0.0, 0.0)
        self._knots: deque[tuple[float, float, float]] = deque()

    def add(self, wanted: float) -> None:
        """Add half the squared distance from a value to the cost."""
        self._first = (self._first[0] + 1.0, self._first[1] - wanted)
        self._last = (self._last[0] + 1.0, self._last[1] - wanted)

    def cut(self, right: bool) -> float:
        """Return the minimiser of the cost, and make the cost constant on its right or on its left."""
        sign, end, (slope, offset) = (-1, -1, self._last) if right else (1, 0, self._first)
        while self._knots:
            position, bend, shift = self._knots[end]
            if sign * (slope * position + offset) >= 0:
                break
            slope, offset = slope + sign * bend, offset + sign * shift
            self._knots.pop() if right else self._knots.popleft()
        least = -offset / slope
        if right:
            self._knots.append((least, -slope, -offset))
            self._last = (0.0, 0.0)
        else:
            self._knots.appendleft((least, slope, offset))
            self._first = (0.0, 0.0)
        return least
