"""Ranges of the parameters at an opening, and parameters as shares of their ranges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.bounds import SliceHull

# A range shorter than this counts as this long, which keeps normalising invertible where a section closes.
SMALLEST_REACH_MM = 0.5


class Ranges(NamedTuple):
    """How far d2 and d3 can each go alone [mm], each of shape (...); NaN where they cannot."""

    d2_min: Array
    d2_max: Array
    d3_min: Array
    d3_max: Array


def normalized(bound: SliceHull, d_range: Array, d: Array) -> Array:
    """Return d (n, 3) [mm] as shares of the full opening and of the reach to its side at that opening."""
    return d / _scale(bound, d_range, d[:, 0], d)


def denormalized(bound: SliceHull, d_range: Array, shares: Array) -> Array:
    """Return the d (n, 3) [mm] of shares (n, 3), the inverse of `normalized`."""
    return shares * _scale(bound, d_range, shares[:, 0] * d_range[0, 1], shares)


def _scale(bound: SliceHull, d_range: Array, d1: Array, sides: Array) -> Array:
    """Return what one unit means [mm], shape (n, 3), by opening d1 (n,) and by the signs of ``sides`` (n, 3)."""
    knots = bound.supports.knots
    on_path = np.zeros((len(d1), 3))
    on_path[:, 0] = np.clip(d1, knots[0], knots[-1])
    scale = np.full((len(d1), 3), d_range[0, 1])
    for axis in (1, 2):
        low, high = bound.chord(on_path, axis)
        reach = np.where(sides[:, axis] < 0, -low, high)
        scale[:, axis] = np.where(reach > SMALLEST_REACH_MM, reach, SMALLEST_REACH_MM)
    scale[np.isnan(d1)] = np.nan
    return scale
