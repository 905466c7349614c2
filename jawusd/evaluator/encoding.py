"""Encoding: the jaw parameters whose pose is nearest to a measured one, by landmark distance in mm.

The distance between two poses is ``residual_mm = sqrt(mean_k |T l_k - T' l_k|^2)`` over the rig's landmarks l_k. With
their mean c and scatter ``mean (l_k - c)(l_k - c)^T = B B^T`` it is exactly

    residual_mm^2 = |(T - T') (c, 1)|^2 + sum_j |(T - T') (b_j, 0)|^2,

so four vectors carry any number of landmarks. Encoding minimises it by damped Gauss-Newton with the model's analytic
derivatives, from the parameters read off the model itself.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.models import AnchoredModel, JawModelForm
from jawusd.evaluator.solver import Residual, minimise
from jawusd.geometry.se3 import make_transform, se3_inverse, se3_left_jacobian_inverse, se3_log

Array = NDArray[np.float64]
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


class Encoder:
    """Encode motions of the anatomical frame with one model.

    Args:
        model: The jaw model.
        bound: The valid volume, for encoding inside it.
        landmarks: Landmarks of the mandible at rest [mm], anatomical frame, shape (n, 3).
    """

    def __init__(self, model: JawModelForm, bound: SliceHull, landmarks: Array) -> None:
        self._model, self._bound = model, bound
        self._vectors = landmark_vectors(landmarks)

    def residual_mm(self, d: Array, R: Array, t: Array) -> Array:
        """Return the landmark distance [mm] (n,) of M(d), d (n, 3), from motions R (n, 3, 3), t (n, 3)."""
        difference = carried(*self._model.decode(d), self._vectors) - carried(R, t, self._vectors)
        return np.sqrt(np.einsum("nij,nij->n", difference, difference))

    def nearest(self, R: Array, t: Array) -> Array:
        """Return the d (n, 3) [mm] whose motions are nearest to R (n, 3, 3), t (n, 3) [mm]."""
        model, target = self._model, carried(R, t, self._vectors)
        if isinstance(model, AnchoredModel):
            # the nearest pose does not depend on the chart: searching over the incisal displacement spares the gauge
            residual = distance_residual(model.motion_derivative_at, self._vectors, target)
            return model.gauge.inverse(minimise(residual, model.displacement_of(R, t))[0])
        residual = distance_residual(model.decode_derivative, self._vectors, target)
        return minimise(residual, model.read_off(R, t))[0]

    def nearest_valid(self, R: Array, t: Array, start: Array) -> Array:
        """Return the d (n, 3) [mm] inside the bound nearest to motions (R, t), from starts inside it."""
        target = carried(R, t, self._vectors)
        return minimise(distance_residual(self._model.decode_derivative, self._vectors, target), start, self._bound)[0]

    def most_likely(self, R: Array, t: Array, whitening: Array, start: Array, *, bounded: bool) -> Array:
        """Return the most likely d (n, 3) [mm] of noisy motions: the least ``|W xi|^2``, ``(R, t) = exp(xi) M(d)``.

        Args:
            R: Measured rotations, shape (n, 3, 3).
            t: Measured translations [mm], shape (n, 3).
            whitening: W with ``W^T W`` the inverse covariance of xi, (omega, v), shape (n, 6, 6).
            start: First d [mm], shape (n, 3).
            bounded: Stay inside the bound, where the start must then lie.
        """
        measured = make_transform(R, t)

        def residual(d: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
            R_d, t_d, S = self._model.decode_derivative(d)
            xi = se3_log(measured[rows] @ se3_inverse(make_transform(R_d, t_d)))
            W = whitening[rows]
            # exp(xi(d + e)) = exp(xi) exp(-S e), and the right Jacobian is the left one at -xi
            return np.einsum("nij,nj->ni", W, xi), -W @ se3_left_jacobian_inverse(-xi) @ S

        return minimise(residual, start, self._bound if bounded else None)[0]


def carried(R: Array, t: Array, vectors: Array) -> Array:
    """Return the images (n, 3, m) of homogeneous vectors (4, m) under motions R (n, 3, 3), t (n, 3) [mm]."""
    return R @ vectors[:3] + t[:, :, None] * vectors[3]


def distance_residual(derivative: Derivative, vectors: Array, target: Array) -> Residual:
    """Return, for `minimise`, how far motions leave the vectors (4, m) from their targets (n, 3, m)."""
    count = vectors.shape[1]

    def residual(x: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        R, t, S = derivative(x)
        image = carried(R, t, vectors)
        # a vector (b, h) moves by w x image + v h under the spatial velocity (w, v)
        J = np.empty((len(x), 3, count, 3))
        px, py, pz = image[:, 0, :, None], image[:, 1, :, None], image[:, 2, :, None]
        wx, wy, wz = S[:, None, 0], S[:, None, 1], S[:, None, 2]
        v = S[:, 3:, None] * vectors[3][:, None]
        J[:, 0] = wy * pz - wz * py + v[:, 0]
        J[:, 1] = wz * px - wx * pz + v[:, 1]
        J[:, 2] = wx * py - wy * px + v[:, 2]
        return (image - target[rows]).reshape(len(x), 3 * count), J.reshape(len(x), 3 * count, 3)

    return residual
