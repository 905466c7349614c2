"""Rotations: exponential, logarithm and their Jacobians.

Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), eqs. 132-148.
The logarithm uses the unit quaternion (Shepperd 1978), which is accurate near 0 and pi.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.geometry import rodrigues
from jawusd.geometry.quaternion import matrix_from_wxyz, wxyz_from_matrix
from jawusd.geometry.rodrigues import SMALL_SQUARED_ANGLE, angle_quotients, angle_series, turning


def hat(w: ArrayLike) -> Array:
    """Return the skew matrices (..., 3, 3) of vectors (..., 3): ``hat(w) @ p == cross(w, p)``."""
    w = np.asarray(w, dtype=np.float64)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def vee(W: ArrayLike) -> Array:
    """Return the vectors (..., 3) of matrices (..., 3, 3), the inverse of `hat`; the symmetric part is ignored."""
    W = np.asarray(W, dtype=np.float64)
    return 0.5 * np.stack(
        [W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]], axis=-1
    )


def batched_angle_coefficients(squared: Array) -> tuple[Array, Array, Array]:
    """Return the coefficients a, b and c of `jawusd.geometry.rodrigues` at squared angles [rad^2] of any shape."""
    if np.ndim(squared) == 0 and squared < np.inf:  # one rotation: floats avoid the call overhead of numpy
        a, b, c = map(np.asarray, rodrigues.angle_coefficients(float(squared)))
        return a, b, c
    small = squared < SMALL_SQUARED_ANGLE
    safe = np.where(small, 1.0, squared)
    angle = np.sqrt(safe)
    series, quotients = angle_series(squared), angle_quotients(safe, angle, np.sin(angle), np.sin(0.5 * angle))
    a, b, c = (np.where(small, near, far) for near, far in zip(series, quotients))
    return a, b, c


def _series(w: Array, first: Array | float, second: Array | float) -> Array:
    """Return ``I + first W + second W W``, W = hat(w), shape (..., 3, 3)."""
    if w.ndim == 1:
        p, q, r = w.tolist()
        return np.array(turning((p, q, r), float(first), float(second))) + np.eye(3)
    x, y, z = np.moveaxis(w, -1, 0)
    out = np.empty((*w.shape[:-1], 3, 3))
    for i, row in enumerate(turning((x, y, z), first, second)):
        for k, entry in enumerate(row):
            out[..., i, k] = entry
    return out + np.eye(3)


def so3_exp(w: ArrayLike) -> Array:
    """Map rotation vectors (..., 3) [rad] to rotation matrices (..., 3, 3) (Rodrigues' formula)."""
    w = np.asarray(w, dtype=np.float64)
    a, b, _ = batched_angle_coefficients(np.einsum("...i,...i->...", w, w))
    return _series(w, a, b)


def so3_log(R: ArrayLike) -> Array:
    """Map rotation matrices (..., 3, 3) to rotation vectors [rad] (..., 3), of angles in [0, pi]."""
    q = wxyz_from_matrix(R)
    norm = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2 * np.arctan2(norm, q[..., 0])
    small = norm < 1e-7
    # angle / norm -> 2 / w for a vanishing vector part; w >= 0 keeps the angle in [0, pi]
    scale = np.where(small, 2.0 / np.where(small, q[..., 0], 1.0), angle / np.where(small, 1.0, norm))
    return scale[..., None] * q[..., 1:]


def so3_left_jacobian(w: ArrayLike) -> Array:
    """Return J (..., 3, 3) with ``exp(w + dw) = exp(J dw) exp(w)`` to first order, for w (..., 3) [rad]."""
    w = np.asarray(w, dtype=np.float64)
    _, b, c = batched_angle_coefficients(np.einsum("...i,...i->...", w, w))
    return _series(w, b, c)


def so3_right_jacobian(w: ArrayLike) -> Array:
    """Return J (..., 3, 3) with ``exp(w + dw) = exp(w) exp(J dw)`` to first order, for w (..., 3) [rad]."""
    return so3_left_jacobian(-np.asarray(w, dtype=np.float64))


def so3_left_jacobian_inverse(w: ArrayLike) -> Array:
    """Return the inverse (..., 3, 3) of `so3_left_jacobian` in closed form, for angles below 2 pi."""
    w = np.asarray(w, dtype=np.float64)
    x = np.einsum("...i,...i->...", w, w)
    small = x < SMALL_SQUARED_ANGLE
    safe = np.where(small, 1.0, x)
    half = 0.5 * np.sqrt(safe)
    # (1 - (a/2) cot(a/2)) / a^2, the even function in the closed form
    factor = np.where(small, 1 / 12 + x / 720 * (1 + x / 42), (1 - half / np.tan(half)) / safe)
    return _series(w, -0.5, factor)


def random_rotation(rng: np.random.Generator, shape: tuple[int, ...] = ()) -> Array:
    """Draw rotation matrices (*shape, 3, 3) uniformly (normalised Gaussian quaternions)."""
    return matrix_from_wxyz(rng.normal(size=(*shape, 4)))
