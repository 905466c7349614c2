"""Compiled jaw model of any kind, for one d: packed model, twists, their derivatives, and poses.

`model` is the array from `packed_model`, `w` the scratch memory of one call; see `jawusd.fast.kinds`.
"""

from __future__ import annotations

from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.evaluator.kinds import KINDS
from jawusd.evaluator.models import AnchoredModel, JawModelForm
from jawusd.evaluator.motions import RigFrames
from jawusd.fast.kinds import Scratch, motion, motion_derivative, parts_of
from jawusd.fast.packing import CLOSED, FROM_ANATOMICAL, GRID, joined
from jawusd.fast.rigid import device, inverse_coefficient, product
from jawusd.geometry.rodrigues import apply_series, cross, dot


def packed_model(model: JawModelForm, frames: RigFrames, vectors: Array) -> Array:
    """Return a packed model; see `encoding.landmark_vectors` for the vectors (4, 4) [mm].

    Raises:
        TypeError: the kind of model has no compiled form.
    """
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
