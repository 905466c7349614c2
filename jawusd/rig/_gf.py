"""Conversions between numpy arrays and Gf and Vt values; other modules do not convert these types themselves.

numpy side: column vectors (`p_a = T_a_b @ p_b`), quaternions (w, x, y, z), C-contiguous. USD side: row vectors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pxr import Gf, Vt

from jawusd.geometry.so3 import continuous_wxyz


def double_array(values: ArrayLike) -> Vt.DoubleArray:
    """Return an array of any shape as a flat Vt.DoubleArray, row-major."""
    return Vt.DoubleArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float64).reshape(-1))


def float_array(values: ArrayLike) -> Vt.FloatArray:
    """Return an array of any shape as a flat Vt.FloatArray, row-major; rounds to float32."""
    return Vt.FloatArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32).reshape(-1))


def int_array(values: ArrayLike) -> Vt.IntArray:
    """Return an integer array of any shape as a flat Vt.IntArray, row-major."""
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, dtype=np.int32).reshape(-1))


def vec3f_array(values: ArrayLike) -> Vt.Vec3fArray:
    """Return points or normals (n, 3) as a Vt.Vec3fArray; rounds to float32."""
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def vec2f_array(values: ArrayLike) -> Vt.Vec2fArray:
    """Return pairs (n, 2) as a Vt.Vec2fArray; rounds to float32."""
    return Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def vec2d(pair: ArrayLike) -> Gf.Vec2d:
    """Return two numbers as a Gf.Vec2d."""
    return Gf.Vec2d(*np.asarray(pair, dtype=np.float64).tolist())


def translations(T: ArrayLike) -> list[Gf.Vec3d]:
    """Return the translations [mm] of transforms (n, 4, 4)."""
    return [Gf.Vec3d(*t) for t in np.asarray(T, dtype=np.float64)[:, :3, 3].tolist()]


def rotations(T: ArrayLike) -> list[Gf.Quatd]:
    """Return the rotations of transforms (n, 4, 4) as unit quaternions without sign flips between neighbours."""
    return [Gf.Quatd(w, x, y, z) for w, x, y, z in continuous_wxyz(np.asarray(T)[:, :3, :3]).tolist()]


def quatf_arrays(T: ArrayLike) -> list[Vt.QuatfArray]:
    """Return the result of `rotations` as samples of a one-joint animation, each a Vt.QuatfArray of length one."""
    return [Vt.QuatfArray([Gf.Quatf(w, x, y, z)]) for w, x, y, z in continuous_wxyz(np.asarray(T)[:, :3, :3]).tolist()]


def row_matrix(T: ArrayLike) -> Gf.Matrix4d:
    """Return a transform (4, 4) for column vectors as a Gf.Matrix4d, which acts on row vectors."""
    return Gf.Matrix4d(np.asarray(T, dtype=np.float64).T.tolist())
