"""Rotations: exponential, logarithm and their Jacobians; unit quaternions, real part first (w, x, y, z).

Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), eqs. 132-148.
The logarithm uses the unit quaternion (Shepperd 1978), which is accurate near 0 and pi.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.geometry import rodrigues
from jawusd.geometry.rodrigues import SMALL_SQUARED_ANGLE, N, angle_quotients, angle_series, turning


def wxyz_from_matrix(R: ArrayLike) -> Array:
    """Return the unit quaternions (..., 4) with w >= 0 of rotation matrices (..., 3, 3) (Shepperd 1978).

    Raises:
        ValueError: the array has the wrong shape.
    """
    R = np.asarray(R, dtype=np.float64)
    if R.shape[-2:] != (3, 3):
        raise ValueError(f"rotation matrices must have shape (..., 3, 3), got {R.shape}")
    if R.ndim == 2:
        one = _multiples(R.tolist())
        row = max(range(4), key=lambda i: one[i][i])
        found = np.array(one[row]) / math.hypot(*one[row])
        return -found if found[0] < 0 else found
    outer: Array = np.moveaxis(np.array(_multiples(np.moveaxis(R, (-2, -1), (0, 1)))), (0, 1), (-2, -1))
    best = np.argmax(np.einsum("...ii->...i", outer), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def _multiples(R: Sequence[Sequence[N]] | Array) -> list[list[N]]:
    """Return 4 q q^T from rows of matrix entries; the row with the largest diagonal entry is free of cancellation."""
    a, b, c = R[0][0], R[1][1], R[2][2]
    x, y, z = R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]
    xy, xz, yz = R[1][0] + R[0][1], R[0][2] + R[2][0], R[2][1] + R[1][2]
    trace = a + b + c
    return [
        [1 + trace, x, y, z],
        [x, 1 - trace + 2 * a, xy, xz],
        [y, xy, 1 - trace + 2 * b, yz],
        [z, xz, yz, 1 - trace + 2 * c],
    ]


def continuous_wxyz(R: ArrayLike) -> Array:
    """Return the unit quaternions (n, 4) of rotations (n, 3, 3), of continuous sign for interpolation by component."""
    wxyz = wxyz_from_matrix(R)
    if len(wxyz) > 1:
        turn = np.where(np.einsum("ij,ij->i", wxyz[1:], wxyz[:-1]) < 0, -1.0, 1.0)
        wxyz = wxyz * np.concatenate([[1.0], np.cumprod(turn)])[:, None]
    return wxyz


def matrix_from_wxyz(q: ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4), which are normalised first.

    Raises:
        ValueError: the array has the wrong shape.
    """
    unit: Array = np.asarray(q, dtype=np.float64)
    if unit.shape[-1:] != (4,):
        raise ValueError(f"quaternions must have shape (..., 4), got {unit.shape}")
    unit = unit / np.linalg.norm(unit, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(unit, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def hat(w: ArrayLike) -> Array:
    """Return the skew matrices (..., 3, 3) of vectors (..., 3): ``hat(w) @ p == cross(w, p)``."""
    w = np.asarray(w, dtype=np.float64)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


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


def nearest_rotation(M: Array) -> Array:
    """Return the rotations (..., 3, 3) nearest to matrices (..., 3, 3) (Kabsch 1976, Arun et al. 1987)."""
    U, _, Vt = np.linalg.svd(M)
    sign = np.ones((*M.shape[:-2], 1, 3))
    sign[..., 0, 2] = np.sign(np.linalg.det(U @ Vt))
    return (U * sign) @ Vt


def random_rotation(rng: np.random.Generator, shape: tuple[int, ...] = ()) -> Array:
    """Draw rotation matrices (*shape, 3, 3) uniformly (normalised Gaussian quaternions)."""
    return matrix_from_wxyz(rng.normal(size=(*shape, 4)))
