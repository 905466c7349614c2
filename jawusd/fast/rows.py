"""Compiled: the rig's functions over rows, as Python calls them.

Everything here releases the GIL and keeps no state, so any number of threads may call it at once. The argument types
are fixed (C-contiguous, writable float64 arrays): a call with others is a TypeError and never a second compilation.
The compiled code is cached on disk, where that can be written, by this file's date; after a change in another module
of this package alone, the cache has to go (``rm -r jawusd/fast/__pycache__``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.evaluator.batching import LARGEST
from jawusd.fast.compiling import compiled
from jawusd.fast.descent import Problem, descend_inside, edge_scratch, normal_scratch
from jawusd.fast.hull import signed_distance, signed_distance_gradient
from jawusd.fast.motion import logarithm, logarithm_derivative, pose, scratch
from jawusd.fast.packing import ADJOINT
from jawusd.fast.rigid import device
from jawusd.fast.searches import NOT_FINITE, encoding_scratch, hull_scratch, judge, outside


@device
def usable(d1: float, d2: float, d3: float) -> bool:
    """Tell whether d can be computed with; others give NaN."""
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
    """Write the derivatives (n, 6, 3) of the twists by d (n, 3) [mm] to out."""
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
    """Return the margin [mm] of one d [mm]."""
    return -signed_distance(bound, d1, d2, d3, hull_scratch(bound))[0]


@compiled("void(f8[::1], f8[:,::1], f8[::1])")
def margins(bound: Array, d: Array, out: Array) -> None:
    """Write the margins (n,) [mm] of d (n, 3) [mm] to out."""
    v = hull_scratch(bound)
    for row in range(len(d)):
        out[row] = np.nan
        if usable(d[row, 0], d[row, 1], d[row, 2]):
            out[row] = -signed_distance(bound, d[row, 0], d[row, 1], d[row, 2], v)[0]


@compiled("void(f8[::1], f8[:,::1], f8[:,::1])")
def margin_gradients(bound: Array, d: Array, out: Array) -> None:
    """Write the derivatives (n, 3) of the margins by d (n, 3) [mm] to out."""
    v = hull_scratch(bound)
    for row in range(len(d)):
        if usable(d[row, 0], d[row, 1], d[row, 2]):
            signed_distance_gradient(bound, d[row, 0], d[row, 1], d[row, 2], v, out[row])
            for i in range(3):
                out[row, i] = -out[row, i]
        else:
            out[row] = np.nan


@compiled("void(f8[::1], f8[::1], f8[:,:,::1], b1, f8, f8, f8[:,::1])")
def judgements(
    model: Array,
    bound: Array,
    T: Array,
    judging: bool,
    residual_limit_mm: float,
    margin_limit_mm: float,
    out: Array,
) -> None:
    """Write d, residual, margin [mm] and reason (n, 6) of poses T (n, 4, 4); without `judging` see `searches.judge`.

    Encoding and judging are one function, because it takes a tenth of the time all of this takes to compile.
    """
    e, v = encoding_scratch(model), hull_scratch(bound)
    for row in range(len(T)):
        why, residual, margin = judge(model, bound, T[row], judging, residual_limit_mm, margin_limit_mm, e, v)
        out[row, 0], out[row, 1], out[row, 2] = e.x[0], e.x[1], e.x[2]
        out[row, 3], out[row, 4], out[row, 5] = residual, margin, why


@compiled("void(f8[::1], f8[:,::1], f8, f8[::1], f8[::1], u1[::1])")
def parameter_judgements(
    bound: Array, d: Array, margin_limit_mm: float, residual_mm: Array, margin_mm: Array, reason: NDArray[np.uint8]
) -> None:
    """Write residuals (0 or NaN), margins (n,) [mm] and reasons (n,) of parameters d (n, 3) [mm]."""
    v = hull_scratch(bound)
    for row in range(len(d)):
        residual_mm[row], margin_mm[row], reason[row] = np.nan, np.nan, NOT_FINITE
        if usable(d[row, 0], d[row, 1], d[row, 2]):
            margin = -signed_distance(bound, d[row, 0], d[row, 1], d[row, 2], v)[0]
            residual_mm[row], margin_mm[row], reason[row] = 0.0, margin, outside(margin, margin_limit_mm)


@compiled("void(f8[::1], f8[::1], i8, f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1])")
def descents(model: Array, bound: Array, chart: int, vectors: Array, targets: Array, x: Array, cost: Array) -> None:
    """Move x (n, 3) [mm] to the bottoms of their valleys inside the bound; write what is left squared (n,)."""
    w, n, edge = scratch(model), normal_scratch(), edge_scratch(bound)
    for row in range(len(x)):
        cost[row] = descend_inside(model, bound, Problem(chart, vectors, targets[row]), x[row], w, n, edge)
