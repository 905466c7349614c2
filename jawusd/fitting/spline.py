"""Smoothing polyharmonic splines (r^3 kernels on spread-out centres, plus a linear tail), and regression with them.

s(q) = sum_i w_i |q - c_i|^3 + L q - (the same at q = 0), with sum_i w_i = 0 and sum_i w_i c_i = 0, so that w^T K w is
the bending energy of s (Duchon 1977; Wahba, Spline Models for Observational Data, 1990, section 2.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from jawusd.base.arrays import Array, Indices, Mask

_RANK = 1e-9  # relative threshold below which singular values count as zero
_TIE_DIGITS = 9
_SAME_CENTRE = 1e-6  # normalised distance below which two points count as one centre
_BLOCK, _FOLDS = 25, 5  # number of frames held out together (one second), and number of folds
_CAP_MM = 1.0  # cap on the error of a held-out row, so that outliers do not determine the smoothness


def farthest_points(points: Array, count: int) -> Array:
    """Return `count` of the points (N, D) by farthest-point sampling (Gonzalez 1985).

    The first point is the one nearest to the origin. Fewer points are returned if points repeat.
    """
    chosen = [int(np.argmin((points**2).sum(1)))]
    distance = ((points - points[chosen[0]]) ** 2).sum(1)
    while len(chosen) < min(count, len(points)):
        # Round, so that ties, which occur on grids, break the same way in every coordinate frame.
        farthest = int(np.argmax(np.round(distance, _TIE_DIGITS)))
        if distance[farthest] < _SAME_CENTRE**2:
            break
        chosen.append(farthest)
        distance = np.minimum(distance, ((points - points[farthest]) ** 2).sum(1))
    return points[chosen]


@dataclass(frozen=True)
class SplineBasis:
    """Regression basis on normalised points, with the bending energy as a quadratic form."""

    centres: Array  # spline centres, shape (m, 3)
    null_space: Array  # maps free coefficients to kernel weights that satisfy the side conditions, shape (m, k)
    energy: Array  # bending energy of the free coefficients, with zeros for the linear tail, shape (k + 3, k + 3)
    at_zero: Array  # kernel values at q = 0, shape (m,)

    @classmethod
    def on_centres(cls, centres: Array) -> SplineBasis:
        """Build the basis on centres, shape (m, 3)."""
        sides = np.column_stack([np.ones(len(centres)), centres])
        U, values, _ = np.linalg.svd(sides, full_matrices=True)
        null_space = U[:, int((values > _RANK * values[0]).sum()) :]
        kernel = _cubed_distance(centres, centres)
        size = null_space.shape[1]
        energy = np.zeros((size + 3, size + 3))
        energy[:size, :size] = null_space.T @ kernel @ null_space
        return cls(centres, null_space, energy, _cubed_distance(np.zeros((1, 3)), centres)[0])

    def columns(self, q: Array) -> Array:
        """Return the regression columns at points q (N, 3), zero at q = 0; shape (N, k + 3)."""
        return np.column_stack([(_cubed_distance(q, self.centres) - self.at_zero) @ self.null_space, q])

    def weights(self, coefficients: Array) -> Array:
        """Return the kernel weights and linear tail, shape (m + 3, C), of fitted coefficients (k + 3, C)."""
        size = self.null_space.shape[1]
        return np.concatenate([self.null_space @ coefficients[:size], coefficients[size:]])


def ridge_solve(normal: Array, right: Array, penalty: Array) -> Array:
    """Solve (normal + penalty) x = right, where the sum of the matrices is symmetric positive definite."""
    return cho_solve(cho_factor(normal + penalty, lower=True), right)


def within(residual_mm: Array, trim_mad: float, floor_mm: float) -> Mask:
    """Return which residuals (N,) [mm] exceed the median by at most `trim_mad` deviations, or stay below a floor.

    A deviation is 1.4826 times the median absolute deviation, the standard deviation of a normal distribution.
    """
    middle = float(np.median(residual_mm))
    spread = 1.4826 * float(np.median(np.abs(residual_mm - middle)))
    return residual_mm <= max(middle + trim_mad * spread, floor_mm)


def folds_of(count: int) -> Indices:
    """Return the fold number of each frame of a take, shape (count,); neighbouring frames are held out together."""
    return np.arange(count) // _BLOCK % _FOLDS


def choose_smoothing(
    columns: Array, values: Array, weights: Array, energy: Array, tail: Array, grid: Array, folds: Indices
) -> float:
    """Return the smoothing factor with the smallest capped error on held-out folds.

    Args:
        columns: regression columns, shape (N, k).
        values: targets, in units in which their Euclidean norm is the error [mm], shape (N, C).
        energy: bending energy, shape (k, k).
        tail: constant part of the penalty, shape (k, k).
        grid: smoothing factors to try, ascending.
        folds: see `folds_of`, shape (N,); rows with a negative fold number are never held out.
    """
    weighted = columns * weights[:, None]
    total, right = weighted.T @ columns, weighted.T @ values
    cost = np.zeros(len(grid))
    for fold in np.unique(folds[folds >= 0]):
        left = folds == fold
        normal, target = total - weighted[left].T @ columns[left], right - weighted[left].T @ values[left]
        for index, factor in enumerate(grid):
            predicted = columns[left] @ ridge_solve(normal, target, factor * energy + tail)
            error = np.minimum(((values[left] - predicted) ** 2).sum(1), _CAP_MM**2)
            cost[index] += (weights[left] * error).sum()
    return float(grid[int(np.argmin(cost))])


def _cubed_distance(a: Array, b: Array) -> Array:
    square = np.maximum((a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T, 0.0)
    return square * np.sqrt(square)
