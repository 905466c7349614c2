"""Error tables: how far a model is from captured poses, in mm on the mandible and at the landmarks, seen and unseen."""

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
#: Mean, median, p95, max [mm] and number of frames of each column.
ErrorTable = dict[str, dict[str, float]]

_INSIDE_TWO_SD = 0.97  # of left-out frames: poses of other exercises lie farther out, 95 % of them are meant
_SLOWEST_GROWTH = 0.01  # mm per mm: errors grow with distance even if no left-out frame lay far from the captured ones


def pose_errors(data: TrainingData, model: Array) -> dict[str, Array]:
    """Return the errors of every frame, given the motions (N, 4, 4) of a model for them.

    Returns:
        "mandible" (largest vertex distance) and each landmark to distances [mm], shape (N,).
    """
    errors = {"mandible": data.metric.largest(model, data.motion)}
    for name, point in zip(LANDMARKS, data.landmarks, strict=True):
        errors[name] = np.linalg.norm(transform_point(model, point) - transform_point(data.motion, point), axis=-1)
    return errors


def summarise(errors: dict[str, Array]) -> ErrorTable:
    """Return the error table of the errors of every frame [mm], by column; columns without frames are left out."""
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
    """Return the error tables "train", over the frames that were kept, and "trimmed", if there are any others."""
    tables = {"train": summarise(_errors(data.select(form.kept), form))}
    if not form.kept.all():
        tables["trimmed"] = summarise(_errors(data.select(~form.kept), form))
    return tables


def unseen_errors(
    data: TrainingData, kept: Mask, folds: int, refit: Refit, notify: Callable[[int], None]
) -> tuple[ErrorTable, dict[str, dict[str, float]], Array]:
    """Leave out contiguous parts of a take in turn, refit, and measure the error on them.

    Args:
        kept: frames that count, shape (N,): those the fit to all did not trim.
        notify: called with the number of each part.

    Returns:
        The error table; how the errors grow with the distance of a pose's parameters from the captured ones: for every
        landmark and the mandible, sd = base_mm + per_mm * captured_distance, such that 97 % of the left-out errors are
        below two sd; and the rms landmark error of every left-out frame [mm], shape (n,).
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
    """Return the distance of each unseen frame's parameters to the nearest seen ones [mm], shape (N,)."""
    captured, wanted = (part.metric.nearest(model, part.motion)[0] for part in (seen, unseen))
    return cKDTree(captured[np.isfinite(captured).all(1)]).query(np.nan_to_num(wanted))[0]


def _growth(distance: Array, errors: Array) -> dict[str, float]:
    """Fit half the 97 % quantile of errors as a straight, rising function of distance (Koenker & Bassett 1978)."""
    count = len(errors)
    above, below = np.full(count, _INSIDE_TWO_SD), np.full(count, 1 - _INSIDE_TWO_SD)
    cost = np.concatenate([[0.0, 0.0], above, below])
    # Sparse: dense, the two unit matrices of a take of 20,000 frames would take 6 GB.
    one = eye_array(count, format="csc")
    equal = hstack([np.column_stack([np.ones(count), distance]), one, -one], format="csc")
    limits = [(0, None), (_SLOWEST_GROWTH, None)] + [(0, None)] * (2 * count)
    found = linprog(cost, A_eq=equal, b_eq=errors / 2, bounds=limits, method="highs")
    return {"base_mm": float(found.x[0]), "per_mm": float(found.x[1])}
