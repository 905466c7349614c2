"""Distances between images of points under two motions, in the form the solver takes.

Points are homogeneous vectors, one a column: a point is (p, 1), a direction (b, 0).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array, Indices
from jawusd.evaluator.solver import Residual

# x (k, 3) -> rotations (k, 3, 3), translations (k, 3), spatial derivatives (k, 6, 3)
Derivative = Callable[[Array], tuple[Array, Array, Array]]


def landmark_vectors(landmarks: Array) -> Array:
    """Return the four homogeneous vectors (4, 4), one a column, that stand for the landmarks (n, 3) [mm]."""
    centre = landmarks.mean(axis=0)
    scatter = (landmarks - centre).T @ (landmarks - centre) / len(landmarks)
    variance, axes = np.linalg.eigh(scatter)
    vectors = np.zeros((4, 4))
    vectors[:3, :3] = axes * np.sqrt(np.maximum(variance, 0.0))
    vectors[:, 3] = [*centre, 1.0]
    return vectors


def handle_vectors(points: Array, weights: ArrayLike | None) -> Array:
    """Return points (H, 3) [mm] as homogeneous vectors (4, H) scaled so that squared lengths are weighted means.

    Raises:
        ValueError: weights of another shape, negative, not finite or all zero.
    """
    share = np.ones(len(points)) if weights is None else np.asarray(weights, dtype=np.float64)
    if share.shape != (len(points),) or not np.isfinite(share).all() or (share < 0).any() or share.sum() == 0:
        raise ValueError(f"weights must be {len(points)} numbers >= 0, not all zero, got {share.tolist()}")
    return np.column_stack([points, np.ones(len(points))]).T * np.sqrt(share / share.sum())


def carried(R: Array, t: Array, vectors: Array) -> Array:
    """Return the images (n, 3, m) of homogeneous vectors (4, m) under motions R (n, 3, 3), t (n, 3) [mm]."""
    return R @ vectors[:3] + t[:, :, None] * vectors[3]


def point_velocities(R: Array, t: Array, S: Array, points: Array) -> Array:
    """Return the derivatives (n, p, 3, 3) of the images of points (p, 3) [mm] by d.

    Args:
        R: Rotations, shape (n, 3, 3).
        t: Translations [mm], shape (n, 3).
        S: Their spatial derivatives, see `jawusd.evaluator.models`, shape (n, 6, 3).
        points: Points before the motion.
    """
    image = points @ np.swapaxes(R, 1, 2) + t[:, None]
    return np.cross(S[:, None, :3], image[..., None], axis=2) + S[:, None, 3:]


def distance_residual(derivative: Derivative, vectors: Array, target: Array) -> Residual:
    """Return, for `minimise`, how far motions leave the vectors (4, m) from their targets (n, 3, m)."""
    count = vectors.shape[1]

    def residual(x: Array, rows: Indices) -> tuple[Array, Array]:
        R, t, S = derivative(x)
        image = carried(R, t, vectors)
        # a vector (b, h) moves by w x image + v h under the spatial velocity (w, v)
        by_velocity = np.zeros((len(x), 3, count, 6))
        by_velocity[:, 0, :, 1], by_velocity[:, 1, :, 0] = image[:, 2], -image[:, 2]
        by_velocity[:, 1, :, 2], by_velocity[:, 2, :, 1] = image[:, 0], -image[:, 0]
        by_velocity[:, 2, :, 0], by_velocity[:, 0, :, 2] = image[:, 1], -image[:, 1]
        for axis in range(3):
            by_velocity[:, axis, :, 3 + axis] = vectors[3]
        r = (image - target[rows]).reshape(len(x), 3 * count)
        return r, by_velocity.reshape(len(x), 3 * count, 6) @ S

    return residual
