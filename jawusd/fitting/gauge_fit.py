"""The semantic gauge: choose the meaning of d1, d2, d3 so that each slider alone stays anatomical.

A plain lateral slide at closed teeth carries the incisal point forward (gothic arch) and down (tooth guidance). Both
are learned from the captured poses and put into the gauge, outside the regression of the poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jawusd.evaluator.gauge import Gauge
from jawusd.fitting.path import Path
from jawusd.geometry.arrays import Array, Mask

SOFTNESS_MM = 2.0  # rounding of the arch across d2 = 0: wide enough that a slider does not jerk there
FADE_MM = 14.0  # opening at which tooth guidance has faded to 1/e

_ROUNDS = 3
_ITERATIONS = 60
_RESIDUAL_FLOOR_MM = 0.08  # keeps the reweighting of the quantile regressions finite
_ARCH_QUANTILE, _ARCH_RIDGE, _ARCH_MIN_SIDE_MM = 0.5, 1e-3, 1.0
_DROP_QUANTILE, _DROP_RIDGE, _DROP_MAX_OPENING_MM = 0.1, 3e-2, 1.2 * FADE_MM
_UNKNOWN = 1e6  # extra stiffness of terms that the data do not show
_FEWEST_FRAMES = 20

#: Smallest principal minor of the gauge's Jacobian that counts as invertible; it is 1 for an undistorted gauge.
SMALLEST_MINOR = 0.25
_STIFFNESSES = 4.0 ** np.arange(8)
_WIDER_MM = 3.0  # by which the checked box is wider than the captured poses: the largest margin of a bound
_GRID = 33


@dataclass(frozen=True)
class GaugeFit:
    """Hold a gauge, its check and how hard it had to be regularised.

    Attributes:
        gauge: the fitted gauge.
        smallest_minor: least principal minor of the Jacobian over the box (see `smallest_minor`).
        stiffness: factor on the ridge penalties, 1 unless the gauge folded at first; None: no glide surface at all.
    """

    gauge: Gauge
    smallest_minor: float
    stiffness: float | None


def path_gauge(path: Path) -> Gauge:
    """Return the gauge with the habitual path and no glide surface."""
    return Gauge(path.coefficients, path.scale_mm, path.limits, np.zeros(7), np.zeros(4), SOFTNESS_MM, FADE_MM)


def fit_gauge(displacement: Array, weights: Array, path: Path, shown: Mask) -> GaugeFit:
    """Fit arch and glide surface to incisal displacements, stiffer and stiffer until the gauge is invertible.

    Args:
        displacement: incisal displacements of the frames [mm], shape (N, 3).
        weights: frame weights, shape (N,).
        path: the habitual opening path.
        shown: which of opening, laterotrusion, protrusion the data show, shape (3,).

    Returns:
        The gauge; if no stiffness makes it invertible, the one of the path alone, which always is.
    """
    for stiffness in _STIFFNESSES:
        gauge = _fit(displacement, weights, path_gauge(path), shown, stiffness)
        minor = _smallest_minor_around(gauge, displacement)
        if minor >= SMALLEST_MINOR:
            return GaugeFit(gauge, minor, float(stiffness))
    gauge = path_gauge(path)
    return GaugeFit(gauge, _smallest_minor_around(gauge, displacement), None)


def _smallest_minor_around(gauge: Gauge, displacement: Array) -> float:
    d = gauge.inverse(displacement)
    if not np.isfinite(d).all():
        return -np.inf
    return smallest_minor(gauge, np.stack([d.min(0) - _WIDER_MM, d.max(0) + _WIDER_MM], axis=1))


def smallest_minor(gauge: Gauge, box: Array) -> float:
    """Return the least principal minor of the Jacobian of (-y, x, z) by d on a dense grid over a box.

    A map whose Jacobian has only positive principal minors on a box is one-to-one there (Gale & Nikaido 1965,
    Math. Annalen 159:81); the determinant alone would not do.

    Args:
        gauge: the gauge.
        box: lower and upper limits of d [mm], shape (3, 2).
    """
    axes = [np.linspace(low, high, _GRID) for low, high in box]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    J = gauge.displacement_jacobian(grid)[1][:, [1, 0, 2]] * np.array([-1.0, 1.0, 1.0])[:, None]
    minors = [J[:, i, i] for i in range(3)]
    minors += [J[:, i, i] * J[:, k, k] - J[:, i, k] * J[:, k, i] for i, k in ((0, 1), (0, 2), (1, 2))]
    minors.append(np.linalg.det(J))
    return float(np.min(minors))


def _fit(u: Array, weights: Array, gauge: Gauge, shown: Mask, stiffness: float) -> Gauge:
    """Alternate between reading d off the gauge and fitting arch and drop to the d read off."""
    for _ in range(_ROUNDS):
        gauge = _with_arch(gauge, u, weights, shown, stiffness)
        gauge = _with_drop(gauge, u, weights, shown, stiffness)
    return gauge


def _with_arch(gauge: Gauge, u: Array, weights: Array, shown: Mask, stiffness: float) -> Gauge:
    """Fit how far a lateral excursion carries the incisal point forward: the middle of the frames."""
    if not shown[1]:
        return gauge
    d1, d2, _ = _read_off(gauge, u).T
    # The terms are linear in their coefficients, so the evaluator itself gives the columns.
    columns = np.stack([replace(gauge, glide_arch=row).arch(d1, d2)[0] for row in np.eye(7)], axis=-1)
    ahead = u[:, 2] - gauge.path(d1)[1]
    side = np.abs(d2) > _ARCH_MIN_SIDE_MM
    ridge = np.full(7, stiffness * _ARCH_RIDGE)
    arch = _quantile_regression(columns[side], ahead[side], weights[side], _ARCH_QUANTILE, ridge)
    return replace(gauge, glide_arch=arch)


def _with_drop(gauge: Gauge, u: Array, weights: Array, shown: Mask, stiffness: float) -> Gauge:
    """Fit how far gliding teeth push the incisal point down: the lower edge of the frames."""
    _, d2, d3 = _read_off(gauge, u).T
    columns = np.stack([replace(gauge, glide_drop=row).drop(d2, d3)[0] for row in np.eye(4)], axis=-1)
    low = -u[:, 1] < _DROP_MAX_OPENING_MM
    side, front = (stiffness * _DROP_RIDGE * (1.0 if known else _UNKNOWN) for known in shown[1:])
    ridge = np.array([side, front, side, front])
    drop = _quantile_regression(columns[low], -u[low, 1], weights[low], _DROP_QUANTILE, ridge)
    return replace(gauge, glide_drop=drop)


def _read_off(gauge: Gauge, u: Array) -> Array:
    d = gauge.inverse(u)
    return np.where(np.isfinite(d), d, 0.0)


def _quantile_regression(columns: Array, values: Array, weights: Array, quantile: float, ridge: Array) -> Array:
    """Fit a conditional quantile by iteratively reweighted least squares (Koenker & Bassett 1978), with a ridge."""
    coefficients = np.zeros(columns.shape[1])
    if len(values) < _FEWEST_FRAMES:
        return coefficients
    penalty = np.diag(ridge * weights.sum())
    for _ in range(_ITERATIONS):
        residual = values - columns @ coefficients
        side = np.where(residual > 0, quantile, 1 - quantile)
        weighted = columns * (weights * side / np.maximum(np.abs(residual), _RESIDUAL_FLOOR_MM))[:, None]
        coefficients = np.linalg.solve(weighted.T @ columns + penalty, weighted.T @ values)
    return coefficients
