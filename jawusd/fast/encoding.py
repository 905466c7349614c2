"""Compiled encoding and verdicts for single poses; encoding uses damped Gauss-Newton as in `jawusd.evaluator.solver`.

Every function handles one pose. A `Problem` consists of the chart of the unknowns x [mm], homogeneous vectors (4, m),
and their targets (3, m) [mm].
"""

from __future__ import annotations

from math import isfinite, isnan, sqrt
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.batching import LARGEST
from jawusd.evaluator.formula import ON_BOUND_MM
from jawusd.evaluator.nearest import (
    ITERATIONS,
    MAX_DAMPING,
    MIN_DAMPING,
    MIN_STIFFNESS,
    START_DAMPING,
    TOLERANCE_MM,
)
from jawusd.evaluator.verdicts import RIGID_TOLERANCE, Reason
from jawusd.fast.hull import signed_distance
from jawusd.fast.kinds import (
    FROM_CLOSED,
    GRID,
    INCISOR,
    STARTS,
    TO_ANATOMICAL,
    VECTORS,
    Scratch,
    displaced,
    motion,
    motion_by_displacement,
    motion_derivative,
    parameters_at,
)
from jawusd.fast.rigid import Vector, device, solve

PARAMETERS, DISPLACEMENT = 0, 1  # charts: the unknown x is d, or the incisal displacement u

_NOT_FINITE, _NOT_RIGID = Reason.NOT_FINITE.value, Reason.NOT_RIGID.value
_OFF_MODEL, _OUTSIDE_BOUNDS = Reason.OFF_MODEL.value, Reason.OUTSIDE_BOUNDS.value


class Problem(NamedTuple):
    """A least-squares problem."""

    chart: int
    vectors: Array
    target: Array


@device
def equations(model: Array, problem: Problem, x: Array, w: Scratch, A: Array, g: Array) -> float:
    """Return the squared residual at x; write the normal matrix A (3, 3) and the gradient g (3,)."""
    A[:, :] = 0.0
    g[:] = 0.0
    cost = 0.0
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
        # under the spatial velocity (w, v), the image R b + t h of a homogeneous vector (b, h) moves by w x image + v h
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
def descend(model: Array, problem: Problem, x: Array, w: Scratch) -> None:
    """Move x (3,) to the minimum of the squared residual; set x to NaN if the residual at the start is not finite."""
    A, g, A_trial, g_trial = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    damped, step, trial = np.empty((3, 3)), np.empty(3), np.empty(3)
    cost = equations(model, problem, x, w, A, g)
    if not isfinite(cost):
        x[:] = np.nan
        return
    damping = START_DAMPING
    for _ in range(ITERATIONS):
        damped[:] = A
        for i in range(3):
            damped[i, i] += damping * ((A[0, 0] + A[1, 1] + A[2, 2]) / 3.0) + MIN_STIFFNESS
        solve(damped, g, step)
        for i in range(3):
            trial[i] = x[i] - step[i]
        settled = max(abs(step[0]), abs(step[1]), abs(step[2])) <= TOLERANCE_MM
        if settled or damping >= MAX_DAMPING:
            x[:] = trial  # the last step doubles the number of correct digits, so it needs no further evaluation
            return
        trial_cost = equations(model, problem, trial, w, A_trial, g_trial)
        if trial_cost <= cost:
            cost = trial_cost
            x[:], A[:], g[:] = trial, A_trial, g_trial
            damping = max(damping * 0.1, MIN_DAMPING)
        else:
            damping *= 10.0


@device
def encode(model: Array, T: Array, w: Scratch, x: Array) -> float:
    """Write the d [mm] whose pose is nearest to T (4, 4) to x (3,) and return the residual [mm]."""
    vectors, target = model[VECTORS : VECTORS + 16].reshape(4, 4), np.empty((3, 4))
    M = w.M
    _motion_of_pose(model, T, M)
    for i in range(3):
        for j in range(4):
            total = 0.0
            for k in range(4):
                total += M[i, k] * vectors[k, j]
            target[i, j] = total
    p0, p1, p2 = model[INCISOR], model[INCISOR + 1], model[INCISOR + 2]
    for i in range(3):
        x[i] = M[i, 0] * p0 + M[i, 1] * p1 + M[i, 2] * p2 + M[i, 3] - model[INCISOR + i]
    if model[STARTS] == 0:
        # a search over the displacement need not evaluate the gauge; the nearest pose does not depend on the chart
        descend(model, Problem(DISPLACEMENT, vectors, target), x, w)
        u = (x[0], x[1], x[2])
        displaced(model, u, w)
        x[0], x[1], x[2] = parameters_at(model, u)
        if isnan(x[0]):
            return np.nan
    else:
        _nearest_start(model, x)
        descend(model, Problem(PARAMETERS, vectors, target), x, w)
        motion(model, x[0], x[1], x[2], w)
    return _residual_mm(vectors, M, target)


