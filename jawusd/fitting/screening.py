"""Screening of gross outliers before a flexible model is fitted.

A tracking failure of centimetres is isolated in the space of poses, and a spline interpolates isolated points. A
quadratic map from the incisal displacement to the rotation cannot: fitted by random sample consensus (Fischler & Bolles
1981), it follows the majority, so that the residuals of the others equal their errors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.fitting.data import Selection, TrainingData
from jawusd.geometry import so3_log

_FEWEST = 60  # poses needed to identify outliers
_TRIALS, _SAMPLE = 300, 15  # random samples; each somewhat above the ten unknowns per component
_CONSENSUS = 0.75  # share of the poses that must agree
_REFITS = 3
# A jaw deviates from the quadratic by a millimetre or two at its borders; smaller failures are trimmed by the smooth
# models themselves [mm, rms over the mandible].
_TIMES, _FLOOR_MM = 8.0, 6.0
REASON = "far from the other poses' smooth motion"


def screened(selection: Selection) -> Selection:
    """Return the selection without its gross outliers."""
    outliers = gross_outliers(selection.data)
    if not outliers.any():
        return selection
    used = selection.used.copy()
    used[np.flatnonzero(used)[outliers]] = False
    excluded = {**selection.excluded, REASON: selection.data.frames[outliers].tolist()}
    return replace(selection, data=selection.data.select(~outliers), used=used, excluded=excluded)


def gross_outliers(data: TrainingData) -> Mask:
    """Return which poses lie centimetres off the quadratic map of the majority, shape (N,); none of fewer than 60."""
    count = len(data)
    if count < _FEWEST:
        return np.zeros(count, dtype=bool)
    columns = _quadratic(data.displacement())
    # |values|^2 is the mean squared displacement of the mandible by the rotation about the incisal point [mm^2].
    values = so3_log(data.motion[:, :3, :3]) @ np.linalg.cholesky(data.metric.about(data.incisor))
    rng = np.random.default_rng(0)
    agreeing, best = np.ones(count, dtype=bool), np.inf
    for _ in range(_TRIALS):
        sample = rng.choice(count, _SAMPLE, replace=False)
        residual = _residual(columns, values, sample)
        spread = np.quantile(residual, _CONSENSUS)
        if spread < best:
            agreeing, best = residual <= 3 * spread, spread
    for _ in range(_REFITS):
        residual = _residual(columns, values, agreeing)
        spread = np.quantile(residual, _CONSENSUS)
        agreeing = residual <= 3 * spread
    return residual > max(_TIMES * spread, _FLOOR_MM)


def _quadratic(u: Array) -> Array:
    """Return the ten monomials up to degree two of displacements (N, 3), scaled to their usual size, shape (N, 10)."""
    x = (u - np.median(u, axis=0)) / np.maximum(np.percentile(np.abs(u), 75, axis=0), 1.0)
    pairs = [x[:, i] * x[:, j] for i in range(3) for j in range(i, 3)]
    return np.column_stack([np.ones(len(x)), x, *pairs])


def _residual(columns: Array, values: Array, rows: Indices | Mask) -> Array:
    """Return the residuals (N,) of a fit to some rows."""
    solution = np.linalg.lstsq(columns[rows], values[rows], rcond=1e-8)[0]
    return np.linalg.norm(values - columns @ solution, axis=1)
