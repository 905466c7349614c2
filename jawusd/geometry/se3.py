"""Rigid motions: exponential, logarithm, adjoint and their Jacobians; twists are (omega, v).

Formulas: Solà et al. 2018, section 4 of the appendix, reordered to rotation first; the relative jaw pose is eqs. 1-3
of Yang et al., "Building Anatomically Realistic Jaw Kinematics Model from Data" (2019).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.geometry.so3 import hat, nearest_rotation, so3_exp, so3_left_jacobian, so3_left_jacobian_inverse, so3_log

# Angle a [rad] below which the coupling block uses its series: the relative error of the closed form grows like a^-5.
_COUPLING_SERIES_RAD = 0.3


def make_transform(R: ArrayLike, t: ArrayLike) -> Array:
    """Assemble transforms (..., 4, 4) from rotation matrices (..., 3, 3) and translations (..., 3) [mm]."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    shape = () if R.ndim == 2 and t.ndim == 1 else np.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def se3_inverse(T: ArrayLike) -> Array:
    """Invert rigid transforms (..., 4, 4): ``T_b_a`` from ``T_a_b``."""
    T = np.asarray(T, dtype=np.float64)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return make_transform(Rt, -np.einsum("...ij,...j->...i", Rt, T[..., :3, 3]))


def transform_point(T: ArrayLike, p: ArrayLike) -> Array:
    """Apply transforms (..., 4, 4) to points (..., 3) [mm], one each, ``p_a = T_a_b p_b``, broadcasting both."""
    T, p = np.asarray(T, dtype=np.float64), np.asarray(p, dtype=np.float64)
    return np.einsum("...ij,...j->...i", T[..., :3, :3], p) + T[..., :3, 3]


def transform_points(T: ArrayLike, points: ArrayLike) -> Array:
    """Apply each transform (..., 4, 4) to all points (N, 3) [mm], ``p_a = T_a_b p_b``, shape (..., N, 3).

    With points (..., N, 3), one set per transform, the leading axes are broadcast.

    Raises:
        ValueError: the argument is a single point; see `transform_point`.
    """
    T, points = np.asarray(T, dtype=np.float64), np.asarray(points, dtype=np.float64)
    if points.ndim < 2:
        raise ValueError(f"points must have shape (..., N, 3), got {points.shape}")
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def relative_pose(T_world_upper: ArrayLike, T_world_lower: ArrayLike) -> Array:
    """Return T_skull_mandible from the world poses (..., 4, 4) of the upper and lower teeth (Yang et al. eqs. 1-3)."""
    return se3_inverse(T_world_upper) @ np.asarray(T_world_lower, dtype=np.float64)


def _coupling(w: Array, v: Array) -> Array:
    """Return the block Q(w, v) of the left Jacobian of SE(3) (Barfoot 2017, eq. 7.86; Solà et al. eq. 180)."""
    W, V = hat(w), hat(v)
    a = np.linalg.norm(w, axis=-1)[..., None, None]
    small = a < _COUPLING_SERIES_RAD
    s = np.where(small, 1.0, a)
    a2 = a * a
    c1 = np.where(small, 1 / 6 - a2 / 120 * (1 - a2 / 42 * (1 - a2 / 72 * (1 - a2 / 110))), (s - np.sin(s)) / s**3)
    c2 = np.where(
        small,
        1 / 24 - a2 / 720 * (1 - a2 / 56 * (1 - a2 / 90 * (1 - a2 / 132))),
        (s * s / 2 + np.cos(s) - 1) / s**4,
    )
    # the literature's (c2 - 3 (s - sin s - s^3/6)/s^5)/2, whose c2 and c3 have the opposite signs
    c3 = np.where(
        small,
        1 / 120 - a2 / 2520 * (1 - a2 / 48 * (1 - 2 * a2 / 165)),
        0.5 * ((s * s / 2 + np.cos(s) - 1) / s**4 - 3 * (s**3 / 6 - s + np.sin(s)) / s**5),
    )
    WV, VW = W @ V, V @ W
    WVW = WV @ W
    return 0.5 * V + c1 * (WV + VW + WVW) + c2 * (W @ WV + VW @ W - 3 * WVW) + c3 * (WVW @ W + W @ WVW)


def se3_left_jacobian(twist: ArrayLike) -> Array:
    """Return J (..., 6, 6) with ``exp(twist + d) = exp(J d) exp(twist)`` to first order, for twists (..., 6)."""
    twist = np.asarray(twist, dtype=np.float64)
    w, v = twist[..., :3], twist[..., 3:]
    J = np.zeros((*twist.shape[:-1], 6, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = so3_left_jacobian(w)
    J[..., 3:, :3] = _coupling(w, v)
    return J


def se3_left_jacobian_inverse(twist: ArrayLike) -> Array:
    """Return the inverse of `se3_left_jacobian`, shape (..., 6, 6)."""
    twist = np.asarray(twist, dtype=np.float64)
    w, v = twist[..., :3], twist[..., 3:]
    Ji = so3_left_jacobian_inverse(w)
    out = np.zeros((*twist.shape[:-1], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = Ji
    out[..., 3:, :3] = -Ji @ _coupling(w, v) @ Ji
    return out


def se3_exp(twist: ArrayLike) -> Array:
    """Map twists (omega [rad], v [mm]), shape (..., 6), to rigid transforms (..., 4, 4).

    Raises:
        ValueError: the array has the wrong shape.
    """
    twist = np.asarray(twist, dtype=np.float64)
    if twist.shape[-1:] != (6,):
        raise ValueError(f"twists must have shape (..., 6), got {twist.shape}")
    w, v = twist[..., :3], twist[..., 3:]
    return make_transform(so3_exp(w), np.einsum("...ij,...j->...i", so3_left_jacobian(w), v))


def se3_log(T: ArrayLike) -> Array:
    """Map rigid transforms (..., 4, 4) to twists (omega [rad], v [mm]), shape (..., 6), of rotation angle in [0, pi].

    Raises:
        ValueError: the array has the wrong shape.
    """
    T = np.asarray(T, dtype=np.float64)
    if T.shape[-2:] != (4, 4):
        raise ValueError(f"transforms must have shape (..., 4, 4), got {T.shape}")
    w = so3_log(T[..., :3, :3])
    v = np.einsum("...ij,...j->...i", so3_left_jacobian_inverse(w), T[..., :3, 3])
    return np.concatenate([w, v], axis=-1)


def se3_adjoint(T: ArrayLike) -> Array:
    """Return Ad(T), shape (..., 6, 6) in (omega, v) order, with ``T exp(x) T^-1 = exp(Ad(T) x)``."""
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = hat(T[..., :3, 3]) @ R
    return out


def orthonormalise(T: ArrayLike) -> Array:
    """Return the rigid transforms nearest to matrices (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    return make_transform(nearest_rotation(T[..., :3, :3]), T[..., :3, 3])


def rigidity_defect(T: ArrayLike) -> Array:
    """Return the deviation of transforms (..., 4, 4) from rigidity, shape (...).

    It is the largest absolute entry of R R^T - I and of the error of the bottom row, and at least 2 for reflections.
    """
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    defect = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max((-1, -2))
    defect = np.maximum(defect, np.abs(T[..., 3, :] - np.array([0.0, 0.0, 0.0, 1.0])).max(-1))
    return np.where(np.linalg.det(R) < 0, np.maximum(defect, 2.0), defect)
