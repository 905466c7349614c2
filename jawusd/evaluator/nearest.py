"""The nearest point inside the bound to one point, step by step in small arrays: no detours over rows.

The search is that of `jawusd.evaluator.solver` for the distance itself. As the bound's second derivatives are known, a
step takes all of them, and only where that leads nowhere the part that is never indefinite.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.solver import (
    INSIDE_MM,
    ITERATIONS,
    LARGEST_DAMPING,
    LEAST_SLOPE,
    LONGEST_STEP_MM,
    PULL,
    PULL_BACKS,
    SMALLEST_DAMPING,
    START_DAMPING,
    TOLERANCE_MM,
    TOUCHING_MM,
)
from jawusd.geometry.arrays import Array

_IDENTITY = np.eye(3)


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
    x, at, cost = start, place(bound, start), _squared(start - wanted)
    damping, bent = START_DAMPING, True
    multiplier = 0.0
    if at.distance > -TOUCHING_MM:
        multiplier = max(float(at.gradient @ (wanted - x)) / max(_squared(at.gradient), LEAST_SLOPE), 0.0)
    for _ in range(ITERATIONS):
        step, multiplier = _step(at, wanted - x, multiplier, damping, bound.softness_mm, bent=bent)
        if not max(map(abs, step.tolist())) > TOLERANCE_MM or damping >= LARGEST_DAMPING:
            break
        trial, there = _pulled_inside(bound, x + step)
        nearer = _squared(trial - wanted)
        if there.distance <= 0 and nearer <= cost:
            x, at, cost, bent, damping = trial, there, nearer, True, max(0.1 * damping, SMALLEST_DAMPING)
        elif bent:
            bent = False
        else:
            damping *= 10.0
    return x


def _step(
    at: Place, away: Array, multiplier: float, damping: float, softness_mm: float, *, bent: bool
) -> tuple[Array, float]:
    """Return the step (3,) of the quadratic model under the linearised bound, and the bound's multiplier."""
    spread = (at.slopes.T * at.weights) @ at.slopes - np.multiply.outer(at.gradient, at.gradient)
    A = (1.0 + damping) * _IDENTITY + (multiplier / softness_mm) * spread
    free, inward, first = np.linalg.solve(A, np.array([away, at.gradient, _IDENTITY[0]]).T).T
    bend = multiplier * float(at.weights[:-2] @ at.bends)
    left = 1.0 - bend * float(first[0])
    if bent and left > 0:  # then A less the bend, in its first entry, is definite too (Sherman and Morrison 1950)
        free = free + (bend * float(free[0]) / left) * first
        inward = inward + (bend * float(inward[0]) / left) * first
    multiplier = max(at.distance + float(at.gradient @ free), 0.0) / float(at.gradient @ inward)
    step = free - multiplier * inward
    return step * min(1.0, LONGEST_STEP_MM / max(math.sqrt(_squared(step)), 1e-300)), multiplier


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
