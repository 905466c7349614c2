"""Encoding: the jaw parameters whose pose is nearest to a measured one, by landmark distance in mm.

The distance between two poses is ``residual_mm = sqrt(mean_k |T l_k - T' l_k|^2)`` over the rig's landmarks l_k. With
their mean c and scatter ``mean (l_k - c)(l_k - c)^T = B B^T`` it is exactly

    residual_mm^2 = |(T - T') (c, 1)|^2 + sum_j |(T - T') (b_j, 0)|^2,

so four vectors carry any number of landmarks. Encoding minimises it by damped Gauss-Newton with the model's analytic
derivatives, from the parameters read off the model itself.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.evaluator.models import AnchoredModel, JawModelForm
from jawusd.evaluator.solver import Bound, minimise
from jawusd.geometry.se3 import make_transform, se3_inverse, se3_left_jacobian_inverse, se3_log

Array = NDArray[np.float64]


def landmark_vectors(landmarks: Array) -> Array:
    """Return the four homogeneous vectors (4, 4), one a column, that stand for the landmarks (n, 3) [mm]."""
    centre = landmarks.mean(axis=0)
    scatter = (landmarks - centre).T @ (landmarks - centre) / len(landmarks)
    variance, axes = np.linalg.eigh(scatter)
    vectors = np.zeros((4, 4))
    vectors[:3, :3] = axes * np.sqrt(np.maximum(variance, 0.0))
    vectors[:, 3] = [*centre, 1.0]
    return vectors


def landmark_distance(R: Array, t: Array, R_other: Array, t_other: Array, vectors: Array) -> Array:
    """Return the rms landmark distance [mm] between motions, shape (n,)."""
    difference = _carried(R, t, vectors) - _carried(R_other, t_other, vectors)
    return np.sqrt(np.einsum("nij,nij->n", difference, difference))


def encode_nearest(model: JawModelForm, vectors: Array, R: Array, t: Array) -> Array:
    """Return the d (n, 3) [mm] whose motions are nearest to (R, t) by landmark distance.

    Args:
        model: The jaw model.
        vectors: Of the landmarks, see `landmark_vectors`, anatomical frame at rest.
        R: Measured rotations, shape (n, 3, 3).
        t: Measured translations [mm], shape (n, 3).
    """
    target = _carried(R, t, vectors)
    if isinstance(model, AnchoredModel):
        # the nearest pose does not depend on the chart: searching over the incisal displacement spares the gauge
        u, _ = minimise(_distance_residual(model.motion_derivative_at, vectors, target), model.displacement_of(R, t))
        return model.gauge.inverse(u)
    return minimise(_distance_residual(model.decode_derivative, vectors, target), model.read_off(R, t))[0]


def encode_nearest_valid(model: JawModelForm, vectors: Array, R: Array, t: Array, start: Array, bound: Bound) -> Array:
    """Return the d (n, 3) [mm] inside the bound whose motions are nearest to (R, t), from starts inside it."""
    residual = _distance_residual(model.decode_derivative, vectors, _carried(R, t, vectors))
    return minimise(residual, start, bound)[0]


def encode_weighted(
    model: JawModelForm, R: Array, t: Array, whitening: Array, start: Array, bound: Bound | None = None
) -> Array:
    """Return the most likely d (n, 3) [mm] of noisy motions.

    Minimises ``|W xi|^2`` with ``(R, t) = exp(xi) M(d)``.

    Args:
        model: The jaw model.
        R: Measured rotations, shape (n, 3, 3).
        t: Measured translations [mm], shape (n, 3).
        whitening: W with ``W^T W`` the inverse covariance of xi, (omega, v), shape (n, 6, 6).
        start: First d [mm], shape (n, 3), inside the bound if there is one.
        bound: Where d must stay.
    """
    measured = make_transform(R, t)

    def residual(d: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        R_d, t_d, S = model.decode_derivative(d)
        xi = se3_log(measured[rows] @ se3_inverse(make_transform(R_d, t_d)))
        W = whitening[rows]
        # exp(xi(d + e)) = exp(xi) exp(-S e), and the right Jacobian is the left one at -xi
        return np.einsum("nij,nj->ni", W, xi), -W @ se3_left_jacobian_inverse(-xi) @ S

    return minimise(residual, start, bound)[0]


def _carried(R: Array, t: Array, vectors: Array) -> Array:
    """Return the images (n, 3, 4) of the four vectors under the motions."""
    return R @ vectors[:3] + t[:, :, None] * vectors[3]


def _distance_residual(derivative, vectors: Array, target: Array):
    """Return the residual function of the landmark distance for `minimise`."""

    def residual(x: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        R, t, S = derivative(x)
        image = _carried(R, t, vectors)
        # a vector (b, h) moves by w x image + v h under the spatial velocity (w, v)
        J = np.empty((len(x), 3, 4, 3))
        px, py, pz = image[:, 0, :, None], image[:, 1, :, None], image[:, 2, :, None]
        wx, wy, wz = S[:, None, 0], S[:, None, 1], S[:, None, 2]
        v = S[:, 3:, None] * vectors[3][:, None]
        J[:, 0] = wy * pz - wz * py + v[:, 0]
        J[:, 1] = wz * px - wx * pz + v[:, 1]
        J[:, 2] = wx * py - wy * px + v[:, 2]
        return (image - target[rows]).reshape(len(x), 12), J.reshape(len(x), 12, 3)

    return residual
