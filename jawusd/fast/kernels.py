"""The kernels of a rig, compiled: functions of one d, functions that loop over rows, and the class that calls them.

`model` is the array from `packed_model`, `w` the scratch memory of one call (see `jawusd.fast.kinds`). The functions
release the GIL and keep no state, so any number of threads may call them at once. Argument types are fixed
(C-contiguous, writable float64 arrays): other types raise a TypeError instead of compiling a second version. The
machine code is cached on disk if the cache folder is writable. The cache is invalidated only by the modification time
of this file: after changing another module of this package, delete the cache (``rm -r jawusd/fast/__pycache__``).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.evaluator.batching import LARGEST
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.encoding import Encoder
from jawusd.evaluator.kernels import NumpyKernels
from jawusd.evaluator.kinds import KINDS
from jawusd.evaluator.models import AnchoredModel, JawModelForm
from jawusd.evaluator.motions import RigFrames
from jawusd.evaluator.verdicts import Limits, Verdicts
from jawusd.fast.encoding import judge
from jawusd.fast.hull import hull_scratch, packed_bound, signed_distance, signed_distance_gradient
from jawusd.fast.kinds import (
    ADJOINT,
    CLOSED,
    FROM_ANATOMICAL,
    GRID,
    Scratch,
    joined,
    motion,
    motion_derivative,
    parts_of,
    scratch,
)
from jawusd.fast.rigid import compiled, device, inverse_coefficient, product
from jawusd.geometry.rodrigues import apply_series, cross, dot


def packed_model(model: JawModelForm, frames: RigFrames, vectors: Array) -> Array:
    """Return a packed model, for vectors (4, 4) [mm] of `landmark_vectors`; raises TypeError if not compiled."""
    centres, starts = (len(model.centres), None) if isinstance(model, AnchoredModel) else (0, model.starts)
    head: list[ArrayLike] = [
        [KINDS.index(model.kind), centres, 0 if starts is None else len(starts.d), 0],
        model.incisor,
        frames.T_skull_anatomical,
        frames.T_anatomical_mandible_rest,
        frames.T_anatomical_skull,
        frames.T_mandible_anatomical_rest,
        frames.adjoint,
        vectors,
    ]
    packed = joined([*head, *parts_of(model)])
    packed[GRID] = len(packed)
    return packed if starts is None else joined([packed, starts.d, starts.displacements])


@device
def logarithm(model: Array, d1: float, d2: float, d3: float, w: Scratch) -> None:
    """Write log M(d) to w.twist."""
    if not motion(model, d1, d2, d3, w):
        omega = (w.twist[0], w.twist[1], w.twist[2])
        factor, _ = inverse_coefficient(dot(omega, omega))
        t = (w.M[0, 3], w.M[1, 3], w.M[2, 3])
        w.twist[3], w.twist[4], w.twist[5] = apply_series(omega, t, -0.5, factor)


@device
def logarithm_derivative(model: Array, d1: float, d2: float, d3: float, w: Scratch) -> None:
    """Write d log M / dd to w.twist_d (6, 3)."""
    if motion_derivative(model, d1, d2, d3, w):
        return
    omega = (w.twist[0], w.twist[1], w.twist[2])
    factor, slope = inverse_coefficient(dot(omega, omega))
    t = (w.M[0, 3], w.M[1, 3], w.M[2, 3])
    x = cross(omega, t)
    y = cross(omega, x)
    for k in range(3):
        s = (w.S[0, k], w.S[1, k], w.S[2, k])
        # the rotation vector changes by the inverse Jacobian of the rotation, the translation by W x t + V
        e = apply_series(omega, s, -0.5, factor)
        r = cross(s, t)
        v = apply_series(omega, (r[0] + w.S[3, k], r[1] + w.S[4, k], r[2] + w.S[5, k]), -0.5, factor)
        f = cross(e, t)
        g, h = cross(omega, f), cross(e, x)
        along = 2.0 * slope * dot(omega, e)
        w.twist_d[0, k], w.twist_d[1, k], w.twist_d[2, k] = e
        for i in range(3):
            w.twist_d[3 + i, k] = v[i] - 0.5 * f[i] + factor * (g[i] + h[i]) + along * y[i]


@device
def pose(model: Array, d1: float, d2: float, d3: float, w: Scratch, out: Array) -> None:
    """Write T_skull_mandible (4, 4) to out."""
    motion(model, d1, d2, d3, w)
    product(model, FROM_ANATOMICAL, w.M, model, CLOSED, out)
    out[3, 0] = out[3, 1] = out[3, 2] = 0.0
    out[3, 3] = 1.0


@device
def usable(d1: float, d2: float, d3: float) -> bool:
    """Return whether d is finite and below `LARGEST`; the results for other rows are NaN."""
    return abs(d1) < LARGEST and abs(d2) < LARGEST and abs(d3) < LARGEST


@compiled("f8[:,::1](f8[::1], f8, f8, f8)")
def single_pose(model: Array, d1: float, d2: float, d3: float) -> Array:
    """Return T_skull_mandible (4, 4) of one d [mm]."""
    out = np.empty((4, 4))
    pose(model, d1, d2, d3, scratch(model), out)
    return out


@compiled("void(f8[::1], f8[:,::1], f8[:,:,::1])")
def poses(model: Array, d: Array, out: Array) -> None:
    """Write the poses (n, 4, 4) of d (n, 3) [mm] to out."""
    w = scratch(model)
    for row in range(len(d)):
        if usable(d[row, 0], d[row, 1], d[row, 2]):
            pose(model, d[row, 0], d[row, 1], d[row, 2], w, out[row])
        else:
            out[row] = np.nan


@compiled("void(f8[::1], f8[:,::1], f8[:,::1])")
def twists(model: Array, d: Array, out: Array) -> None:
    """Write the twists (n, 6), skull frame, of d (n, 3) [mm] to out."""
    w = scratch(model)
    for row in range(len(d)):
        out[row] = np.nan
        if not usable(d[row, 0], d[row, 1], d[row, 2]):
            continue
        logarithm(model, d[row, 0], d[row, 1], d[row, 2], w)
        for i in range(6):
            total = 0.0
            for k in range(6):
                total += model[ADJOINT + 6 * i + k] * w.twist[k]
            out[row, i] = total


@compiled("void(f8[::1], f8[:,::1], f8[:,:,::1])")
def jacobians(model: Array, d: Array, out: Array) -> None:
    """Write the derivatives (n, 6, 3) of the twists with respect to d (n, 3) [mm] to out."""
    w = scratch(model)
    for row in range(len(d)):
        out[row] = np.nan
        if not usable(d[row, 0], d[row, 1], d[row, 2]):
            continue
        logarithm_derivative(model, d[row, 0], d[row, 1], d[row, 2], w)
        for i in range(6):
            for axis in range(3):
                total = 0.0
                for k in range(6):
                    total += model[ADJOINT + 6 * i + k] * w.twist_d[k, axis]
                out[row, i, axis] = total


@compiled("f8(f8[::1], f8, f8, f8)")
def single_margin(bound: Array, d1: float, d2: float, d3: float) -> float:
    """Return the signed distance [mm] from one d [mm] to the bound, positive inside."""
    return -signed_distance(bound, d1, d2, d3, hull_scratch(bound))[0]


@compiled("void(f8[::1], f8[:,::1], f8[::1])")
def margins(bound: Array, d: Array, out: Array) -> None:
    """Write to `out` the signed distances (n,) [mm] from d (n, 3) [mm] to the bound, positive inside."""
    v = hull_scratch(bound)
    for row in range(len(d)):
        out[row] = np.nan
        if usable(d[row, 0], d[row, 1], d[row, 2]):
            out[row] = -signed_distance(bound, d[row, 0], d[row, 1], d[row, 2], v)[0]


@compiled("void(f8[::1], f8[:,::1], f8[:,::1])")
def margin_gradients(bound: Array, d: Array, out: Array) -> None:
    """Write the derivatives (n, 3) of the margins with respect to d (n, 3) [mm] to out."""
    v = hull_scratch(bound)
    for row in range(len(d)):
        if usable(d[row, 0], d[row, 1], d[row, 2]):
            signed_distance_gradient(bound, d[row, 0], d[row, 1], d[row, 2], v, out[row])
            for i in range(3):
                out[row, i] = -out[row, i]
        else:
            out[row] = np.nan


@compiled("void(f8[::1], f8[::1], f8[:,:,::1], b1, f8, f8, f8[:,::1])")
def judge_rows(
    model: Array,
    bound: Array,
    T: Array,
    judging: bool,
    residual_limit_mm: float,
    margin_limit_mm: float,
    out: Array,
) -> None:
    """Write d, residual, margin [mm] and reason (n, 6) of poses T (n, 4, 4); see `encoding.judge`.

    Encoding and judging share one function: compiling a second one would take a tenth of the total compile time.
    """
    w, x, v = scratch(model), np.empty(3), hull_scratch(bound)
    for row in range(len(T)):
        why, residual, margin = judge(model, bound, T[row], judging, residual_limit_mm, margin_limit_mm, w, x, v)
        out[row, 0], out[row, 1], out[row, 2] = x[0], x[1], x[2]
        out[row, 3], out[row, 4], out[row, 5] = residual, margin, why


class CompiledKernels(NumpyKernels):
    """Compiled kernels of a rig, accurate to 1e-10; searches along the bound are inherited from `NumpyKernels`."""

    def __init__(self, encoder: Encoder, bound: SliceHull) -> None:
        super().__init__(encoder, bound)
        self._packed_model = packed_model(encoder.model, encoder.frames, encoder.vectors)
        self._packed_bound = packed_bound(bound)

    def pose(self, d1: float, d2: float, d3: float) -> Array:
        """Return T_skull_mandible (4, 4) of one d [mm]."""
        return single_pose(self._packed_model, d1, d2, d3)

    def margin(self, d1: float, d2: float, d3: float) -> float:
        """Return the signed distance [mm] from one d [mm] to the bound, positive inside."""
        return single_margin(self._packed_bound, d1, d2, d3)

    def poses(self, d: Array) -> Array:
        """Return the poses T_skull_mandible (n, 4, 4) of d (n, 3) [mm]."""
        return _filled(poses, self._packed_model, d, 4, 4)

    def twists(self, d: Array) -> Array:
        """Return the twists (n, 6), skull frame, of d (n, 3) [mm]."""
        return _filled(twists, self._packed_model, d, 6)

    def jacobians(self, d: Array) -> Array:
        """Return the derivatives (n, 6, 3) of the twists with respect to d (n, 3) [mm]."""
        return _filled(jacobians, self._packed_model, d, 6, 3)

    def margins(self, d: Array) -> Array:
        """Return the signed distances (n,) [mm] from d (n, 3) [mm] to the bound, positive inside."""
        return _filled(margins, self._packed_bound, d)

    def margin_gradients(self, d: Array) -> Array:
        """Return the derivatives (n, 3) of the margins with respect to d (n, 3) [mm]."""
        return _filled(margin_gradients, self._packed_bound, d, 3)

    def encode(self, T: Array) -> tuple[Array, Array]:
        """Return the d (n, 3) [mm] nearest to poses T_skull_mandible (n, 4, 4), and the residuals (n,) [mm]."""
        out = np.empty((len(T), 6))
        judge_rows(self._packed_model, self._packed_bound, _owned(T), False, 0.0, 0.0, out)
        return out[:, :3], out[:, 3]

    def judge_poses(self, T: Array, limits: Limits) -> Verdicts:
        """Return verdicts on poses T_skull_mandible (n, 4, 4)."""
        out = np.empty((len(T), 6))
        residual_mm, margin_mm = limits.residual_mm, -limits.tolerance_mm
        judge_rows(self._packed_model, self._packed_bound, _owned(T), True, residual_mm, margin_mm, out)
        reason = out[:, 5]  # `logical_not` is three times as fast as `== 0`
        return Verdicts(np.logical_not(reason), reason.astype(np.uint8), out[:, 3], out[:, 4], out[:, :3])


def _filled(function: Callable[[Array, Array, Array], None], packed: Array, d: Array, *shape: int) -> Array:
    """Return what a compiled function writes for each row of d (n, 3), shape (n, *shape)."""
    out = np.empty((len(d), *shape))
    function(packed, _owned(d), out)
    return out


def _owned(values: Array) -> Array:
    """Return the values, copied unless they are contiguous, aligned and writable as compiled code requires."""
    return values if values.flags.carray else np.array(values, order="C")
