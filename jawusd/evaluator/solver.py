"""Damped Gauss-Newton over many small problems at once, unconstrained or inside a bound.

Each row is a problem in three unknowns [mm] with its own damping (Levenberg 1944, Marquardt 1963). Within a bound every
iterate is feasible: the step solves the quadratic model under the linearised bound in closed form, is moved back onto
the surface of the bound, and is accepted only if the cost does not increase.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.evaluator import nearest
from jawusd.evaluator.bounds import SliceHull

# (x (k, 3), row indices (k,)) -> residuals (k, m) and their derivatives with respect to x (k, m, 3)
Residual = Callable[[Array, Indices], tuple[Array, Array]]

_IDENTITY = np.eye(3)


def minimise(residual: Residual, start: Array, bound: SliceHull | None = None) -> Array:
    """Return points (n, 3) [mm] that minimise half the squared residual of every row; NaN for a NaN start or residual.

    `start` (n, 3) [mm] must lie inside the bound, if there is one, and points stay inside it.
    """
    x = start.copy()
    cost = np.full(len(x), np.nan)
    rows: Indices = np.flatnonzero(np.isfinite(x).all(axis=1))
    r, J = residual(x[rows], rows)
    cost[rows] = np.einsum("nm,nm->n", r, r)
    measured = np.isfinite(cost[rows])
    x[rows[~measured]] = np.nan
    rows = rows[measured]
    r, J = _picked(measured, r, J)
    damping = np.full(len(rows), nearest.START_DAMPING)
    multiplier = np.zeros(len(rows)) if bound is None else _first_multiplier(bound, x[rows], r, J)
    for _ in range(nearest.ITERATIONS):
        if bound is None:
            step = -solve_symmetric(_damped(np.swapaxes(J, 1, 2) @ J, damping), _gradient(J, r))
        else:
            step, multiplier = _bounded_step(bound, x[rows], r, J, damping, multiplier)
        moving = (np.abs(step) > nearest.TOLERANCE_MM).any(axis=1) & (damping < nearest.MAX_DAMPING)
        if bound is None:
            # the last step doubles the number of correct digits, so it needs no further evaluation
            x[rows] += np.where(moving[:, None], 0.0, step)
        rows = rows[moving]
        r, J, damping, multiplier, step = _picked(moving, r, J, damping, multiplier, step)
        if not rows.size:
            break
        trial = x[rows] + step
        allowed: Mask | bool = True
        if bound is not None:
            trial, allowed = pulled_inside(bound, trial)
        r_trial, J_trial = residual(trial, rows)
        cost_trial = np.einsum("nm,nm->n", r_trial, r_trial)
        better = (cost_trial <= cost[rows]) & allowed
        damping = np.where(better, np.maximum(damping * 0.1, nearest.MIN_DAMPING), damping * 10.0)
        if better.all():
            x[rows], cost[rows], r, J = trial, cost_trial, r_trial, J_trial
        else:
            x[rows[better]], cost[rows[better]] = trial[better], cost_trial[better]
            r = np.where(better[:, None], r_trial, r)
            J = np.where(better[:, None, None], J_trial, J)
    return x


def _picked(selected: Mask, *arrays: Array) -> tuple[Array, ...]:
    """Return the selected rows of each array, without a copy if all are selected."""
    return arrays if selected.all() else tuple(array[selected] for array in arrays)


def solve_symmetric(A: Array, b: Array) -> Array:
    """Return the solution (n, 3) of A x = b for symmetric A (n, 3, 3) and b (n, 3), by cofactors."""
    if len(A) == 1:
        (a, p, q), (_, c, s), (_, _, f) = A[0].tolist()
        x, y, z = b[0].tolist()
    else:
        a, p, q, c, s, f = A[:, 0, 0], A[:, 0, 1], A[:, 0, 2], A[:, 1, 1], A[:, 1, 2], A[:, 2, 2]
        x, y, z = b.T
    c00, c01, c02 = c * f - s * s, q * s - p * f, p * s - q * c
    c11, c12, c22 = a * f - q * q, p * q - a * s, a * c - p * p
    determinant = a * c00 + p * c01 + q * c02
    # keeps the result finite for a singular matrix; if the step is then wrong, damping is increased
    scale = 1.0 / (determinant + (determinant == 0))
    solution = (c00 * x + c01 * y + c02 * z, c01 * x + c11 * y + c12 * z, c02 * x + c12 * y + c22 * z)
    return (np.array(solution) * scale).T.reshape(len(A), 3)


def _gradient(J: Array, r: Array) -> Array:
    return np.einsum("nmi,nm->ni", J, r)


def _damped(A: Array, damping: Array) -> Array:
    # damping is relative to the scale of the problem, the same for mm and for weighted residuals
    amount = damping * (np.einsum("nii->n", A) / 3.0) + nearest.MIN_STIFFNESS
    return A + amount[:, None, None] * _IDENTITY


def _first_multiplier(bound: SliceHull, x: Array, r: Array, J: Array) -> Array:
    """Return the bound's initial multiplier: computed from the cost gradient where x lies on the bound, otherwise 0."""
    distance, normal = bound.signed_distance_gradient(x)
    squared = np.maximum(np.einsum("ni,ni->n", normal, normal), nearest.MIN_SLOPE)
    press = -np.einsum("ni,ni->n", normal, _gradient(J, r)) / squared
    return np.where(distance > -nearest.TOUCHING_MM, np.maximum(press, 0.0), 0.0)


def _bounded_step(
    bound: SliceHull, x: Array, r: Array, J: Array, damping: Array, multiplier: Array
) -> tuple[Array, Array]:
    """Return the step of the quadratic model under the linearised bound, and the bound's multiplier."""
    distance, normal, curvature = bound.signed_distance_curvature(x)
    A = _damped(np.swapaxes(J, 1, 2) @ J + multiplier[:, None, None] * curvature, damping)
    step = -solve_symmetric(A, _gradient(J, r))
    over = distance + np.einsum("ni,ni->n", normal, step)
    inward = solve_symmetric(A, normal)
    multiplier = np.maximum(over, 0.0) / np.einsum("ni,ni->n", normal, inward)
    step -= multiplier[:, None] * inward
    length = np.sqrt(np.einsum("ni,ni->n", step, step))
    return step * np.minimum(1.0, nearest.MAX_STEP_MM / np.maximum(length, 1e-300))[:, None], multiplier


def pulled_inside(bound: SliceHull, x: Array) -> tuple[Array, Mask]:
    """Move points x (n, 3) [mm] along the gradient until just inside, in place; return them and which succeeded."""
    inside = np.zeros(len(x), dtype=bool)
    rows: Indices = np.arange(len(x))
    for _ in range(nearest.PULL_BACKS):
        distance, normal = bound.signed_distance_gradient(x[rows])
        out = distance > 0
        inside[rows[~out]] = True
        rows = rows[out]
        distance, normal = _picked(out, distance, normal)
        if not rows.size:
            break
        squared = np.maximum(np.einsum("ni,ni->n", normal, normal), nearest.MIN_SLOPE)
        x[rows] -= ((nearest.PULL * distance + nearest.INSIDE_MM) / squared)[:, None] * normal
    return x, inside
