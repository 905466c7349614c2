"""Error tables: distances of mandible and landmarks between model and capture, on training and held-out data."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array
from jawusd.evaluator.authoring import error_growth_at
from jawusd.evaluator.models import JawModelForm
from jawusd.fitting.data import FittedForm, TrainingData
from jawusd.formats.model import error_table
from jawusd.formats.notes import ErrorTable
from jawusd.geometry import LANDMARKS, transform_point

Refit = Callable[[TrainingData], FittedForm]

# Fraction of held-out errors, weighted by reach, that are below their quantile at the expected growth; and this
# quantile relative to the rms error for three normally distributed coordinates.
_BELOW, _LARGEST_RMS = 0.9, 1.443
_USUAL_GROWTH = 1.0  # growth of errors per mm of reach, relative to the rms error of training frames [1/mm]
_OWN = 0.75  # weight of the growth that a take shows itself, on a logarithmic scale
_SLOWEST_GROWTH = 0.01  # minimum growth of errors with reach [mm/mm]
_SMALLEST_MM = 1e-6  # a smaller reach is treated as this one


def pose_errors(data: TrainingData, model: Array) -> dict[str, Array]:
    """Return distances (N,) [mm] between model (N, 4, 4) and data by landmark; "mandible" is its farthest vertex."""
    errors = {"mandible": data.metric.largest(model, data.motion)}
    for name, point in zip(LANDMARKS, data.landmarks, strict=True):
        errors[name] = np.linalg.norm(transform_point(model, point) - transform_point(data.motion, point), axis=-1)
    return errors


def seen_errors(data: TrainingData, form: FittedForm) -> dict[str, ErrorTable]:
    """Return the error tables "train", over the kept frames, and "trimmed", over the other frames if there are any."""
    tables = {"train": error_table(_errors(data.select(form.kept), form))}
    if not form.kept.all():
        tables["trimmed"] = error_table(_errors(data.select(~form.kept), form))
    return tables


def unseen_errors(
    data: TrainingData, form: FittedForm, folds: int, refit: Refit, notify: Callable[[int], None]
) -> tuple[ErrorTable, dict[str, dict[str, float]], Array]:
    """Cross-validate: hold out contiguous parts of a take in turn, refit, and measure the error on the held-out parts.

    Args:
        form: the fit to all frames; only the errors of frames that it did not trim count.
        notify: called with the index of each part before it is processed.

    Returns:
        The error table; the growth of the errors away from the training poses, for each landmark and the mandible, as
        coefficients base_mm and per_mm of `jawusd.evaluator.authoring.error_growth_at`; and the rms landmark error of
        every held-out frame [mm], shape (n,).
    """
    fold = np.arange(len(data)) * folds // len(data)
    errors, growths = [], []
    for k in range(folds):
        notify(k)
        seen, unseen = data.select(fold != k), data.select((fold == k) & form.kept)
        if not len(unseen):
            continue
        part = refit(seen)
        errors.append(_errors(unseen, part))
        growths.append(_growth_at(part.model, seen.select(part.kept), unseen))
    pooled = {name: np.concatenate([part[name] for part in errors]) for name in errors[0]}
    factor, reach = np.concatenate(growths, axis=1)
    trained, within = _errors(data.select(form.kept), form), factor == 1.0  # a wider opening has a growth of its own
    growth = {name: _growth(reach[within], values[within], trained[name]) for name, values in pooled.items()}
    rms = np.sqrt(np.mean([pooled[name] ** 2 for name in LANDMARKS], axis=0))
    return error_table(pooled), growth, rms


def _errors(data: TrainingData, form: FittedForm) -> dict[str, Array]:
    return pose_errors(data, data.metric.nearest(form.model, data.motion)[1])


def _growth_at(model: JawModelForm, seen: TrainingData, unseen: TrainingData) -> Array:
    """Return factor and reach [mm] of each held-out frame from the training frames (`error_growth_at`), (2, N)."""
    captured, wanted = (part.metric.nearest(model, part.motion)[0] for part in (seen, unseen))
    captured, wanted = captured[np.isfinite(captured).all(1)], np.nan_to_num(wanted)
    return np.stack(error_growth_at(captured, wanted, cKDTree(captured).query(wanted)[0]))


def _growth(reach: Array, errors: Array, seen: Array) -> dict[str, float]:
    """Return the rms error of training frames, and the growth with reach [mm] that bounds most held-out errors.

    With few frames the growth is uncertain, so it is averaged on a logarithmic scale with a multiple of the rms error.
    """
    base = float(np.sqrt(np.mean(seen**2)))
    usual = found = _USUAL_GROWTH * base
    if len(reach):
        weights = np.maximum(reach, _SMALLEST_MM)
        slopes = np.maximum(errors / _LARGEST_RMS - base, 0.0) / weights
        found = max(float(np.quantile(slopes, _BELOW, weights=weights, method="inverted_cdf")), 0.0)
    return {"base_mm": base, "per_mm": max(found**_OWN * usual ** (1.0 - _OWN), _SLOWEST_GROWTH)}
