"""Rotations: exponential, logarithm and their Jacobians.

Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), eqs. 132-148.
The logarithm goes through the unit quaternion (Shepperd 1978), which has no loss of digits near 0 or pi.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.geometry.arrays import Array
from jawusd.geometry.quaternion import wxyz_from_matrix

# Below this angle [rad] the series are exact to double precision with the terms kept (next term < 1e-17 relative).
_SMALL_ANGLE_RAD = 1e-2


def hat(w: ArrayLike) -> Array:
    """Return the skew matrix of a vector: ``hat(w) @ p == cross(w, p)``.

    Args:
        w: vectors, shape (..., 3).

    Returns:
        Skew matrices, shape (..., 3, 3).
    """
    w = np.asarray(w, dtype=np.float64)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def vee(W: ArrayLike) -> Array:
    """Return the vector of a skew matrix, the inverse of `hat`.

    Args:
        W: skew matrices, shape (..., 3, 3); the symmetric part is ignored.

    Returns:
        Vectors, shape (..., 3).
    """
    W = np.asarray(W, dtype=np.float64)
    return 0.5 * np.stack(
        [W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]], axis=-1
    )


def angle_coefficients(angle_rad: Array) -> tuple[NDArray, NDArray, NDArray]:
    """Return sin(a)/a, (1-cos a)/a^2 and (a-sin a)/a^3 without cancellation.

    Args:
        angle_rad: angles >= 0 [rad], any shape.

    Returns:
        Three arrays of the same shape.
    """
    a = np.asarray(angle_rad, dtype=np.float64)
    small = a < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, a)
    a2 = a * a
    half = np.sin(0.5 * safe)
    first = np.where(small, 1 + a2 / -6 * (1 - a2 / 20 * (1 - a2 / 42)), np.sin(safe) / safe)
    second = np.where(small, 0.5 - a2 / 24 * (1 - a2 / 30 * (1 - a2 / 56)), 2 * half * half / (safe * safe))
    third = np.where(small, 1 / 6 - a2 / 120 * (1 - a2 / 42 * (1 - a2 / 72)), (safe - np.sin(safe)) / safe**3)
    return first, second, third


def so3_exp(w: ArrayLike) -> Array:
    """Map rotation vectors to rotation matrices (Rodrigues' formula).

    Args:
        w: rotation vectors [rad], shape (..., 3).

    Returns:
        Rotation matrices, shape (..., 3, 3).
    """
    w = np.asarray(w, dtype=np.float64)
    first, second, _ = angle_coefficients(np.linalg.norm(w, axis=-1))
    W = hat(w)
    return np.eye(3) + first[..., None, None] * W + second[..., None, None] * (W @ W)


def so3_log(R: ArrayLike) -> Array:
    """Map rotation matrices to rotation vectors of angle in [0, pi].

    Args:
        R: rotation matrices, shape (..., 3, 3).

    Returns:
        Rotation vectors [rad], shape (..., 3).
    """
    q = wxyz_from_matrix(R)
    norm = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2 * np.arctan2(norm, q[..., 0])
    small = norm < 1e-7
    # angle / norm -> 2 / w for a vanishing vector part; w >= 0 keeps the angle in [0, pi].
    scale = np.where(small, 2.0 / np.where(small, q[..., 0], 1.0), angle / np.where(small, 1.0, norm))
    return scale[..., None] * q[..., 1:]


def so3_left_jacobian(w: ArrayLike) -> Array:
    """Return J with ``exp(w + dw) = exp(J dw) exp(w)`` to first order.

    Args:
        w: rotation vectors [rad], shape (..., 3).

    Returns:
        Left Jacobians, shape (..., 3, 3).
    """
    w = np.asarray(w, dtype=np.float64)
    _, second, third = angle_coefficients(np.linalg.norm(w, axis=-1))
    W = hat(w)
    return np.eye(3) + second[..., None, None] * W + third[..., None, None] * (W @ W)


def so3_right_jacobian(w: ArrayLike) -> Array:
    """Return J with ``exp(w + dw) = exp(w) exp(J dw)`` to first order.

    Args:
        w: rotation vectors [rad], shape (..., 3).

    Returns:
        Right Jacobians, shape (..., 3, 3).
    """
    return so3_left_jacobian(-np.asarray(w, dtype=np.float64))


def so3_left_jacobian_inverse(w: ArrayLike) -> Array:
    """Return the inverse of `so3_left_jacobian` in closed form, for angles below 2 pi.

    Args:
        w: rotation vectors [rad], shape (..., 3).

    Returns:
        Inverse left Jacobians, shape (..., 3, 3).
    """
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
    """Draw rotations uniformly (normalised Gaussian quaternions).

    Args:
        rng: random generator.
        shape: batch shape.

    Returns:
        Rotation matrices, shape (*shape, 3, 3).
    """
    from jawusd.geometry.quaternion import matrix_from_wxyz

    return matrix_from_wxyz(rng.normal(size=(*shape, 4)))
