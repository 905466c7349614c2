"""Damped Gauss-Newton over many small problems at once, free or kept inside a bound.

Each row is a problem of its own in three unknowns [mm] (Levenberg 1944, Marquardt 1963; the damping of each row rises
and falls on its own). Within a bound every iterate is feasible: the step solves the quadratic model under the
linearised bound in closed form, is pulled back onto the surface, and counts only if the cost fell.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from jawusd.base.arrays import Array, Indices, Mask
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

# (x (k, 3), row numbers (k,)) -> residuals (k, m) and their derivatives by x (k, m, 3)
Residual = Callable[[Array, Indices], tuple[Array, Array]]

_IDENTITY = np.eye(3)


class Bound(Protocol):
    """A smooth bound: negative inside."""

    def signed_distance(self, d: Array) -> Array:
        """Return the signed distance (n,) [mm] at d (n, 3)."""

    def signed_distance_gradient(self, d: Array) -> tuple[Array, Array]:
        """Return signed distance (n,) and gradient (n, 3)."""

    def signed_distance_curvature(self, d: Array) -> tuple[Array, Array, Array]:
        """Return signed distance (n,), gradient (n, 3) and positive semidefinite curvature (n, 3, 3)."""


def minimise(
    residual: Residual,
    start: Array,
    bound: Bound | None = None,
    *,
    iterations: int = ITERATIONS,
    tolerance_mm: float = TOLERANCE_MM,
) -> Array:
    """Minimise half the squared residual of every row.

    Args:
        residual: Residuals and their derivatives at given points of given rows.
        start: First points [mm], shape (n, 3); inside the bound, if there is one. Rows whose start or residual is NaN
            come back NaN.
        bound: Where the points must stay.
        iterations: Most steps tried per row.
        tolerance_mm: A row is settled when its next step is shorter.

    Returns:
        The points [mm], shape (n, 3).
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
    damping = np.full(len(rows), START_DAMPING)
    multiplier = np.zeros(len(rows)) if bound is None else _first_multiplier(bound, x[rows], r, J)
    for _ in range(iterations):
        if bound is None:
            step = -solve_symmetric(_damped(np.swapaxes(J, 1, 2) @ J, damping), _gradient(J, r))
        else:
            step, multiplier = _bounded_step(bound, x[rows], r, J, damping, multiplier)
        moving = (np.abs(step) > tolerance_mm).any(axis=1) & (damping < LARGEST_DAMPING)
        if bound is None:
            x[rows] += np.where(moving[:, None], 0.0, step)  # the last step costs nothing and doubles the digits
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
        damping = np.where(better, np.maximum(damping * 0.1, SMALLEST_DAMPING), damping * 10.0)
        if better.all():
            x[rows], cost[rows], r, J = trial, cost_trial, r_trial, J_trial
        else:
            x[rows[better]], cost[rows[better]] = trial[better], cost_trial[better]
            r = np.where(better[:, None], r_trial, r)
            J = np.where(better[:, None, None], J_trial, J)
    return x


def _picked(wanted: Mask, *arrays: Array) -> tuple[Array, ...]:
    """Return the wanted rows of each array; the arrays themselves, not copies, if all are wanted."""
    return arrays if wanted.all() else tuple(array[wanted] for array in arrays)


def solve_symmetric(A: Array, b: Array) -> Array:
    """Solve A x = b for symmetric A (n, 3, 3) and b (n, 3) by cofactors.

    Returns:
        x, shape (n, 3).
    """
    if len(A) == 1:
        (a, p, q), (_, c, s), (_, _, f) = A[0].tolist()
        x, y, z = b[0].tolist()
    else:
        a, p, q, c, s, f = A[:, 0, 0], A[:, 0, 1], A[:, 0, 2], A[:, 1, 1], A[:, 1, 2], A[:, 2, 2]
        x, y, z = b.T
    c00, c01, c02 = c * f - s * s, q * s - p * f, p * s - q * c
    c11, c12, c22 = a * f - q * q, p * q - a * s, a * c - p * p
    determinant = a * c00 + p * c01 + q * c02
    scale = 1.0 / (determinant + (determinant == 0))  # a finite step even of a singular row; damping mends it
    solution = (c00 * x + c01 * y + c02 * z, c01 * x + c11 * y + c12 * z, c02 * x + c12 * y + c22 * z)
    return (np.array(solution) * scale).T.reshape(len(A), 3)


def _gradient(J: Array, r: Array) -> Array:
    return np.einsum("nmi,nm->ni", J, r)


def _damped(A: Array, damping: Array) -> Array:
    # damping relative to the problem's own scale, so that it means the same for mm and for weighted residuals
    amount = damping * (np.einsum("nii->n", A) / 3.0) + LEAST_STIFFNESS
    return A + amount[:, None, None] * _IDENTITY


def _first_multiplier(bound: Bound, x: Array, r: Array, J: Array) -> Array:
    """Return the bound's multiplier at the start: how hard the cost presses against it where x lies on it."""
    distance, normal = bound.signed_distance_gradient(x)
    squared = np.maximum(np.einsum("ni,ni->n", normal, normal), LEAST_SLOPE)
    press = -np.einsum("ni,ni->n", normal, _gradient(J, r)) / squared
    return np.where(distance > -TOUCHING_MM, np.maximum(press, 0.0), 0.0)


def _bounded_step(bound: Bound, x: Array, r: Array, J: Array, damping: Array, multiplier: Array) -> tuple[Array, Array]:
    """Return the step of the quadratic model under the linearised bound, and the bound's multiplier."""
    distance, normal, curvature = bound.signed_distance_curvature(x)
    A = _damped(np.swapaxes(J, 1, 2) @ J + multiplier[:, None, None] * curvature, damping)
    step = -solve_symmetric(A, _gradient(J, r))
    over = distance + np.einsum("ni,ni->n", normal, step)
    inward = solve_symmetric(A, normal)
    multiplier = np.maximum(over, 0.0) / np.einsum("ni,ni->n", normal, inward)
    step -= multiplier[:, None] * inward
    length = np.sqrt(np.einsum("ni,ni->n", step, step))
    return step * np.minimum(1.0, LONGEST_STEP_MM / np.maximum(length, 1e-300))[:, None], multiplier


def pulled_inside(bound: Bound, x: Array) -> tuple[Array, Mask]:
    """Move the points x (n, 3) [mm] down the gradient until just inside, in place; return them and which got there."""
    inside = np.zeros(len(x), dtype=bool)
    rows: Indices = np.arange(len(x))
    for _ in range(PULL_BACKS):
        distance, normal = bound.signed_distance_gradient(x[rows])
        out = distance > 0
        inside[rows[~out]] = True
        rows = rows[out]
        distance, normal = _picked(out, distance, normal)
        if not rows.size:
            break
        squared = np.maximum(np.einsum("ni,ni->n", normal, normal), LEAST_SLOPE)
        x[rows] -= ((PULL * distance + INSIDE_MM) / squared)[:, None] * normal
    return x, inside
