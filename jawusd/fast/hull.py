"""Compiled: the slice hull of `jawusd.evaluator.bounds`, for one row.

`bound` is what `packing.packed_bound` returns, `v` scratch of at least as many numbers as the hull has sides.
"""

from __future__ import annotations

from math import exp, log

from jawusd.base.arrays import Array
from jawusd.fast.packing import HULL, MARGIN, ROUNDING, SIDES
from jawusd.fast.rigid import Vector, device, interval

_NEGLIGIBLE = 45.0  # exp(-45) = 3e-20: shares below it change nothing


@device
def _support_piece(bound: Array, d1: float) -> tuple[Array, float, float, float]:
    """Return the curve's piece at d1: its coefficients (4 k,), the distance from its start [mm], both end knots."""
    sides = int(bound[SIDES])
    curve = bound[HULL + 2 * sides :]
    count = int(curve[0])
    i = interval(curve[1:], count, d1)
    first, last = curve[1], curve[count]
    return curve[2 + 2 * count + 4 * sides * i :], d1 - curve[1 + count + i], first, last


@device
def signed_distance(bound: Array, d1: float, d2: float, d3: float, v: Array) -> Vector:
    """Return how far outside d lies [mm]; leave the shares of the half-planes in v and return those of both ends."""
    sides, rounding = int(bound[SIDES]), bound[ROUNDING]
    c, s, first, last = _support_piece(bound, d1)
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
        v[k] = _share((v[k] - peak) / rounding)
        total += v[k]
    low, high = _share((low - peak) / rounding), _share((high - peak) / rounding)
    total += low + high
    for k in range(sides):
        v[k] /= total
    return peak + rounding * log(total) - bound[MARGIN], low / total, high / total


@device
def _share(x: float) -> float:
    return exp(x) if x > -_NEGLIGIBLE else 0.0


@device
def signed_distance_gradient(bound: Array, d1: float, d2: float, d3: float, v: Array, gradient: Array) -> float:
    """Return the signed distance [mm]; write its gradient (3,)."""
    out, low, high = signed_distance(bound, d1, d2, d3, v)
    _weigh(bound, d1, low, high, v, gradient)
    return out


@device
def _weigh(bound: Array, d1: float, low: float, high: float, v: Array, gradient: Array) -> None:
    """Write the gradient (3,): the normals of the half-spaces weighted by their shares."""
    sides = int(bound[SIDES])
    c, s, _, _ = _support_piece(bound, d1)
    n2, n3 = bound[HULL:], bound[HULL + sides :]
    g1, g2, g3 = high - low, 0.0, 0.0
    for k in range(sides):
        if v[k] > 0.0:
            g1 -= v[k] * ((3 * c[3 * sides + k] * s + 2 * c[2 * sides + k]) * s + c[sides + k])
            g2 += v[k] * n2[k]
            g3 += v[k] * n3[k]
    gradient[0], gradient[1], gradient[2] = g1, g2, g3


@device
def signed_distance_curvature(
    bound: Array, d1: float, d2: float, d3: float, v: Array, gradient: Array, curvature: Array
) -> float:
    """Return the signed distance [mm]; write its gradient (3,) and the rounding's part of its Hessian (3, 3) [1/mm]."""
    out, low, high = signed_distance(bound, d1, d2, d3, v)
    _weigh(bound, d1, low, high, v, gradient)
    sides = int(bound[SIDES])
    c, s, _, _ = _support_piece(bound, d1)
    n2, n3 = bound[HULL:], bound[HULL + sides :]
    curvature[:, :] = 0.0
    for k in range(sides):
        if v[k] > 0.0:
            slope = (3 * c[3 * sides + k] * s + 2 * c[2 * sides + k]) * s + c[sides + k]
            _spread(v[k], -slope - gradient[0], n2[k] - gradient[1], n3[k] - gradient[2], curvature)
    _spread(low, -1.0 - gradient[0], -gradient[1], -gradient[2], curvature)
    _spread(high, 1.0 - gradient[0], -gradient[1], -gradient[2], curvature)
    curvature /= bound[ROUNDING]
    return out


@device
def _spread(share: float, a: float, b: float, c: float, curvature: Array) -> None:
    curvature[0, 0] += share * a * a
    curvature[0, 1] += share * a * b
    curvature[0, 2] += share * a * c
    curvature[1, 1] += share * b * b
    curvature[1, 2] += share * b * c
    curvature[2, 2] += share * c * c
    curvature[1, 0], curvature[2, 0], curvature[2, 1] = curvature[0, 1], curvature[0, 2], curvature[1, 2]
