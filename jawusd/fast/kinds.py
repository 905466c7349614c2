"""The compiled form of each kind of model: its memory layout, its motion and derivatives, for one d.

Passing an array to compiled code takes about as long as computing one pose, so each function receives a single flat
array: `model` from `kernels.packed_model`. `w` is the scratch memory of one call. See `jawusd.evaluator.models`.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.evaluator import gauge
from jawusd.evaluator.curves import GlideTable, HermiteCurve
from jawusd.evaluator.formula import GaugeNumbers
from jawusd.evaluator.gauge import gradient_by_u, spline_input
from jawusd.evaluator.kinds import ADDITIVE, KINDS
from jawusd.evaluator.models import AdditiveModel, AnchoredModel, JawModelForm
from jawusd.fast.rigid import (
    FLOATS,
    Vector,
    coefficient_slopes,
    device,
    interval,
    move,
    rotate,
    summing,
)
from jawusd.geometry.rodrigues import angle_coefficients, apply_series, cross, dot

_ADDITIVE = KINDS.index(ADDITIVE)

# offsets of the fields in a packed model of any kind
KIND = 0  # index into `evaluator.kinds.KINDS`
COUNT = 1  # number of spline centres; 0 for models without a spline
# number n of starting points of searches in d; 0 if searches run over the displacement of the incisal point
STARTS = 2
GRID = 3  # offset of the starting points: d (n, 3), then their incisal displacements (n, 3) [mm]
INCISOR = 4  # incisal point at rest (3,) [mm]
FROM_ANATOMICAL = 7  # matrix L (4, 4) in pose = L M Q, row-major
CLOSED = 23  # matrix Q (4, 4) in pose = L M Q
TO_ANATOMICAL = 39  # inverse of L (4, 4)
FROM_CLOSED = 55  # inverse of Q (4, 4)
ADJOINT = 71  # map (6, 6) of twists from the anatomical to the skull frame
VECTORS = 107  # vectors (4, 4) that represent the landmarks; see `evaluator.encoding`
REST = 123  # start of the part that depends on the kind of model

# offsets of the fields in a packed anchored model
SCALES = REST  # lengths dividing the sheared displacement (3,) [mm]
OFFSET = REST + 3  # value of the spline at u = 0 (3,) [rad]
LINEAR = REST + 6  # linear terms of the spline (3 inputs, 3 outputs) [rad]
PATH = REST + 15  # habitual path: scale, low, high [mm], then 5 coefficients of gx and 5 of gz
ARCH = REST + 28  # coefficients of rho (7,)
DROP = REST + 35  # coefficients of drop (4,)
SOFTNESS = REST + 39  # radius of the softened absolute value and ramp [mm]
FADE = REST + 40  # opening over which the glide surface fades out [mm]
SPLINE = REST + 41  # centres, column-major (3, m), then kernel weights (m, 3), then the table of the glide surface
# layout of the table: numbers of knots n2 and n3, both 0 without a table; knots of d2 (n2,), starts (n2 + 1,), likewise
# for d3, coefficients (n2 + 1, n3 + 1, 4, 4)

# offsets of the fields in a packed additive model
CURVES = REST  # offsets at which the three curves start, then the curves


def curve_parts(curve: HermiteCurve) -> Array:
    """Return a packed curve: number of knots n, knots (n,), starts (n + 1,), coefficients (n + 1, 4, k)."""
    return joined([[len(curve.knots)], curve.knots, curve.starts, curve.coefficients])


def joined(parts: Iterable[ArrayLike]) -> Array:
    """Return arrays flattened and joined."""
    return np.concatenate([np.asarray(part, dtype=np.float64).ravel() for part in parts])


def parts_of(model: JawModelForm) -> list[ArrayLike]:
    """Return the part of a packed model from `REST` on; raises TypeError if its kind has no compiled form."""
    if isinstance(model, AnchoredModel):
        return _anchored(model)
    if isinstance(model, AdditiveModel):
        return _additive(model)
    raise TypeError(f"models of kind {model.kind!r} have no compiled form")


def _anchored(model: AnchoredModel) -> list[ArrayLike]:
    gauge = model.gauge
    count = len(model.centres)
    return [
        model.scales,
        model.offset,
        model.weights[count:],
        [gauge.path_scale_mm, *gauge.path_limits],
        gauge.path_coefficients,
        gauge.glide_arch,
        gauge.glide_drop,
        [gauge.glide_softness_mm, gauge.glide_fade_mm],
        model.centres.T,
        model.weights[:count],
        *_glide(gauge.glide),
    ]


def _glide(table: GlideTable | None) -> list[ArrayLike]:
    if table is None:
        return [[0.0, 0.0]]
    (k2, k3), (s2, s3) = table.knots, table.starts
    return [[len(k2), len(k3)], k2, s2, k3, s3, table.coefficients]


def _additive(model: AdditiveModel) -> list[ArrayLike]:
    curves = [curve_parts(curve) for curve in model.curves]
    return [CURVES + 3 + np.cumsum([0, len(curves[0]), len(curves[1])]), *curves]


@device
def gauge_of(model: Array) -> GaugeNumbers:
    """Return the gauge of an anchored model."""
    m = model[PATH:]
    arch, drop = model[ARCH:], model[DROP:]
    return GaugeNumbers(
        (m[3], m[4], m[5], m[6], m[7]),
        (m[8], m[9], m[10], m[11], m[12]),
        m[0],
        m[1],
        m[2],
        (arch[0], arch[1], arch[2], arch[3], arch[4], arch[5], arch[6]),
        (drop[0], drop[1], drop[2], drop[3]),
        model[SOFTNESS],
        model[FADE],
        model[SPLINE + 6 * int(model[COUNT]) :],
    )


@device
def displacement(model: Array, d1: float, d2: float, d3: float, by_d: Array) -> Vector:
    """Return the displacement u [mm] at d [mm]; write the Jacobian du/dd to by_d (3, 3)."""
    u, (x_1, y_1, y_2, y_3, z_1, z_2) = gauge.displacement(gauge_of(model), d1, d2, d3, FLOATS)
    by_d[0, 0], by_d[0, 1], by_d[0, 2] = x_1, 1.0, 0.0
    by_d[1, 0], by_d[1, 1], by_d[1, 2] = y_1, y_2, y_3
    by_d[2, 0], by_d[2, 1], by_d[2, 2] = z_1, z_2, 1.0
    return u


@device
def parameters_at(model: Array, u: Vector) -> Vector:
    """Return the d [mm] of an incisal displacement u [mm]."""
    return gauge.inverse(gauge_of(model), u, FLOATS)


@device
def _input(model: Array, u: Vector) -> tuple[Vector, tuple[float, float]]:
    scales = (model[SCALES], model[SCALES + 1], model[SCALES + 2])
    return spline_input(gauge_of(model), scales, u, FLOATS)


@summing
def spline(model: Array, u: Vector, work: Array) -> Vector:
    """Return the rotation vector f(u) [rad] for the incisal displacement u [mm]."""
    count = int(model[COUNT])
    (q0, q1, q2), _ = _input(model, u)
    x, y, z = model[SPLINE:], model[SPLINE + count :], model[SPLINE + 2 * count :]
    for i in range(count):
        a, b, c = q0 - x[i], q1 - y[i], q2 - z[i]
        square = a * a + b * b + c * c
        work[i] = square * sqrt(square)
    weights = model[SPLINE + 3 * count :]
    k0 = k1 = k2 = 0.0
    for i in range(count):
        k0 += work[i] * weights[3 * i]
        k1 += work[i] * weights[3 * i + 1]
        k2 += work[i] * weights[3 * i + 2]
    return _with_linear(model, q0, q1, q2, k0, k1, k2)


@device
def _with_linear(model: Array, q0: float, q1: float, q2: float, k0: float, k1: float, k2: float) -> Vector:
    m, offset = model[LINEAR:], model[OFFSET:]
    return (
        k0 + q0 * m[0] + q1 * m[3] + q2 * m[6] - offset[0],
        k1 + q0 * m[1] + q1 * m[4] + q2 * m[7] - offset[1],
        k2 + q0 * m[2] + q1 * m[5] + q2 * m[8] - offset[2],
    )


@summing
def spline_derivative(model: Array, u: Vector, work: Array, by_u: Array) -> Vector:
    """Return f(u) [rad]; write df/du [rad/mm] to by_u (3, 3)."""
    count = int(model[COUNT])
    (q0, q1, q2), slopes = _input(model, u)
    x, y, z = model[SPLINE:], model[SPLINE + count :], model[SPLINE + 2 * count :]
    cube, rx, ry, rz = work[:count], work[count : 2 * count], work[2 * count : 3 * count], work[3 * count :]
    for i in range(count):
        a, b, c = q0 - x[i], q1 - y[i], q2 - z[i]
        square = a * a + b * b + c * c
        r = sqrt(square)
        cube[i] = square * r
        rx[i], ry[i], rz[i] = r * a, r * b, r * c
    weights = model[SPLINE + 3 * count :]
    k0 = k1 = k2 = a0 = a1 = a2 = b0 = b1 = b2 = c0 = c1 = c2 = 0.0
    for i in range(count):
        w0, w1, w2 = weights[3 * i], weights[3 * i + 1], weights[3 * i + 2]
        k0, k1, k2 = k0 + cube[i] * w0, k1 + cube[i] * w1, k2 + cube[i] * w2
        a0, a1, a2 = a0 + rx[i] * w0, a1 + rx[i] * w1, a2 + rx[i] * w2
        b0, b1, b2 = b0 + ry[i] * w0, b1 + ry[i] * w1, b2 + ry[i] * w2
        c0, c1, c2 = c0 + rz[i] * w0, c1 + rz[i] * w1, c2 + rz[i] * w2
    m, scales = model[LINEAR:], (model[SCALES], model[SCALES + 1], model[SCALES + 2])
    for k, (a, b, c) in enumerate(((a0, b0, c0), (a1, b1, c1), (a2, b2, c2))):
        by_q = (3.0 * a + m[k], 3.0 * b + m[3 + k], 3.0 * c + m[6 + k])
        by_u[k, 0], by_u[k, 1], by_u[k, 2] = gradient_by_u(by_q, scales, slopes)
    return _with_linear(model, q0, q1, q2, k0, k1, k2)


@device
def summed_curves(model: Array, d1: float, d2: float, d3: float, twist: Array, by_d: Array) -> None:
    """Write log M (6,) of an additive model and its derivative (6, 3)."""
    twist[:] = 0.0
    for axis, x in enumerate((d1, d2, d3)):
        curve = model[int(model[CURVES + axis]) :]
        count = int(curve[0])
        i = interval(curve[1:], count, x)
        s = x - curve[1 + count + i]
        c = curve[2 + 2 * count + 24 * i :]
        for k in range(6):
            twist[k] += ((c[18 + k] * s + c[12 + k]) * s + c[6 + k]) * s + c[k]
            by_d[k, axis] = (3 * c[18 + k] * s + 2 * c[12 + k]) * s + c[6 + k]


class Scratch(NamedTuple):
    """Scratch memory for one call."""

    centres: Array
    u_d: Array
    omega_u: Array
    twist: Array
    twist_d: Array
    M: Array
    S: Array


@device
def scratch(model: Array) -> Scratch:
    """Allocate the scratch memory for one call; it must not be shared between threads."""
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
def motion(model: Array, d1: float, d2: float, d3: float, w: Scratch) -> bool:
    """Write M(d) to w.M and its rotation vector to w.twist; return whether w.twist is the complete log M."""
    if model[KIND] == _ADDITIVE:
        summed_curves(model, d1, d2, d3, w.twist, w.twist_d)
        move(w.twist, w.M)
        return True
    displaced(model, displacement(model, d1, d2, d3, w.u_d), w)
    return False


@device
def displaced(model: Array, u: Vector, w: Scratch) -> None:
    """Write the motion, and its rotation vector, of an anchored model for the incisal displacement u."""
    w.twist[0], w.twist[1], w.twist[2] = spline(model, u, w.centres)
    _anchor(model, u, w)


@device
def _anchor(model: Array, u: Vector, w: Scratch) -> None:
    """Write to w.M the motion that rotates by w.twist[:3] and displaces the incisal point by u."""
    rotate((w.twist[0], w.twist[1], w.twist[2]), w.M)
    p = (model[INCISOR], model[INCISOR + 1], model[INCISOR + 2])
    for i in range(3):
        w.M[i, 3] = u[i] + p[i] - (w.M[i, 0] * p[0] + w.M[i, 1] * p[1] + w.M[i, 2] * p[2])


@device
def motion_by_displacement(model: Array, u0: float, u1: float, u2: float, w: Scratch) -> None:
    """Write an anchored model's motion for the incisal displacement u to w.M, and its spatial derivative S to w.S."""
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
def motion_derivative(model: Array, d1: float, d2: float, d3: float, w: Scratch) -> bool:
    """Write M(d) to w.M and its spatial derivative to w.S; return whether w.twist_d is d log M / dd."""
    if model[KIND] == _ADDITIVE:
        summed_curves(model, d1, d2, d3, w.twist, w.twist_d)
        move(w.twist, w.M)
        _spatial(w)
        return True
    u0, u1, u2 = displacement(model, d1, d2, d3, w.u_d)
    motion_by_displacement(model, u0, u1, u2, w)
    for i in range(6):
        a, b, c = w.S[i, 0], w.S[i, 1], w.S[i, 2]
        for k in range(3):
            w.S[i, k] = a * w.u_d[0, k] + b * w.u_d[1, k] + c * w.u_d[2, k]
    return False


@device
def _spatial(w: Scratch) -> None:
    """Write the spatial derivative of exp(twist) for changes w.twist_d of the twist to w.S.

    The translation is t = v + b w x v + c w x (w x v). A change of the twist adds the rotation W = J dw and shifts the
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
