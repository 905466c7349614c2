"""The semantic gauge: a choice of d1, d2, d3 for which moving each slider alone stays anatomical.

d1 follows the habitual opening path, the most frequent position of the incisal point at each opening. A plain lateral
slide at closed teeth moves the incisal point forward (gothic arch) and down (tooth guidance). All three are learned
from the captured poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator.gauge import Gauge

SOFTNESS_MM = 2.0  # radius of the fillet at the apex of the gothic arch, d2 = 0; it keeps slider motion smooth there
FADE_MM = 14.0  # opening [mm] at which tooth guidance has decreased to 1/e

_PATH_DEGREE, _PATH_ITERATIONS, _PATH_RIDGE = 5, 40, 1e-5
_SMALLEST_SPREAD_MM = 0.3  # minimum scale s of the residuals of the habitual path [mm]
#: Minimum range of openings (1st to 99th percentile) for fitting a path [mm]; motion over a smaller range is mostly
#: gliding with the teeth closed.
SMALLEST_OPENING_MM = 5.0

_ROUNDS = 3
_ITERATIONS = 60
_RESIDUAL_FLOOR_MM = 0.08  # minimum residual in the reweighting of the quantile regressions, which keeps weights finite
_ARCH_QUANTILE, _ARCH_RIDGE, _ARCH_MIN_SIDE_MM = 0.5, 1e-3, 1.0
_DROP_QUANTILE, _DROP_RIDGE, _DROP_MAX_OPENING_MM = 0.1, 3e-2, 1.2 * FADE_MM
_UNKNOWN = 1e6  # additional ridge penalty on terms without data
_FEWEST_FRAMES = 20

#: Minimum principal minor of the Jacobian of an invertible gauge; it is 1 for an undistorted gauge.
SMALLEST_MINOR = 0.25
_STIFFNESSES = 4.0 ** np.arange(8)
_WIDER_MM = 3.0  # margin of the checked box around the captured poses, equal to the largest margin of a bound
_GRID = 33


@dataclass(frozen=True)
class GaugeFit:
    """A fitted gauge with the results of its invertibility check."""

    gauge: Gauge
    smallest_minor: float  # smallest principal minor of the Jacobian over the box; see `smallest_minor()`
    #: factor on the ridge penalties, above 1 if a less stiff gauge was not invertible; None without a glide surface
    stiffness: float | None


def path_gauge(coefficients: Array, scale_mm: float, limits: tuple[float, float]) -> Gauge:
    """Return a gauge with a habitual path but no glide surface; the arguments are those of `Gauge`."""
    return Gauge(coefficients, scale_mm, limits, np.zeros(7), np.zeros(4), SOFTNESS_MM, FADE_MM)


def fit_path(u: Array, weights: Array) -> Gauge:
    """Fit x and z of the incisal displacement u (N, 3) [mm] as polynomials of the opening through the origin.

    Iteratively reweighted least squares with the weight (1 + (r/s)^2)^-2, which follows the most frequent path instead
    of the mean of all exercises; s is 1.4826 times the median absolute residual. Without opening in the data, the path
    is a straight line downwards. Returns the gauge of the path alone.
    """
    opening = -u[:, 1]
    if np.subtract(*np.percentile(opening, [99, 1])) < SMALLEST_OPENING_MM:
        return path_gauge(np.zeros((2, _PATH_DEGREE)), SMALLEST_OPENING_MM, (0.0, SMALLEST_OPENING_MM))
    scale = float(np.percentile(opening, 99.5))
    basis = (opening / scale)[:, None] ** np.arange(1, _PATH_DEGREE + 1)
    coefficients = np.stack([_robust_fit(basis, u[:, axis], weights) for axis in (0, 2)])
    return path_gauge(coefficients, scale, (min(0.0, float(np.percentile(opening, 0.5))), scale))


def sheared(u: Array, path: Gauge) -> Array:
    """Return incisal displacements u (N, 3) [mm] as opening, and sideways and forward from the habitual path (N, 3)."""
    gx, gz, _, _ = path.path(-u[:, 1])
    return np.stack([-u[:, 1], u[:, 0] - gx, u[:, 2] - gz], axis=1)


def _robust_fit(basis: Array, values: Array, weights: Array) -> Array:
    ridge = _PATH_RIDGE * weights.sum() * np.eye(_PATH_DEGREE)
    robust = weights.copy()
    for _ in range(_PATH_ITERATIONS):
        weighted = basis * robust[:, None]
        coefficients = np.linalg.solve(weighted.T @ basis + ridge, weighted.T @ values)
        residual = values - basis @ coefficients
        spread = max(1.4826 * float(np.median(np.abs(residual))), _SMALLEST_SPREAD_MM)
        robust = weights / (1 + (residual / spread) ** 2) ** 2
    return coefficients


def fit_gauge(u: Array, weights: Array, path: Gauge, shown: Mask) -> GaugeFit:
    """Fit gothic arch and glide surface to incisal displacements u (N, 3) [mm], for the parameters shown (3,) by them.

    The stiffness is increased until the gauge is invertible. If none suffices, the gauge is that of the habitual path
    alone, which is always invertible.
    """
    for stiffness in _STIFFNESSES:
        gauge = path
        for _ in range(_ROUNDS):  # alternate between inverting the gauge for d, and fitting its parts to d
            gauge = _with_arch(gauge, u, weights, shown, stiffness)
            gauge = _with_drop(gauge, u, weights, shown, stiffness)
        minor = smallest_minor_around(gauge, gauge.inverse(u))
        if minor >= SMALLEST_MINOR:
            return GaugeFit(gauge, minor, float(stiffness))
    return GaugeFit(path, smallest_minor_around(path, path.inverse(u)), None)


def smallest_minor_around(gauge: Gauge, d: Array) -> float:
    """Return `smallest_minor` over the box of parameters (N, 3) [mm] with a margin; -inf if some are not finite."""
    if not np.isfinite(d).all():
        return -np.inf
    return smallest_minor(gauge, np.stack([d.min(0) - _WIDER_MM, d.max(0) + _WIDER_MM], axis=1))


def smallest_minor(gauge: Gauge, box: Array) -> float:
    """Return the smallest principal minor of d(-y, x, z)/dd on a dense grid over a box of d (3, 2) [mm].

    A map whose Jacobian has only positive principal minors on a box is injective there (Gale & Nikaido 1965,
    Math. Annalen 159:81); a positive determinant alone is not sufficient.
    """
    axes = [np.linspace(low, high, _GRID) for low, high in box]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    J = gauge.displacement_jacobian(grid)[1][:, [1, 0, 2]] * np.array([-1.0, 1.0, 1.0])[:, None]
    minors = [J[:, i, i] for i in range(3)]
    minors += [J[:, i, i] * J[:, k, k] - J[:, i, k] * J[:, k, i] for i, k in ((0, 1), (0, 2), (1, 2))]
    minors.append(np.linalg.det(J))
    return float(np.min(minors))


def _with_arch(gauge: Gauge, u: Array, weights: Array, shown: Mask, stiffness: float) -> Gauge:
    """Fit the forward displacement of the incisal point in lateral excursions, as the median of the frames."""
    if not shown[1]:
        return gauge
    d1, d2, _ = np.nan_to_num(gauge.inverse(u)).T
    # The terms are linear in their coefficients, so unit coefficients in the evaluator yield the columns.
    columns = np.stack([replace(gauge, glide_arch=row).arch(d1, d2)[0] for row in np.eye(7)], axis=-1)
    ahead = u[:, 2] - gauge.path(d1)[1]
    side = np.abs(d2) > _ARCH_MIN_SIDE_MM
    ridge = np.full(7, stiffness * _ARCH_RIDGE)
    arch = _quantile_regression(columns[side], ahead[side], weights[side], _ARCH_QUANTILE, ridge)
    return replace(gauge, glide_arch=arch)


def _with_drop(gauge: Gauge, u: Array, weights: Array, shown: Mask, stiffness: float) -> Gauge:
    """Fit the downward displacement that gliding teeth impose on the incisal point, as a low quantile of the frames."""
    _, d2, d3 = np.nan_to_num(gauge.inverse(u)).T
    columns = np.stack([replace(gauge, glide_drop=row).drop(d2, d3)[0] for row in np.eye(4)], axis=-1)
    low = -u[:, 1] < _DROP_MAX_OPENING_MM
    side, front = (stiffness * _DROP_RIDGE * (1.0 if known else _UNKNOWN) for known in shown[1:])
    ridge = np.array([side, front, side, front])
    drop = _quantile_regression(columns[low], -u[low, 1], weights[low], _DROP_QUANTILE, ridge)
    return replace(gauge, glide_drop=drop)


def _quantile_regression(columns: Array, values: Array, weights: Array, quantile: float, ridge: Array) -> Array:
    """Fit a conditional quantile by iteratively reweighted least squares (Koenker & Bassett 1978), with a ridge."""
    coefficients: Array = np.zeros(columns.shape[1])
    if len(values) < _FEWEST_FRAMES:
        return coefficients
    penalty = np.diag(ridge * weights.sum())
    for _ in range(_ITERATIONS):
        residual = values - columns @ coefficients
        side = np.where(residual > 0, quantile, 1 - quantile)
        weighted = columns * (weights * side / np.maximum(np.abs(residual), _RESIDUAL_FLOOR_MM))[:, None]
        coefficients = np.asarray(np.linalg.solve(weighted.T @ columns + penalty, weighted.T @ values))
    return coefficients
