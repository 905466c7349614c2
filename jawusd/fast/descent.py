"""Compiled: the damped Gauss-Newton of `jawusd.evaluator.solver` for one row, free or inside the bound.

A problem is a named tuple `Problem`: which chart the unknowns x [mm] are of, the homogeneous vectors (4, m) and where
they should go, (3, m) [mm]. In the chart POINT the vectors are not used and the wanted point is the first column.
"""

from __future__ import annotations

from math import isfinite, sqrt
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.nearest import (
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
)
from jawusd.fast.hull import signed_distance_curvature, signed_distance_gradient
from jawusd.fast.motion import Scratch, motion_by_displacement, motion_derivative
from jawusd.fast.packing import SIDES
from jawusd.fast.rigid import Vector, device, solve

PARAMETERS, DISPLACEMENT, POINT = 0, 1, 2  # charts: x is d, the incisal displacement u, or d compared as it is


class Problem(NamedTuple):
    """A problem, see above."""

    chart: int
    vectors: Array
    target: Array


class Normal(NamedTuple):
    """The memory of one search for its equations."""

    A: Array
    g: Array
    A_trial: Array
    g_trial: Array
    damped: Array
    step: Array
    inward: Array
    trial: Array


class Edge(NamedTuple):
    """The memory of one search for the bound."""

    v: Array
    gradient: Array
    curvature: Array


@device
def normal_scratch() -> Normal:
    """Return the memory of one search for its equations."""
    return Normal(
        np.empty((3, 3)),
        np.empty(3),
        np.empty((3, 3)),
        np.empty(3),
        np.empty((3, 3)),
        np.empty(3),
        np.empty(3),
        np.empty(3),
    )


@device
def edge_scratch(bound: Array) -> Edge:
    """Return the memory of one search for the bound."""
    return Edge(np.empty(int(bound[SIDES])), np.empty(3), np.empty((3, 3)))


@device
def equations(model: Array, problem: Problem, x: Array, w: Scratch, A: Array, g: Array) -> float:
    """Return the squared residual at x; write the normal equations' A (3, 3) and gradient g (3,)."""
    A[:, :] = 0.0
    g[:] = 0.0
    cost = 0.0
    if problem.chart == POINT:
        for i in range(3):
            A[i, i] = 1.0
            g[i] = x[i] - problem.target[i, 0]
            cost += g[i] * g[i]
        return cost
    if problem.chart == DISPLACEMENT:
        motion_by_displacement(model, x[0], x[1], x[2], w)
    else:
        motion_derivative(model, x[0], x[1], x[2], w)
    M, S = w.M, w.S
    for j in range(problem.target.shape[1]):
        p0, p1, p2 = problem.vectors[0, j], problem.vectors[1, j], problem.vectors[2, j]
        h = problem.vectors[3, j]
        y0 = M[0, 0] * p0 + M[0, 1] * p1 + M[0, 2] * p2 + M[0, 3] * h
        y1 = M[1, 0] * p0 + M[1, 1] * p1 + M[1, 2] * p2 + M[1, 3] * h
        y2 = M[2, 0] * p0 + M[2, 1] * p1 + M[2, 2] * p2 + M[2, 3] * h
        r0, r1, r2 = y0 - problem.target[0, j], y1 - problem.target[1, j], y2 - problem.target[2, j]
        cost += r0 * r0 + r1 * r1 + r2 * r2
        # a vector (b, h) moves by w x image + v h under the spatial velocity (w, v)
        a0, b0, c0 = _velocity(S, 0, y0, y1, y2, h)
        a1, b1, c1 = _velocity(S, 1, y0, y1, y2, h)
        a2, b2, c2 = _velocity(S, 2, y0, y1, y2, h)
        g[0] += a0 * r0 + b0 * r1 + c0 * r2
        g[1] += a1 * r0 + b1 * r1 + c1 * r2
        g[2] += a2 * r0 + b2 * r1 + c2 * r2
        A[0, 0] += a0 * a0 + b0 * b0 + c0 * c0
        A[0, 1] += a0 * a1 + b0 * b1 + c0 * c1
        A[0, 2] += a0 * a2 + b0 * b2 + c0 * c2
        A[1, 1] += a1 * a1 + b1 * b1 + c1 * c1
        A[1, 2] += a1 * a2 + b1 * b2 + c1 * c2
        A[2, 2] += a2 * a2 + b2 * b2 + c2 * c2
    A[1, 0], A[2, 0], A[2, 1] = A[0, 1], A[0, 2], A[1, 2]
    return cost


@device
def _velocity(S: Array, k: int, y0: float, y1: float, y2: float, h: float) -> Vector:
    w0, w1, w2 = S[0, k], S[1, k], S[2, k]
    return w1 * y2 - w2 * y1 + h * S[3, k], w2 * y0 - w0 * y2 + h * S[4, k], w0 * y1 - w1 * y0 + h * S[5, k]


