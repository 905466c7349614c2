"""Compiled: a rig's motions M(d), their twists, derivatives and poses, for one row.

`model` is what `packing.packed_model` returns, `w` the scratch that `scratch` makes for one call.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array
from jawusd.fast.forms import displacement, spline, spline_derivative, summed_curves
from jawusd.fast.packing import ADDITIVE_KIND, CLOSED, COUNT, FROM_ANATOMICAL, INCISOR, KIND
from jawusd.fast.rigid import Vector, coefficient_slopes, device, inverse_coefficient, move, product, rotate
from jawusd.geometry.rodrigues import angle_coefficients, apply_series, cross, dot


class Scratch(NamedTuple):
    """The memory of one call."""

    centres: Array
    u_d: Array
    omega_u: Array
    twist: Array
    twist_d: Array
    M: Array
    S: Array


@device
def scratch(model: Array) -> Scratch:
    """Return the memory one call works in: never shared, so that threads do not meet."""
    return Scratch(
        np.empty(4 * int(model[COUNT])),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(6),
        np.empty((6, 3)),
        np.empty((3, 4)),
        np.empty((6, 3)),
    )


@device
def motion(model: Array, d1: float, d2: float, d3: float, w: Scratch) -> None:
    """Write M(d) to w.M; of an anchored model also the rotation vector, of an additive one the twist."""
    if model[KIND] == ADDITIVE_KIND:
        summed_curves(model, d1, d2, d3, w.twist, w.twist_d)
        move(w.twist, w.M)
        return
    displaced(model, displacement(model, d1, d2, d3, w.u_d), w)


@device
def displaced(model: Array, u: Vector, w: Scratch) -> None:
    """Write to w.M the motion of an anchored model that carries the incisal point by u, and its rotation vector."""
    w.twist[0], w.twist[1], w.twist[2] = spline(model, u, w.centres)
    _anchor(model, u, w)


@device
def _anchor(model: Array, u: Vector, w: Scratch) -> None:
    """Write to w.M the motion that rotates by w.twist[:3] and carries the incisal point by u."""
    rotate((w.twist[0], w.twist[1], w.twist[2]), w.M)
    p = (model[INCISOR], model[INCISOR + 1], model[INCISOR + 2])
    for i in range(3):
        w.M[i, 3] = u[i] + p[i] - (w.M[i, 0] * p[0] + w.M[i, 1] * p[1] + w.M[i, 2] * p[2])


@device
def motion_by_displacement(model: Array, u0: float, u1: float, u2: float, w: Scratch) -> None:
    """Write the motion of an anchored model that carries the incisal point by u, and S by u, to w.M and w.S."""
    omega = spline_derivative(model, (u0, u1, u2), w.centres, w.omega_u)
    w.twist[0], w.twist[1], w.twist[2] = omega
    _anchor(model, (u0, u1, u2), w)
    _, b, c = angle_coefficients(dot(omega, omega))
    p = (u0 + model[INCISOR], u1 + model[INCISOR + 1], u2 + model[INCISOR + 2])
    for k in range(3):
        s = apply_series(omega, (w.omega_u[0, k], w.omega_u[1, k], w.omega_u[2, k]), b, c)
        # the incisal point itself moves by du: w x (u + p) + v = du
        w.S[0, k], w.S[1, k], w.S[2, k] = s
        w.S[3, k], w.S[4, k], w.S[5, k] = cross(p, s)
        w.S[3 + k, k] += 1.0


@device
def motion_derivative(model: Array, d1: float, d2: float, d3: float, w: Scratch) -> None:
    """Write M(d) and its spatial derivative to w.M and w.S; of an additive model also its twist's to w.twist_d."""
    if model[KIND] == ADDITIVE_KIND:
        summed_curves(model, d1, d2, d3, w.twist, w.twist_d)
        move(w.twist, w.M)
        _spatial(w)
        return
    u0, u1, u2 = displacement(model, d1, d2, d3, w.u_d)
    motion_by_displacement(model, u0, u1, u2, w)
    for i in range(6):
        a, b, c = w.S[i, 0], w.S[i, 1], w.S[i, 2]
        for k in range(3):
            w.S[i, k] = a * w.u_d[0, k] + b * w.u_d[1, k] + c * w.u_d[2, k]


@device
def _spatial(w: Scratch) -> None:
    """Write to w.S the spatial derivative of exp(twist) whose twist changes by w.twist_d.

    With t = v + b w x v + c w x (w x v) the translation, a change of the twist turns by W = J dw and shifts the
    origin by dt - W x t.
    """
    omega, v = (w.twist[0], w.twist[1], w.twist[2]), (w.twist[3], w.twist[4], w.twist[5])
    squared = dot(omega, omega)
    a, b, c = angle_coefficients(squared)
    b_1, c_1 = coefficient_slopes(squared, a, b, c)
    x = cross(omega, v)
    y = cross(omega, x)
    for k in range(3):
        e = (w.twist_d[0, k], w.twist_d[1, k], w.twist_d[2, k])
        s = apply_series(omega, e, b, c)
        t = apply_series(omega, (w.twist_d[3, k], w.twist_d[4, k], w.twist_d[5, k]), b, c)
        f = cross(e, v)
        g, h = cross(omega, f), cross(e, x)
        along = 2.0 * dot(omega, e)
        r = cross(s, (w.M[0, 3], w.M[1, 3], w.M[2, 3]))
        w.S[0, k], w.S[1, k], w.S[2, k] = s
        for i in range(3):
            w.S[3 + i, k] = t[i] + b * f[i] + c * (g[i] + h[i]) + along * (b_1 * x[i] + c_1 * y[i]) - r[i]


@device
def logarithm(model: Array, d1: float, d2: float, d3: float, w: Scratch) -> None:
    """Write log M(d) to w.twist."""
    motion(model, d1, d2, d3, w)
    if model[KIND] != ADDITIVE_KIND:
        omega = (w.twist[0], w.twist[1], w.twist[2])
        factor, _ = inverse_coefficient(dot(omega, omega))
        t = (w.M[0, 3], w.M[1, 3], w.M[2, 3])
        w.twist[3], w.twist[4], w.twist[5] = apply_series(omega, t, -0.5, factor)


@device
def logarithm_derivative(model: Array, d1: float, d2: float, d3: float, w: Scratch) -> None:
    """Write d log M / dd to w.twist_d (6, 3)."""
    motion_derivative(model, d1, d2, d3, w)
    if model[KIND] == ADDITIVE_KIND:
        return
    omega = (w.twist[0], w.twist[1], w.twist[2])
    factor, slope = inverse_coefficient(dot(omega, omega))
    t = (w.M[0, 3], w.M[1, 3], w.M[2, 3])
    x = cross(omega, t)
    y = cross(omega, x)
    for k in range(3):
        s = (w.S[0, k], w.S[1, k], w.S[2, k])
        # the rotation vector changes by the inverse Jacobian of the turn; the translation by W x t + V
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
