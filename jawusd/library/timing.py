"""Keep the timing of a curve that is carried to another person: it rises and falls where its original does.

What a share of a range amounts to changes with the opening, so that a curve carried share by share may peak frames
before or after the original. The curve kept is the nearest to it, in least squares, among those that move the same way
as the original between any two samples: isotonic regression (Barlow et al. 1972) whose direction changes with the sign
of the original's steps. It is solved exactly by passing along the samples the cost of all samples so far as a function
of the value of the last one; the derivative of that cost is piecewise linear and rising, and each step cuts off one end
of it, as in R. Tibshirani, H. Hoefling, R. Tibshirani, Nearly-Isotonic Regression, Technometrics 53 (2011).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from jawusd.base.arrays import Array, Mask

STILL_MM = 1e-6  # a smaller step of the original has no direction


def follow(original: Array, carried: Array, least: float) -> Array:
    """Return the curve [mm] (F,) nearest to a carried one that rises and falls where the original (F,) does.

    Args:
        least: smallest step of the result for a step of 1 mm of the original, > 0: keeps peaks from becoming plateaus.
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
    """Return the values z (n,) nearest to wanted ones (n,): z[i + 1] >= z[i] where ``rising`` (n - 1,), else <=."""
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
    """The derivative of a convex, piecewise quadratic cost: lines, and bends between them.

    Lines are (slope, offset); a bend is its place and how much slope and offset change there, from left to right.
    """

    def __init__(self) -> None:
        self._first, self._last = (0.0, 0.0), (0.0, 0.0)
        self._bends: deque[tuple[float, float, float]] = deque()

    def add(self, wanted: float) -> None:
        """Add half the squared distance to a value."""
        self._first = (self._first[0] + 1.0, self._first[1] - wanted)
        self._last = (self._last[0] + 1.0, self._last[1] - wanted)

    def cut(self, right: bool) -> float:
        """Return where the cost is least, and make it constant from there to the right, or to the left."""
        sign, end, (slope, offset) = (-1, -1, self._last) if right else (1, 0, self._first)
        while self._bends:
            place, bend, shift = self._bends[end]
            if sign * (slope * place + offset) >= 0:
                break
            slope, offset = slope + sign * bend, offset + sign * shift
            self._bends.pop() if right else self._bends.popleft()
        least = -offset / slope
        if right:
            self._bends.append((least, -slope, -offset))
            self._last = (0.0, 0.0)
        else:
            self._bends.appendleft((least, slope, offset))
            self._first = (0.0, 0.0)
        return least