@device
def descend(model: Array, problem: Problem, x: Array, w: Scratch, n: Normal) -> None:
    """Move x (3,) to the bottom; NaN if the residual is not finite there."""
    cost = equations(model, problem, x, w, n.A, n.g)
    if not isfinite(cost):
        x[:] = np.nan
        return
    damping = START_DAMPING
    for _ in range(ITERATIONS):
        _damp(n.A, damping, n.damped)
        solve(n.damped, n.g, n.step)
        for i in range(3):
            n.trial[i] = x[i] - n.step[i]
        if _settled(n.step) or damping >= LARGEST_DAMPING:
            x[:] = n.trial  # the last step costs nothing and doubles the digits
            return
        trial_cost = equations(model, problem, n.trial, w, n.A_trial, n.g_trial)
        if trial_cost <= cost:
            cost = trial_cost
            x[:], n.A[:], n.g[:] = n.trial, n.A_trial, n.g_trial
            damping = max(damping * 0.1, SMALLEST_DAMPING)
        else:
            damping *= 10.0


@device
def descend_inside(model: Array, bound: Array, problem: Problem, x: Array, w: Scratch, n: Normal, edge: Edge) -> float:
    """Move x (3,), inside the bound, to the bottom of its valley inside; return the squared residual there."""
    cost = equations(model, problem, x, w, n.A, n.g)
    if not isfinite(cost):
        x[:] = np.nan
        return np.nan
    damping = START_DAMPING
    multiplier = _first_multiplier(bound, x, n.g, edge)
    for _ in range(ITERATIONS):
        multiplier = _bounded_step(bound, x, damping, multiplier, n, edge)
        if _settled(n.step) or damping >= LARGEST_DAMPING:
            return cost
        for i in range(3):
            n.trial[i] = x[i] + n.step[i]
        inside = _pulled_back(bound, n.trial, edge)
        trial_cost = equations(model, problem, n.trial, w, n.A_trial, n.g_trial)
        if trial_cost <= cost and inside:
            cost = trial_cost
            x[:], n.A[:], n.g[:] = n.trial, n.A_trial, n.g_trial
            damping = max(damping * 0.1, SMALLEST_DAMPING)
        else:
            damping *= 10.0
    return cost


@device
def _settled(step: Array) -> bool:
    return max(abs(step[0]), abs(step[1]), abs(step[2])) <= TOLERANCE_MM


@device
def _damp(A: Array, damping: float, out: Array) -> None:
    amount = damping * ((A[0, 0] + A[1, 1] + A[2, 2]) / 3.0) + LEAST_STIFFNESS
    out[:] = A
    for i in range(3):
        out[i, i] += amount


@device
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@device
def _first_multiplier(bound: Array, x: Array, g: Array, edge: Edge) -> float:
    found = signed_distance_gradient(bound, x[0], x[1], x[2], edge.v, edge.gradient)
    press = -_dot(edge.gradient, g) / max(_dot(edge.gradient, edge.gradient), LEAST_SLOPE)
    return max(press, 0.0) if found > -TOUCHING_MM else 0.0


@device
def _bounded_step(bound: Array, x: Array, damping: float, multiplier: float, n: Normal, edge: Edge) -> float:
    """Write the step of the quadratic model under the linearised bound; return the bound's multiplier."""
    found = signed_distance_curvature(bound, x[0], x[1], x[2], edge.v, edge.gradient, edge.curvature)
    for i in range(3):
        for k in range(3):
            n.A_trial[i, k] = n.A[i, k] + multiplier * edge.curvature[i, k]
    _damp(n.A_trial, damping, n.damped)
    solve(n.damped, n.g, n.step)
    solve(n.damped, edge.gradient, n.inward)
    over = found - _dot(edge.gradient, n.step)
    multiplier = max(over, 0.0) / _dot(edge.gradient, n.inward)
    for i in range(3):
        n.step[i] = -n.step[i] - multiplier * n.inward[i]
    shrink = min(1.0, LONGEST_STEP_MM / max(sqrt(_dot(n.step, n.step)), 1e-300))
    for i in range(3):
        n.step[i] *= shrink
    return multiplier


@device
def _pulled_back(bound: Array, x: Array, edge: Edge) -> bool:
    """Move x (3,) down the gradient until just inside; tell whether it got there."""
    for _ in range(PULL_BACKS):
        found = signed_distance_gradient(bound, x[0], x[1], x[2], edge.v, edge.gradient)
        if not found > 0.0:
            return True
        pull = (PULL * found + INSIDE_MM) / max(_dot(edge.gradient, edge.gradient), LEAST_SLOPE)
        for i in range(3):
            x[i] -= pull * edge.gradient[i]
    return False
