"""Unit quaternions, real part first (w, x, y, z)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jawusd.geometry.arrays import Array


def wxyz_from_matrix(R: ArrayLike) -> Array:
    """Return the unit quaternions (..., 4) with w >= 0 of rotation matrices (..., 3, 3) (Shepperd 1978).

    Raises:
        ValueError: another shape.
    """
    R = np.asarray(R, dtype=np.float64)
    if R.shape[-2:] != (3, 3):
        raise ValueError(f"rotation matrices must have shape (..., 3, 3), got {R.shape}")
    diagonal = np.stack([R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]], axis=-1)
    trace = diagonal.sum(-1)
    # 4 q q^T from the entries of R: every row is a multiple of q; the row with the largest diagonal keeps all digits.
    outer = np.empty((*R.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[..., i + 1, i + 1] = 1 - trace + 2 * diagonal[..., i]
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = R[..., k, j] - R[..., j, k]
        outer[..., j + 1, k + 1] = outer[..., k + 1, j + 1] = R[..., k, j] + R[..., j, k]
    best = np.argmax(np.einsum("...ii->...i", outer), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def continuous_wxyz(R: ArrayLike) -> Array:
    """Return the unit quaternions (n, 4) of rotations (n, 3, 3) of a motion, each in the half-space of its predecessor.

    Slerp follows the shorter arc between two samples, but readers that interpolate the four numbers do not.
    """
    wxyz = wxyz_from_matrix(R)
    if len(wxyz) > 1:
        turn = np.where(np.einsum("ij,ij->i", wxyz[1:], wxyz[:-1]) < 0, -1.0, 1.0)
        wxyz = wxyz * np.concatenate([[1.0], np.cumprod(turn)])[:, None]
    return wxyz


def matrix_from_wxyz(q: ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4), which are normalised first.

    Raises:
        ValueError: another shape.
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
