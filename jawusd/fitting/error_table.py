"""Error tables: how far a model is from captured poses, in mm on the mandible and at the landmarks."""

from __future__ import annotations

import numpy as np

from jawusd.fitting.data import TrainingData
from jawusd.geometry import LANDMARKS, transform_point
from jawusd.geometry.arrays import Array


def pose_errors(data: TrainingData, model: Array) -> dict[str, Array]:
    """Return the errors of every frame.

    Args:
        data: captured poses.
        model: motions the model gives for them, shape (N, 4, 4).

    Returns:
        "mandible" (largest vertex distance) and each landmark to distances [mm], shape (N,).
    """
    errors = {"mandible": data.metric.largest(model, data.motion)}
    for name, point in zip(LANDMARKS, data.landmarks, strict=True):
        errors[name] = np.linalg.norm(transform_point(model, point) - transform_point(data.motion, point), axis=-1)
    return errors


def summarise(errors: dict[str, Array]) -> dict[str, dict[str, float]]:
    """Return mean, median, p95 and max of each column [mm], and the number of frames."""
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


def join(parts: list[dict[str, Array]]) -> dict[str, Array]:
    """Return the errors of several sets of frames as one set."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
