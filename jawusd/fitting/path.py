"""The habitual opening path: where the incisal point usually is at each opening, robustly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.geometry.arrays import Array

_DEGREE = 5
_ITERATIONS = 40
_SMALLEST_SPREAD_MM = 0.3  # residuals below this are never treated as outliers of the path
_RIDGE = 1e-5
#: Openings (1 to 99 %) below which there is no path: what moves then is a glide of closed teeth [mm].
SMALLEST_OPENING_MM = 5.0


@dataclass(frozen=True)
class Path:
    """Hold the arrays `path_coefficients`, `path_scale_mm` and `path_limits` of a model.

    Attributes:
        coefficients: of gx and gz, shape (2, 5) [mm].
        scale_mm: opening that makes the polynomial argument one.
        limits: opening interval [mm] in which the polynomials hold.
    """

    coefficients: Array
    scale_mm: float
    limits: tuple[float, float]


def fit_path(displacement: Array, weights: Array) -> Path:
    """Fit x and z of the incisal point as polynomials of the opening through the origin.

    Iteratively reweighted least squares with the weight (1 + (r/s)^2)^-2, which follows the most frequent path
    instead of the mean of all exercises; s is 1.4826 times the median absolute residual. Without opening in the data
    the path is a straight line down.

    Args:
        displacement: incisal displacement, anatomical frame [mm], shape (N, 3).
        weights: frame weights, shape (N,).
    """
    opening = -displacement[:, 1]
    if np.subtract(*np.percentile(opening, [99, 1])) < SMALLEST_OPENING_MM:
        return Path(np.zeros((2, _DEGREE)), SMALLEST_OPENING_MM, (0.0, SMALLEST_OPENING_MM))
    scale = float(np.percentile(opening, 99.5))
    basis = (opening / scale)[:, None] ** np.arange(1, _DEGREE + 1)
    coefficients = np.stack([_robust(basis, displacement[:, axis], weights) for axis in (0, 2)])
    return Path(coefficients, scale, (min(0.0, float(np.percentile(opening, 0.5))), scale))


def _robust(basis: Array, values: Array, weights: Array) -> Array:
    ridge = _RIDGE * weights.sum() * np.eye(_DEGREE)
    robust = weights.copy()
    for _ in range(_ITERATIONS):
        weighted = basis * robust[:, None]
        coefficients = np.linalg.solve(weighted.T @ basis + ridge, weighted.T @ values)
        residual = values - basis @ coefficients
        spread = max(1.4826 * float(np.median(np.abs(residual))), _SMALLEST_SPREAD_MM)
        robust = weights / (1 + (residual / spread) ** 2) ** 2
    return coefficients
