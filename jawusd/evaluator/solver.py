"""Damped Gauss-Newton over many small problems at once, free or kept inside a bound.

Each row is a problem of its own in three unknowns [mm] (Levenberg 1944, Marquardt 1963; the damping of each row rises
and falls on its own). Within a bound every iterate is feasible: the step solves the quadratic model under the
linearised bound in closed form, is pulled back onto the surface, and counts only if the cost fell.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# (x (k, 3), row numbers (k,)) -> residuals (k, m) and their derivatives by x (k, m, 3)
Residual = Callable[[Array, NDArray[np.intp]], tuple[Array, Array]]

_START_DAMPING = 1e-6
_LARGEST_DAMPING = 1e8
_SMALLEST_DAMPING = 1e-12
_INSIDE_MM = 1e-10  # depth at which a point pulled back onto the surface is left
_PULL_BACKS = 12
_IDENTITY = np.eye(3)


class Bound(Protocol):
    """A smooth bound: negative excess inside."""

    def excess(self, d: Array) -> Array:
        """Return the excess (n,) [mm] at d (n, 3)."""

    def excess_gradient(self, d: Array) -> tuple[Array, Array]:
        """Return excess (n,) and gradient (n, 3)."""

    def excess_curvature(self, d: Array) -> tuple[Array, Array, Array]:
        """Return excess (n,), gradient (n, 3) and positive semidefinite curvature (n, 3, 3)."""


def minimise(
    residual: Residual,
    start: Array,
    bound: Bound | None = None,
    *,
    iterations: int = 60,
    tolerance_mm: float = 1e-7,
) -> tuple[Array, Array]:
    """Minimise half the squared residual of every row.

    Args:
        residual: Residuals and their derivatives at given points of given rows.
        start: First points [mm], shape (n, 3); inside the bound, if there is one. Rows whose start or residual is NaN
            come back NaN.
        bound: Where the points must stay.
        iterations: Most steps tried per row.
        tolerance_mm: A row is settled when its step is shorter; near the end steps shrink at least tenfold each time.

    Returns:
        The points (n, 3) and their squared residuals (n,).
    """
    x = start.copy()
    cost = np.full(len(x), np.nan)
    rows = np.flatnonzero(np.isfinite(x).all(axis=1))
    r, J = residual(x[rows], rows)
    cost[rows] = np.einsum("nm,nm->n", r, r)
    measured = np.isfinite(cost[rows])
    x[rows[~measured]] = np.nan
    rows, r, J = rows[measured], r[measured], J[measured]
    damping = np.full(len(rows), _START_DAMPING)
    pressure = np.zeros(len(rows))
    for _ in range(iterations):
        if not rows.size:
            break
        if bound is None:
            step = -solve_symmetric(_damped(np.swapaxes(J, 1, 2) @ J, damping), _gradient(J, r))
            trial = x[rows] + step
            allowed = np.ones(len(rows), dtype=bool)
        else:
            step, pressure = _bounded_step(bound, x[rows], r, J, damping, pressure)
            trial, allowed = _pulled_back(bound, x[rows] + step)
        r_trial, J_trial = residual(trial, rows)
        cost_trial = np.einsum("nm,nm->n", r_trial, r_trial)
        better = allowed & (cost_trial <= cost[rows])
        moved = np.abs(trial - x[rows]).max(axis=1)
        x[rows[better]], cost[rows[better]] = trial[better], cost_trial[better]
        r[better], J[better] = r_trial[better], J_trial[better]
        damping = np.where(better, np.maximum(damping * 0.1, _SMALLEST_DAMPING), damping * 10.0)
        left = (moved > tolerance_mm) & (damping < _LARGEST_DAMPING)
        rows, r, J, damping, pressure = rows[left], r[left], J[left], damping[left], pressure[left]
    return x, cost


def solve_symmetric(A: Array, b: Array) -> Array:
    """Solve A x = b for symmetric A (n, 3, 3) and b (n, 3) by cofactors."""
    a, p, q, c, s, f = A[:, 0, 0], A[:, 0, 1], A[:, 0, 2], A[:, 1, 1], A[:, 1, 2], A[:, 2, 2]
    c00, c01, c02 = c * f - s * s, q * s - p * f, p * s - q * c
    c11, c12, c22 = a * f - q * q, p * q - a * s, a * c - p * p
    scale = 1.0 / (a * c00 + p * c01 + q * c02)
    x, y, z = b.T
    return np.stack([c00 * x + c01 * y + c02 * z, c01 * x + c11 * y + c12 * z, c02 * x + c12 * y + c22 * z], 1) * scale[
        :, None
    ]


def _gradient(J: Array, r: Array) -> Array:
    return np.einsum("nmi,nm->ni", J, r)


def _damped(A: Array, damping: Array) -> Array:
    # damping relative to the problem's own scale, so that it means the same for mm and for weighted residuals
    amount = damping * (np.einsum("nii->n", A) / 3.0) + np.finfo(float).tiny
    return A + amount[:, None, None] * _IDENTITY


def _bounded_step(
    bound: Bound, x: Array, r: Array, J: Array, damping: Array, pressure: Array
) -> tuple[Array, Array]:
    """Return the step of the quadratic model under the linearised bound, and the bound's multiplier."""
    excess, normal, curvature = bound.excess_curvature(x)
    A = _damped(np.swapaxes(J, 1, 2) @ J + pressure[:, None, None] * curvature, damping)
    step = -solve_symmetric(A, _gradient(J, r))
    over = excess + np.einsum("ni,ni->n", normal, step)
    inward = solve_symmetric(A, normal)
    pressure = np.maximum(over, 0.0) / np.einsum("ni,ni->n", normal, inward)
    return step - pressure[:, None] * inward, pressure


def _pulled_back(bound: Bound, x: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the points moved down the gradient until just inside, and whether they got there."""
    x = x.copy()
    rows = np.arange(len(x))
    for _ in range(_PULL_BACKS):
        excess, normal = bound.excess_gradient(x[rows])
        out = excess > 0
        rows, excess, normal = rows[out], excess[out], normal[out]
        if not rows.size:
            break
        squared = np.maximum(np.einsum("ni,ni->n", normal, normal), 1e-6)
        x[rows] -= ((excess + _INSIDE_MM) / squared)[:, None] * normal
    inside = np.ones(len(x), dtype=bool)
    if rows.size:
        inside[rows] = bound.excess(x[rows]) <= 0
    return x, inside
