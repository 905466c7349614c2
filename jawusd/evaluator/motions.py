"""Many rigid motions at once, column by column: several times faster than products of small matrices."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry.rodrigues import Triple, apply_series, dot, turning
from jawusd.geometry.so3 import angle_coefficients


def motions_from_twists(twists: Array) -> Array:
    """Return the motions (n, 4, 4) of twists (omega [rad], v [mm]), shape (n, 6): what `geometry.se3_exp` does."""
    wx, wy, wz, vx, vy, vz = twists.T
    omega = wx, wy, wz
    a, b, c = angle_coefficients(dot(omega, omega))
    M = _with_rotation(omega, a, b)
    M[:, 0, 3], M[:, 1, 3], M[:, 2, 3] = apply_series(omega, (vx, vy, vz), b, c)
    return M


def anchored_motions(omega: Array, moved: Array, anchor: Array) -> Array:
    """Return the motions (n, 4, 4) that rotate by omega (n, 3) [rad] and carry a point to where it moved.

    Args:
        omega: Rotation vectors [rad], shape (n, 3).
        moved: Where the point goes [mm], shape (n, 3).
        anchor: The point [mm], shape (3,).
    """
    wx, wy, wz = omega.T
    a, b, _ = angle_coefficients(dot((wx, wy, wz), (wx, wy, wz)))
    M = _with_rotation((wx, wy, wz), a, b)
    M[:, :3, 3] = moved - (M[:, :3, :3].reshape(-1, 3) @ anchor).reshape(-1, 3)
    return M


def _with_rotation(omega: Triple[Array], a: Array, b: Array) -> Array:
    """Return transforms (n, 4, 4) with the rotations of `turning`."""
    M = np.zeros((len(a), 4, 4))
    for i, row in enumerate(turning(omega, a, b)):
        M[:, i, 0], M[:, i, 1], M[:, i, 2] = row
    M.reshape(-1, 16)[:, ::5] += 1.0
    return M
