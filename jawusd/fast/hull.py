"""Compiled slice hull of `jawusd.evaluator.bounds`, for a single row of a batch.

`bound` is the array from `packed_bound`, `v` the scratch memory from `hull_scratch`.
"""

from __future__ import annotations

from math import exp, log

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.bounds import SliceHull
from jawusd.fast.kinds import curve_parts, joined
from jawusd.fast.rigid import Vector, device, interval

# offsets of the fields in a packed bound
ROUNDING = 0  # `SliceHull.softness_mm`
MARGIN = 1  # `SliceHull.offset_mm`
SIDES = 2  # number k of half-planes
HULL = 3  # normals of the half-planes, column-major (2, k), then the curve of the supports

# Exponent, relative to the largest, below which a term is skipped: exp(-45) = 3e-20 is below rounding.
_NEGLIGIBLE = 45.0


def packed_bound(bound: SliceHull) -> Array:
    """Return a packed bound."""
    head = [np.array([bound.softness_mm, bound.offset_mm, len(bound.directions)]), bound.directions.T]
    return joined([*head, curve_parts(bound.supports)])


@device
def hull_scratch(bound: Array) -> Array:
    """Allocate the scratch memory of one call: one number per half-plane."""
    return np.empty(int(bound[SIDES]))


@device
def _support_segment(bound: Array, d1: float) -> tuple[Array, float, float, float]:
    """Return the curve segment at d1: coefficients (4 k,), distance from its start [mm], first and last knot."""
    sides = int(bound[SIDES])
    curve = bound[HULL + 2 * sides :]
    count = int(curve[0])
    i = interval(curve[1:], count, d1)
    first, last = curve[1], curve[count]
    return curve[2 + 2 * count + 4 * sides * i :], d1 - curve[1 + count + i], first, last


@device
def signed_distance(bound: Array, d1: float, d2: float, d3: float, v: Array) -> Vector:
    """Return the signed distance of d [mm] and the weights of both ends; write the weights of the half-planes to v."""
    sides, rounding = int(bound[SIDES]), bound[ROUNDING]
    c, s, first, last = _support_segment(bound, d1)
    n2, n3 = bound[HULL:], bound[HULL + sides :]
    low, high = first - d1, d1 - last
    for k in range(sides):
        reach = ((c[3 * sides + k] * s + c[2 * sides + k]) * s + c[sides + k]) * s + c[k]
        v[k] = d2 * n2[k] + d3 * n3[k] - reach
    peak = max(low, high)
    for k in range(sides):
        peak = max(peak, v[k])
    total = 0.0
    for k in range(sides):
        v[k] = _weight((v[k] - peak) / rounding)
        total += v[k]
    low, high = _weight((low - peak) / rounding), _weight((high - peak) / rounding)
    total += low + high
    for k in range(sides):
        v[k] /= total
    return peak + rounding * log(total) - bound[MARGIN], low / total, high / total


@device
def _weight(x: float) -> float:
    return exp(x) if x > -_NEGLIGIBLE else 0.0


@device
def signed_distance_gradient(bound: Array, d1: float, d2: float, d3: float, v: Array, gradient: Array) -> float:
    """Return the signed distance [mm]; write its gradient (3,), the weighted normals of the half-spaces."""
    out, low, high = signed_distance(bound, d1, d2, d3, v)
    sides = int(bound[SIDES])
    c, s, _, _ = _support_segment(bound, d1)
    n2, n3 = bound[HULL:], bound[HULL + sides :]
    g1, g2, g3 = high - low, 0.0, 0.0
    for k in range(sides):
        if v[k] > 0.0:
            g1 -= v[k] * ((3 * c[3 * sides + k] * s + 2 * c[2 * sides + k]) * s + c[sides + k])
            g2 += v[k] * n2[k]
            g3 += v[k] * n3[k]
    gradient[0], gradient[1], gradient[2] = g1, g2, g3
    return out
