"""One search inside the bound, step by step in small arrays: no detours over rows.

It is that of `jawusd.evaluator.solver`. Towards a point, as the bound's second derivatives are known, a step takes all
of them, and only where that leads nowhere the part that is never indefinite.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.solver import (
    INSIDE_MM,
    ITERATIONS,
    LARGEST_DAMPING,
    LEAST_SLOPE,
    LEAST_STIFFNESS,
    LONGEST_STEP_MM,
    PULL,
    PULL_BACKS,
    SMALLEST_DAMPING,
    START_DAMPING,
    TOLERANCE_MM,
    TOUCHING_MM,
    Residual,
)
from jawusd.geometry.arrays import Array, Indices

_IDENTITY = np.eye(3)
_ONE_ROW: Indices = np.zeros(1, dtype=np.intp)


class Pull(NamedTuple):
    """What draws a point: a squared residual and its quadratic model.

    Attributes:
        cost: The squared residual.
        force: Half its derivative, downhill, shape (3,).
        stiffness: J^T J of the residual's derivatives J, shape (3, 3).
        scale: A third of the trace of that, which damping is relative to.
    """

    cost: float
    force: Array
    stiffness: Array
    scale: float


@dataclass(frozen=True, eq=False)
class Place:
    """The bound around a point.

    Attributes:
        distance: Signed distance [mm].
        gradient: Its derivative, shape (3,).
        weights: Share of each half-space, shape (K + 2,).
        slopes: Derivative of each half-space, shape (K + 2, 3).
        bends: Second derivatives of the supports by d1, shape (K,) [1/mm].
    """

    distance: float
    gradient: Array
    weights: Array
    slopes: Array
    bends: Array


def place(bound: SliceHull, d: Array) -> Place:
    """Return the bound around one d (3,) [mm], as `SliceHull.signed_distance_curvature` has it for rows."""
    d1, d2, d3 = d.tolist()
    curve = bound.supports
    interval = curve.knots.searchsorted(d1, side="right")
    t = d1 - float(curve.starts[interval])
    powers = np.array([(1.0, t, t * t, t * t * t), (0.0, 1.0, 2 * t, 3 * t * t), (0.0, 0.0, 2.0, 6 * t)])
    reach, rises, bends = powers @ curve.coefficients[interval]
    slopes = bound.slopes.copy()
    slopes[:-2, 0] = -rises
    v = np.empty(len(slopes))
    v[:-2] = bound.directions @ (d2, d3) - reach
    v[-2:] = bound.first_mm - d1, d1 - bound.last_mm
    peak = v.max()
    weights = np.exp((v - peak) / bound.softness_mm)
    total = weights.sum()
    weights /= total
    distance = float(peak) + bound.softness_mm * math.log(total) - bound.offset_mm
    return Place(distance, weights @ slopes, weights, slopes, bends)


def nearest_in_valley(bound: SliceHull, wanted: Array, start: Array) -> Array:
    """Return the point (3,) [mm] inside nearest to one wanted (3,), in the valley that a start inside (3,) lies in."""

    def pull(x: Array) -> Pull:
        away = wanted - x
        return Pull(_squared(away), away, _IDENTITY, 1.0)

    return _bottom(bound, pull, start, bent=True)


def least_in_valley(bound: SliceHull, residual: Residual, start: Array) -> Array:
    """Return the point (3,) [mm] inside of least squared residual, in the valley that a start inside (3,) lies in.

    Args:
        bound: The bound.
        residual: Of one row, its number 0.
        start: Where to start; NaN comes back where the residual there is.
    """

    def pull(x: Array) -> Pull:
        r, J = residual(x[None], _ONE_ROW)
        stiffness = J[0].T @ J[0]
        return Pull(_squared(r[0]), -(r[0] @ J[0]), stiffness, float(stiffness.trace()) / 3.0)

    return _bottom(bound, pull, start, bent=False)


def _bottom(bound: SliceHull, pull: Callable[[Array], Pull], start: Array, *, bent: bool) -> Array:
    """Return where the cost of a pull is least, shape (3,), in the valley that a start inside (3,) lies in.

    Args:
        bound: The bound.
        pull: The cost and its model at a point.
        start: Where to start.
        bent: Whether the model is exact, so that steps gain by all second derivatives of the bound.
    """
    if not math.isfinite(start[0]):
        return np.full(3, np.nan)
    x, at, now = start, place(bound, start), pull(start)
    if not math.isfinite(now.cost):
        return np.full(3, np.nan)
    damping, multiplier, exact = START_DAMPING, 0.0, bent
    if at.distance > -TOUCHING_MM:
        multiplier = max(float(at.gradient @ now.force) / max(_squared(at.gradient), LEAST_SLOPE), 0.0)
    for _ in range(ITERATIONS):
        step, multiplier = _step(at, now, multiplier, damping, bound.softness_mm, bent=bent)
        if not max(map(abs, step.tolist())) > TOLERANCE_MM or damping >= LARGEST_DAMPING:
            break
        trial, there = _pulled_inside(bound, x + step)
        then = pull(trial)
        if there.distance <= 0 and then.cost <= now.cost:
            x, at, now, bent, damping = trial, there, then, exact, max(0.1 * damping, SMALLEST_DAMPING)
        elif bent:
            bent = False
        else:
            damping *= 10.0
    return x


def _step(
    at: Place, now: Pull, multiplier: float, damping: float, softness_mm: float, *, bent: bool
) -> tuple[Array, float]:
    """Return the step (3,) of the quadratic model under the linearised bound, and the bound's multiplier."""
    A = now.stiffness + (damping * now.scale + LEAST_STIFFNESS) * _IDENTITY
    if multiplier > 0:
        spread = (at.slopes.T * at.weights) @ at.slopes - np.multiply.outer(at.gradient, at.gradient)
        A += (multiplier / softness_mm) * spread
    inverse = _inverse(A)
    free, inward, first = inverse @ now.force, inverse @ at.gradient, inverse[0]
    bend = multiplier * float(at.weights[:-2] @ at.bends)
    left = 1.0 - bend * float(first[0])
    if bent and left > 0:  # then A less the bend, in its first entry, is definite too (Sherman and Morrison 1950)
        free = free + (bend * float(free[0]) / left) * first
        inward = inward + (bend * float(inward[0]) / left) * first
    over, yields = at.distance + float(at.gradient @ free), float(at.gradient @ inward)
    multiplier = over / yields if over > 0 and yields > 0 else 0.0
    step = free - multiplier * inward
    return step * min(1.0, LONGEST_STEP_MM / max(math.sqrt(_squared(step)), 1e-300)), multiplier


def _inverse(A: Array) -> Array:
    """Return the inverse of a symmetric matrix (3, 3) that is definite, by cofactors: a third of the time of LAPACK."""
    (a, p, q), (_, c, s), (_, _, f) = A.tolist()
    x, y, z = c * f - s * s, q * s - p * f, p * s - q * c
    scale = 1.0 / ((a * x + p * y + q * z) or 1.0)  # a finite step even where A is singular; damping mends it
    x, y, z = x * scale, y * scale, z * scale
    v, w = (p * q - a * s) * scale, (a * c - p * p) * scale
    return np.array(((x, y, z), (y, (a * f - q * q) * scale, v), (z, v, w)))


def _pulled_inside(bound: SliceHull, x: Array) -> tuple[Array, Place]:
    """Return a point (3,) moved down the gradient until just inside, and the bound around it."""
    at = place(bound, x)
    for _ in range(PULL_BACKS):
        if at.distance <= 0:
            break
        x = x - (PULL * at.distance + INSIDE_MM) / max(_squared(at.gradient), LEAST_SLOPE) * at.gradient
        at = place(bound, x)
    return x, at


def _squared(x: Array) -> float:
    return float(x @ x)
