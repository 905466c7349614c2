"""Unit quaternions, real part first (w, x, y, z)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.geometry.rodrigues import N


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
    """Return 4 q q^T from rows of matrix entries, floats or arrays. Every row is a multiple of q.

    The row with the largest diagonal entry is free of cancellation.
    """
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
    """Return the unit quaternions (n, 4) of rotations (n, 3, 3), with signs chosen for continuity.

    Slerp takes the shorter arc between two samples, but readers that interpolate the four components do not.
    """
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
