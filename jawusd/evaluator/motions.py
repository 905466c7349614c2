"""Many rigid motions at once, column by column: several times faster than products of small matrices."""

from __future__ import annotations

import numpy as np

from jawusd.geometry.arrays import Array
from jawusd.geometry.so3 import angle_coefficients


def motions_from_twists(twists: Array) -> Array:
    """Return the motions (n, 4, 4) of twists (omega [rad], v [mm]), shape (n, 6): what `geometry.se3_exp` does."""
    wx, wy, wz, vx, vy, vz = twists.T
    a, b, c = angle_coefficients(np.sqrt(wx * wx + wy * wy + wz * wz))
    M = _with_rotation(wx, wy, wz, a, b)
    cx, cy, cz = wy * vz - wz * vy, wz * vx - wx * vz, wx * vy - wy * vx
    M[:, 0, 3] = vx + b * cx + c * (wy * cz - wz * cy)
    M[:, 1, 3] = vy + b * cy + c * (wz * cx - wx * cz)
    M[:, 2, 3] = vz + b * cz + c * (wx * cy - wy * cx)
    return M


def anchored_motions(omega: Array, moved: Array, anchor: Array) -> Array:
    """Return the motions (n, 4, 4) that rotate by omega (n, 3) [rad] and carry a point to where it moved.

    Args:
        omega: Rotation vectors [rad], shape (n, 3).
        moved: Where the point goes [mm], shape (n, 3).
        anchor: The point [mm], shape (3,).
    """
    wx, wy, wz = omega.T
    a, b, _ = angle_coefficients(np.sqrt(wx * wx + wy * wy + wz * wz))
    M = _with_rotation(wx, wy, wz, a, b)
    M[:, :3, 3] = moved - (M[:, :3, :3].reshape(-1, 3) @ anchor).reshape(-1, 3)
    return M


def _with_rotation(wx: Array, wy: Array, wz: Array, a: Array, b: Array) -> Array:
    """Return transforms (n, 4, 4) with Rodrigues' rotations, a = sin(angle) / angle, b = (1 - cos(angle)) / angle^2."""
    M = np.zeros((len(wx), 4, 4))
    xx, yy, zz = wx * wx, wy * wy, wz * wz
    ax, ay, az = a * wx, a * wy, a * wz
    bx = b * wx
    xy, xz, yz = bx * wy, bx * wz, b * wy * wz
    M[:, 0, 0], M[:, 0, 1], M[:, 0, 2] = 1.0 - b * (yy + zz), xy - az, xz + ay
    M[:, 1, 0], M[:, 1, 1], M[:, 1, 2] = xy + az, 1.0 - b * (xx + zz), yz - ax
    M[:, 2, 0], M[:, 2, 1], M[:, 2, 2] = xz - ay, yz + ax, 1.0 - b * (xx + yy)
    M[:, 3, 3] = 1.0
    return M
