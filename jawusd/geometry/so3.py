"""Rotations: exponential, logarithm and their Jacobians.

Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), eqs. 132-148.
The logarithm goes through the unit quaternion (Shepperd 1978), which has no loss of digits near 0 or pi.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jawusd.geometry.arrays import Array
from jawusd.geometry.quaternion import matrix_from_wxyz, wxyz_from_matrix
from jawusd.geometry.rodrigues import SMALL_SQUARED_ANGLE, angle_quotients, angle_series

_SMALL_ANGLE_RAD = SMALL_SQUARED_ANGLE**0.5


def hat(w: ArrayLike) -> Array:
    """Return the skew matrices (..., 3, 3) of vectors (..., 3): ``hat(w) @ p == cross(w, p)``."""
    w = np.asarray(w, dtype=np.float64)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def vee(W: ArrayLike) -> Array:
    """Return the vectors (..., 3) of skew matrices (..., 3, 3), the inverse of `hat`; symmetric parts are ignored."""
    W = np.asarray(W, dtype=np.float64)
    return 0.5 * np.stack(
        [W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]], axis=-1
    )


def angle_coefficients(angle_rad: Array) -> tuple[Array, Array, Array]:
    """Return sin(a)/a, (1-cos a)/a^2 and (a-sin a)/a^3 of angles >= 0 [rad], without cancellation."""
    small = angle_rad < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle_rad)
    near = angle_series(angle_rad * angle_rad)
    far = angle_quotients(safe * safe, safe, np.sin(safe), np.sin(0.5 * safe))
    return np.where(small, near[0], far[0]), np.where(small, near[1], far[1]), np.where(small, near[2], far[2])


def so3_exp(w: ArrayLike) -> Array:
    """Map rotation vectors (..., 3) [rad] to rotation matrices (..., 3, 3) (Rodrigues' formula)."""
    w = np.asarray(w, dtype=np.float64)
    first, second, _ = angle_coefficients(np.linalg.norm(w, axis=-1))
    W = hat(w)
    return np.eye(3) + first[..., None, None] * W + second[..., None, None] * (W @ W)


def so3_log(R: ArrayLike) -> Array:
    """Map rotation matrices (..., 3, 3) to rotation vectors (..., 3) [rad] of angle in [0, pi]."""
    q = wxyz_from_matrix(R)
    norm = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2 * np.arctan2(norm, q[..., 0])
    small = norm < 1e-7
    # angle / norm -> 2 / w for a vanishing vector part; w >= 0 keeps the angle in [0, pi].
    scale = np.where(small, 2.0 / np.where(small, q[..., 0], 1.0), angle / np.where(small, 1.0, norm))
    return scale[..., None] * q[..., 1:]


def so3_left_jacobian(w: ArrayLike) -> Array:
    """Return J (..., 3, 3) with ``exp(w + dw) = exp(J dw) exp(w)`` to first order, for w (..., 3) [rad]."""
    w = np.asarray(w, dtype=np.float64)
    _, second, third = angle_coefficients(np.linalg.norm(w, axis=-1))
    W = hat(w)
    return np.eye(3) + second[..., None, None] * W + third[..., None, None] * (W @ W)


def so3_right_jacobian(w: ArrayLike) -> Array:
    """Return J (..., 3, 3) with ``exp(w + dw) = exp(w) exp(J dw)`` to first order, for w (..., 3) [rad]."""
    return so3_left_jacobian(-np.asarray(w, dtype=np.float64))


def so3_left_jacobian_inverse(w: ArrayLike) -> Array:
    """Return the inverse of `so3_left_jacobian` in closed form, for angles below 2 pi."""
    w = np.asarray(w, dtype=np.float64)
    a = np.linalg.norm(w, axis=-1)
    small = a < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, a)
    a2 = a * a
    # (1 - (a/2) cot(a/2)) / a^2, the even function of the closed form.
    factor = np.where(
        small,
        1 / 12 + a2 / 720 * (1 + a2 / 42),
        (1 - 0.5 * safe / np.tan(0.5 * safe)) / (safe * safe),
    )
    W = hat(w)
    return np.eye(3) - 0.5 * W + factor[..., None, None] * (W @ W)


def random_rotation(rng: np.random.Generator, shape: tuple[int, ...] = ()) -> Array:
    """Draw rotations (*shape, 3, 3) uniformly (normalised Gaussian quaternions)."""
    return matrix_from_wxyz(rng.normal(size=(*shape, 4)))
