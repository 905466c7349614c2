"""Compiled: the functions that make a jaw model, for one row: gauge, spline, curves.

`jawusd.evaluator.models` documents them. `model` is what `packing.packed_model` returns, `work` scratch of at least
4 numbers per centre.
"""

from __future__ import annotations

from math import sqrt

from jawusd.base.arrays import Array
from jawusd.evaluator import derivatives
from jawusd.evaluator.derivatives import gradient_by_u, spline_input
from jawusd.evaluator.formula import GaugeNumbers
from jawusd.fast.packing import ARCH, COUNT, CURVES, DROP, FADE, LINEAR, OFFSET, PATH, SCALES, SOFTNESS, SPLINE
from jawusd.fast.rigid import FLOATS, Vector, device, interval, summing


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
    """Return u [mm] of d [mm]; write du/dd to by_d (3, 3)."""
    u, (x_1, y_1, y_2, y_3, z_1, z_2) = derivatives.displacement(gauge_of(model), d1, d2, d3, FLOATS)
    by_d[0, 0], by_d[0, 1], by_d[0, 2] = x_1, 1.0, 0.0
    by_d[1, 0], by_d[1, 1], by_d[1, 2] = y_1, y_2, y_3
    by_d[2, 0], by_d[2, 1], by_d[2, 2] = z_1, z_2, 1.0
    return u


@device
def parameters_at(model: Array, u: Vector) -> Vector:
    """Return the d [mm] of an incisal displacement u [mm]."""
    return derivatives.inverse(gauge_of(model), u, FLOATS)


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
