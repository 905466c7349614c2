"""The search of `jawusd.evaluator.solver` for one problem in floats: faster, and part of the single-file reader.

This file imports only the standard library, `formula` and `operations`: it is copied into the reader, which runs in
Python 3.9. Symmetric matrices are six numbers: xx, xy, xz, yy, yz, zz.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from jawusd.evaluator.formula import BoundFormula, curve_derivatives
from jawusd.evaluator.operations import FloatOperations, triple
from jawusd.geometry.rodrigues import Triple, dot

ITERATIONS = 80
TOLERANCE_MM = 1e-6
START_DAMPING = 1e-6
MAX_DAMPING = 1e8
MIN_DAMPING = 1e-9
INSIDE_MM = 1e-10  # Depth inside the bound of points that are moved back to its surface.
MAX_STEP_MM = 1.0  # Maximum step length within a bound; a longer step may end in another basin.
PULL_BACKS = 12  # maximum number of iterations that move a point back onto the surface
# overshoot factor of the iterations that move a point back onto the surface, so that one iteration suffices
PULL = 1.01
MIN_STIFFNESS = 1e-12  # minimum stiffness; keeps steps finite where the cost does not depend on a parameter
# minimum squared gradient of the bound; keeps steps back onto the surface finite where the bound is flat
MIN_SLOPE = 1e-6
TOUCHING_MM = 1e-3  # maximum depth [mm] at which a start counts as lying on the bound

Vector = Triple[float]
Symmetric = tuple[float, float, float, float, float, float]

_IDENTITY: Symmetric = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
_UNKNOWN: Vector = (math.nan, math.nan, math.nan)
_FLOATS = FloatOperations()


class Pull(NamedTuple):
    """A squared residual and its quadratic model."""

    cost: float  # the squared residual
    force: Vector  # half the negative gradient of the cost
    stiffness: Symmetric  # J^T J, with J the Jacobian of the residual
    scale: float  # a third of the trace of J^T J; damping is relative to it


class Place(NamedTuple):
    """The bound to second order at a point: signed distance [mm], its gradient, and its Hessian [1/mm] in two parts."""

    distance: float  # signed distance [mm], negative inside
    gradient: Vector  # its derivative
    rounding: Symmetric  # the part of the Hessian that comes from the rounding, positive semidefinite
    bend: float  # the curvature of the supports along d1, to be subtracted from the Hessian's first entry


def place(bound: BoundFormula, d: Vector) -> Place:
    """Return the bound to second order at d [mm]."""
    d1, d2, d3 = d
    first_mm, last_mm, softness_mm, offset_mm = bound.numbers
    reach, rises, bends = curve_derivatives("support", d1, bound.tables, _FLOATS)
    sides = [
        (d2 * x + d3 * y - h, -rise, x, y, bend)
        for (x, y), h, rise, bend in zip(bound.tables["directions"], reach, rises, bends)
    ]
    sides += [(first_mm - d1, -1.0, 0.0, 0.0, 0.0), (d1 - last_mm, 1.0, 0.0, 0.0, 0.0)]
    peak = max(side[0] for side in sides)
    total = gx = gy = gz = xx = xy = xz = yy = yz = zz = bend_sum = 0.0
    for v, x, y, z, bend in sides:
        weight = math.exp((v - peak) / softness_mm)
        wx, wy, wz = weight * x, weight * y, weight * z
        total, gx, gy, gz, bend_sum = total + weight, gx + wx, gy + wy, gz + wz, bend_sum + weight * bend
        xx, xy, xz, yy, yz, zz = xx + wx * x, xy + wx * y, xz + wx * z, yy + wy * y, yz + wy * z, zz + wz * z
    g = gx, gy, gz = gx / total, gy / total, gz / total
    squares = zip((xx, xy, xz, yy, yz, zz), (gx * gx, gx * gy, gx * gz, gy * gy, gy * gz, gz * gz))
    xx, xy, xz, yy, yz, zz = ((moment / total - square) / softness_mm for moment, square in squares)
    distance = peak + softness_mm * math.log(total) - offset_mm
    return Place(distance, g, (xx, xy, xz, yy, yz, zz), bend_sum / total)


def nearest_in_valley(bound: BoundFormula, wanted: Vector, start: Vector) -> Vector:
    """Return the valid point [mm] nearest to ``wanted``, in the basin of a valid start."""

    def pull(x: Vector) -> Pull:
        away = (wanted[0] - x[0], wanted[1] - x[1], wanted[2] - x[2])
        return Pull(dot(away, away), away, _IDENTITY, 1.0)

    return lowest_in_valley(bound, pull, start, exact=True)


def lowest_in_valley(
    bound: BoundFormula, pull: Callable[[Vector], Pull], start: Vector, *, exact: bool = False
) -> Vector:
    """Return the minimiser of a cost inside the bound, in the basin of a valid start [mm]; NaN for NaN.

    `pull` returns the cost and its quadratic model at a point. If the model is `exact`, steps first use the full
    Hessian of the bound and, if that fails, only its positive semidefinite part.
    """
    if not math.isfinite(sum(start)):
        return _UNKNOWN
    x, at, now = start, place(bound, start), pull(start)
    if not math.isfinite(now.cost):
        return _UNKNOWN
    damping, multiplier, bent = START_DAMPING, 0.0, exact
    if at.distance > -TOUCHING_MM:
        multiplier = max(dot(at.gradient, now.force) / max(dot(at.gradient, at.gradient), MIN_SLOPE), 0.0)
    for _ in range(ITERATIONS):
        step, multiplier = _step(at, now, multiplier, damping, bent=bent)
        if not max(map(abs, step)) > TOLERANCE_MM or damping >= MAX_DAMPING:
            break
        trial, there = pulled_in(bound, _moved(x, 1.0, step))
        then = pull(trial)
        if there.distance <= 0 and then.cost <= now.cost:
            x, at, now, bent, damping = trial, there, then, exact, max(0.1 * damping, MIN_DAMPING)
        elif bent:
            bent = False
        else:
            damping *= 10.0
    return x


def pulled_in(bound: BoundFormula, x: Vector, *, opening: float = 1.0) -> tuple[Vector, Place]:
    """Return a point [mm] moved along the gradient until just inside, and the bound to second order there.

    `opening` is a factor on the d1 component of the gradient; with 0 the point keeps its opening.
    """
    at = place(bound, x)
    for _ in range(PULL_BACKS):
        if at.distance <= 0:
            break
        slope = (opening * at.gradient[0], at.gradient[1], at.gradient[2])
        x = _moved(x, -(PULL * at.distance + INSIDE_MM) / max(dot(slope, slope), MIN_SLOPE), slope)
        at = place(bound, x)
    return x, at


def _step(at: Place, now: Pull, multiplier: float, damping: float, *, bent: bool) -> tuple[Vector, float]:
    """Return the step of the quadratic model under the linearised bound, and the bound's multiplier."""
    ease = damping * now.scale + MIN_STIFFNESS
    a, p, q, c, s, f = (k + multiplier * r for k, r in zip(now.stiffness, at.rounding))
    rows = _inverse((a + ease, p, q, c + ease, s, f + ease))
    free, inward = (triple([dot(row, v) for row in rows]) for v in (now.force, at.gradient))
    first = rows[0]
    bend = multiplier * at.bend
    left = 1.0 - bend * first[0]
    if bent and left > 0:  # A minus the bend in its first entry is still positive definite (Sherman and Morrison 1950)
        free = _moved(free, bend * free[0] / left, first)
        inward = _moved(inward, bend * inward[0] / left, first)
    over, yields = at.distance + dot(at.gradient, free), dot(at.gradient, inward)
    multiplier = over / yields if over > 0 and yields > 0 else 0.0
    step = _moved(free, -multiplier, inward)
    shorter = min(1.0, MAX_STEP_MM / max(math.sqrt(dot(step, step)), 1e-300))
    return (step[0] * shorter, step[1] * shorter, step[2] * shorter), multiplier


def _inverse(matrix: Symmetric) -> tuple[Vector, Vector, Vector]:
    """Return the rows of the inverse of a definite symmetric matrix, by cofactors."""
    a, p, q, c, s, f = matrix
    x, y, z = c * f - s * s, q * s - p * f, p * s - q * c
    # keeps the result finite for a singular matrix; if the step is then wrong, damping is increased
    scale = 1.0 / ((a * x + p * y + q * z) or 1.0)
    x, y, z = x * scale, y * scale, z * scale
    v, w = (p * q - a * s) * scale, (a * c - p * p) * scale
    return (x, y, z), (y, (a * f - q * q) * scale, v), (z, v, w)


def _moved(x: Vector, share: float, along: Vector) -> Vector:
    return x[0] + share * along[0], x[1] + share * along[1], x[2] + share * along[2]
