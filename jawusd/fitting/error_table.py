"""Error tables: distances of mandible and landmarks between model and capture, on training and held-out data."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import eye_array, hstack
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator.models import JawModelForm
from jawusd.fitting.data import FittedForm, TrainingData
from jawusd.geometry import LANDMARKS, transform_point

Refit = Callable[[TrainingData], FittedForm]
#: Mean, median, p95, max [mm] and number of frames, by landmark or "mandible".
ErrorTable = dict[str, dict[str, float]]

# Fraction of errors below two standard deviations; above 95 %, since new exercises are farther away.
_INSIDE_TWO_SD = 0.97
_SLOWEST_GROWTH = 0.01  # minimum growth of errors with distance [mm/mm], used even if held-out errors do not grow


def pose_errors(data: TrainingData, model: Array) -> dict[str, Array]:
    """Return the errors of every frame for the motions (N, 4, 4) of a model.

    Returns:
        Distances [mm], shape (N,), by landmark; "mandible" is the distance of the vertex that is farthest off.
    """
    errors = {"mandible": data.metric.largest(model, data.motion)}
    for name, point in zip(LANDMARKS, data.landmarks, strict=True):
        errors[name] = np.linalg.norm(transform_point(model, point) - transform_point(data.motion, point), axis=-1)
    return errors


def summarise(errors: dict[str, Array]) -> ErrorTable:
    """Return the error table for columns of per-frame errors [mm]; empty columns are omitted."""
    return {
        name: {
            "mean": float(values.mean()),
            "median": float(np.median(values)),
            "p95": float(np.percentile(values, 95)),
            "max": float(values.max()),
            "frames": len(values),
        }
        for name, values in errors.items()
        if len(values)
    }


def seen_errors(data: TrainingData, form: FittedForm) -> dict[str, ErrorTable]:
    """Return the error tables "train", over the kept frames, and "trimmed", over the other frames if there are any."""
    tables = {"train": summarise(_errors(data.select(form.kept), form))}
    if not form.kept.all():
        tables["trimmed"] = summarise(_errors(data.select(~form.kept), form))
    return tables


def unseen_errors(
    data: TrainingData, kept: Mask, folds: int, refit: Refit, notify: Callable[[int], None]
) -> tuple[ErrorTable, dict[str, dict[str, float]], Array]:
    """Cross-validate: hold out contiguous parts of a take in turn, refit, and measure the error on the held-out parts.

    Args:
        kept: frames whose errors count, shape (N,); these are the frames that the fit to all frames did not trim.
        notify: called with the index of each part before it is processed.

    Returns:
        The error table; the growth of the errors with the distance of a pose's parameters from the training poses: for
        each landmark and the mandible, sd = base_mm + per_mm * captured_distance, such that 97 % of the held-out errors
        are below two sd; and the rms landmark error of every held-out frame [mm], shape (n,).
    """
    fold = np.arange(len(data)) * folds // len(data)
    errors, distances = [], []
    for k in range(folds):
        notify(k)
        seen, unseen = data.select(fold != k), data.select((fold == k) & kept)
        if not len(unseen):
            continue
        form = refit(seen)
        errors.append(_errors(unseen, form))
        distances.append(_distance(form.model, seen.select(form.kept), unseen))
    pooled = {name: np.concatenate([part[name] for part in errors]) for name in errors[0]}
    distance = np.concatenate(distances)
    growth = {name: _growth(distance, values) for name, values in pooled.items()}
    rms = np.sqrt(np.mean([pooled[name] ** 2 for name in LANDMARKS], axis=0))
    return summarise(pooled), growth, rms


def _errors(data: TrainingData, form: FittedForm) -> dict[str, Array]:
    return pose_errors(data, data.metric.nearest(form.model, data.motion)[1])


def _distance(model: JawModelForm, seen: TrainingData, unseen: TrainingData) -> Array:
    """Return the distance [mm] of each held-out frame's parameters from those of the nearest training frame, (N,)."""
    captured, wanted = (part.metric.nearest(model, part.motion)[0] for part in (seen, unseen))
    return cKDTree(captured[np.isfinite(captured).all(1)]).query(np.nan_to_num(wanted))[0]


def _growth(distance: Array, errors: Array) -> dict[str, float]:
    """Fit half the 97 % quantile of errors by an increasing linear function of distance (Koenker & Bassett 1978)."""
    count = len(errors)
    above, below = np.full(count, _INSIDE_TWO_SD), np.full(count, 1 - _INSIDE_TWO_SD)
    cost = np.concatenate([[0.0, 0.0], above, below])
    # The matrices are sparse, since two dense identity matrices for 20,000 frames would need 6 GB.
    one = eye_array(count, format="csc")
    equal = hstack([np.column_stack([np.ones(count), distance]), one, -one], format="csc")
    limits = [(0, None), (_SLOWEST_GROWTH, None)] + [(0, None)] * (2 * count)
    found = linprog(cost, A_eq=equal, b_eq=errors / 2, bounds=limits, method="highs")
    return {"base_mm": float(found.x[0]), "per_mm": float(found.x[1])}