@device
def _motion_of_pose(model: Array, T: Array, M: Array) -> None:
    """Write the first three rows of L^-1 T Q^-1 to M."""
    half = np.empty((4, 4))
    for i in range(4):
        for k in range(4):
            total = 0.0
            for j in range(4):
                total += T[i, j] * model[FROM_CLOSED + 4 * j + k]
            half[i, k] = total
    for i in range(3):
        for k in range(4):
            total = 0.0
            for j in range(4):
                total += model[TO_ANATOMICAL + 4 * i + j] * half[j, k]
            M[i, k] = total


@device
def _nearest_start(model: Array, x: Array) -> None:
    """Replace the incisal displacement x by the d of the grid point with the nearest displacement."""
    count = int(model[STARTS])
    d = model[int(model[GRID]) :]
    at = d[3 * count :]
    best, least = 0, np.inf
    for i in range(count):
        a, b, c = at[3 * i] - x[0], at[3 * i + 1] - x[1], at[3 * i + 2] - x[2]
        square = a * a + b * b + c * c
        if square < least:
            best, least = i, square
    for i in range(3):
        x[i] = d[3 * best + i]


@device
def _residual_mm(vectors: Array, M: Array, target: Array) -> float:
    """Return the distance [mm] between the vectors, moved by a motion M (3, 4), and their targets."""
    total = 0.0
    for i in range(3):
        for j in range(4):
            image = M[i, 3] * vectors[3, j]
            for k in range(3):
                image += M[i, k] * vectors[k, j]
            total += (image - target[i, j]) ** 2
    return sqrt(total)


@device
def _finite(T: Array) -> bool:
    """Return whether all entries of T (4, 4) are finite and below `LARGEST`."""
    for i in range(4):
        for k in range(4):
            if not abs(T[i, k]) < LARGEST:  # also false for NaN
                return False
    return True


@device
def _rigid(T: Array) -> bool:
    """Return whether T (4, 4) is rigid to the evaluator's tolerance; see `geometry.rigidity_defect`."""
    defect = max(abs(T[3, 0]), abs(T[3, 1]), abs(T[3, 2]), abs(T[3, 3] - 1.0))
    for i in range(3):
        for k in range(i, 3):
            total = T[i, 0] * T[k, 0] + T[i, 1] * T[k, 1] + T[i, 2] * T[k, 2] - (1.0 if i == k else 0.0)
            defect = max(defect, abs(total))
    x = T[1, 1] * T[2, 2] - T[1, 2] * T[2, 1]
    y = T[1, 2] * T[2, 0] - T[1, 0] * T[2, 2]
    z = T[1, 0] * T[2, 1] - T[1, 1] * T[2, 0]
    return defect <= RIGID_TOLERANCE and T[0, 0] * x + T[0, 1] * y + T[0, 2] * z >= 0.0


@device
def judge(
    model: Array,
    bound: Array,
    T: Array,
    judging: bool,
    residual_limit: float,
    margin_limit: float,
    w: Scratch,
    x: Array,
    v: Array,
) -> tuple[int, float, float]:
    """Return reason, residual [mm] and margin [mm] of a pose T (4, 4), as in `evaluator.verdicts`; write d to x.

    If `judging` is false, only d and the residual are computed, and the reason is 0 for every rigid pose.
    """
    x[:] = np.nan
    if not _finite(T):
        return _NOT_FINITE, np.nan, np.nan
    if not _rigid(T):
        return _NOT_RIGID, np.nan, np.nan
    residual = encode(model, T, w, x)
    if not judging:
        return 0, residual, np.nan
    out, _, _ = signed_distance(bound, x[0], x[1], x[2], v)
    reason = 0 if residual <= residual_limit else _OFF_MODEL
    if -out < margin_limit - ON_BOUND_MM or isnan(out):
        reason |= _OUTSIDE_BOUNDS
    return reason, residual, -out
