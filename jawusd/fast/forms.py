"""Compiled: the functions that make a jaw model, for one row: gauge, spline, curves.

The formulas are those of `jawusd.evaluator` (`gauge`, `models`, `curves`), which documents them; tests hold both to
the same results. `model` is what `packing.packed_model` returns, `work` scratch of at least 4 numbers per centre.
"""

from __future__ import annotations

from math import exp, sqrt

from jawusd.evaluator.gauge import ARCH_BOW_MM, DROP_BEND, DROP_SATURATION_MM2, FADE_SOFTNESS_MM, LIMIT_SOFTNESS_MM
from jawusd.fast.packing import ARCH, COUNT, CURVES, DROP, FADE, LINEAR, OFFSET, PATH, SCALES, SOFTNESS, SPLINE
from jawusd.fast.rigid import device


@device
def gauge_path(model, d1):
    """Return gx, gz [mm] and their slopes at opening d1 [mm]."""
    scale, low, high = model[PATH], model[PATH + 1], model[PATH + 2]
    inside = min(max(d1, low), high)
    s, beyond = inside / scale, d1 - inside
    a, b, c, d, e = model[PATH + 3], model[PATH + 4], model[PATH + 5], model[PATH + 6], model[PATH + 7]
    f, g, h, i, j = model[PATH + 8], model[PATH + 9], model[PATH + 10], model[PATH + 11], model[PATH + 12]
    x_1 = ((((5 * e * s + 4 * d) * s + 3 * c) * s + 2 * b) * s + a) / scale
    z_1 = ((((5 * j * s + 4 * i) * s + 3 * h) * s + 2 * g) * s + f) / scale
    x = ((((e * s + d) * s + c) * s + b) * s + a) * s + x_1 * beyond
    z = ((((j * s + i) * s + h) * s + g) * s + f) * s + z_1 * beyond
    return x, z, x_1, z_1


@device
def gauge_arch(model, d1, d2):
    """Return rho [mm] and its derivatives by d1 and d2."""
    scale, low, high, e = model[PATH], model[PATH + 1], model[PATH + 2], model[SOFTNESS]
    rise, stop, square = d1 - low, d1 - high, LIMIT_SOFTNESS_MM * LIMIT_SOFTNESS_MM
    root_rise, root_stop = sqrt(rise * rise + square), sqrt(stop * stop + square)
    t = (low + 0.5 * (rise + root_rise - stop - root_stop)) / scale
    t_1 = 0.5 * (rise / root_rise - stop / root_stop) / scale
    c0, c1, c2, c3 = model[ARCH], model[ARCH + 1], model[ARCH + 2], model[ARCH + 3]
    c4, c5, c6 = model[ARCH + 4], model[ARCH + 5] / ARCH_BOW_MM, model[ARCH + 6] / ARCH_BOW_MM
    root = sqrt(d2 * d2 + e * e)
    side, side_2 = root - e, d2 / root
    by_side, by_d2, bow = (c2 * t + c1) * t + c0, c4 * t + c3, c6 * t + c5
    rho = side * by_side + d2 * (by_d2 + d2 * bow)
    rho_1 = (side * (2 * c2 * t + c1) + d2 * (c4 + d2 * c6)) * t_1
    return rho, rho_1, side_2 * by_side + by_d2 + 2 * d2 * bow


@device
def gauge_drop(model, d2, d3):
    """Return drop [mm] and its derivatives by d2 and d3."""
    e = model[SOFTNESS]
    root2, root3 = sqrt(d2 * d2 + e * e), sqrt(d3 * d3 + e * e)
    side, front = root2 - e, 0.5 * (d3 + root3 - e)
    bent2, bent2_1 = _bent(side)
    bent3, bent3_1 = _bent(front)
    c0, c1, c2, c3 = model[DROP], model[DROP + 1], model[DROP + 2], model[DROP + 3]
    drop = c0 * side + c1 * front + c2 * bent2 + c3 * bent3
    return drop, (c0 + c2 * bent2_1) * (d2 / root2), (c1 + c3 * bent3_1) * 0.5 * (1.0 + d3 / root3)


@device
def _bent(x):
    w = 1.0 + x * x / DROP_SATURATION_MM2
    root = sqrt(w)
    return DROP_BEND * x * x / root, DROP_BEND * x * (1.0 + w) / (w * root)


@device
def gauge_fade(model, d1):
    """Return the share of the glide surface felt at opening d1 [mm], and its derivative."""
    root = sqrt(d1 * d1 + FADE_SOFTNESS_MM * FADE_SOFTNESS_MM)
    x = 0.5 * (d1 + root - FADE_SOFTNESS_MM) / model[FADE]
    fade = exp(-x * x)
    return fade, fade * (-2.0 / model[FADE]) * x * 0.5 * (1.0 + d1 / root)


@device
def displacement(model, d1, d2, d3, by_d):
    """Return u [mm] of d [mm]; write du/dd to by_d (3, 3)."""
    gx, gz, gx_1, gz_1 = gauge_path(model, d1)
    rho, rho_1, rho_2 = gauge_arch(model, d1, d2)
    drop, drop_2, drop_3 = gauge_drop(model, d2, d3)
    fade, fade_1 = gauge_fade(model, d1)
    by_d[0, 0], by_d[0, 1], by_d[0, 2] = gx_1, 1.0, 0.0
    by_d[1, 0], by_d[1, 1], by_d[1, 2] = -(1.0 + drop * fade_1), -drop_2 * fade, -drop_3 * fade
    by_d[2, 0], by_d[2, 1], by_d[2, 2] = gz_1 + rho_1, rho_2, 1.0
    return gx + d2, -(d1 + drop * fade), gz + rho + d3


@device
def spline(model, u0, u1, u2, work):
    """Return the rotation vector f(u) [rad] for the incisal displacement u [mm]."""
    count = int(model[COUNT])
    gx, gz, _, _ = gauge_path(model, -u1)
    q0, q1, q2 = -u1 / model[SCALES], (u0 - gx) / model[SCALES + 1], (u2 - gz) / model[SCALES + 2]
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
    m = model[LINEAR:]
    return (
        k0 + q0 * m[0] + q1 * m[3] + q2 * m[6] - model[OFFSET],
        k1 + q0 * m[1] + q1 * m[4] + q2 * m[7] - model[OFFSET + 1],
        k2 + q0 * m[2] + q1 * m[5] + q2 * m[8] - model[OFFSET + 2],
    )


@device
def spline_derivative(model, u0, u1, u2, work, by_u):
    """Return f(u) [rad]; write df/du [rad/mm] to by_u (3, 3)."""
    count = int(model[COUNT])
    gx, gz, gx_1, gz_1 = gauge_path(model, -u1)
    s0, s1, s2 = model[SCALES], model[SCALES + 1], model[SCALES + 2]
    q0, q1, q2 = -u1 / s0, (u0 - gx) / s1, (u2 - gz) / s2
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
    m = model[LINEAR:]
    for k, (a, b, c) in enumerate(((a0, b0, c0), (a1, b1, c1), (a2, b2, c2))):
        opening, side, front = (3.0 * a + m[k]) / s0, (3.0 * b + m[3 + k]) / s1, (3.0 * c + m[6 + k]) / s2
        by_u[k, 0], by_u[k, 1], by_u[k, 2] = side, -opening + side * gx_1 + front * gz_1, front
    return (
        k0 + q0 * m[0] + q1 * m[3] + q2 * m[6] - model[OFFSET],
        k1 + q0 * m[1] + q1 * m[4] + q2 * m[7] - model[OFFSET + 1],
        k2 + q0 * m[2] + q1 * m[5] + q2 * m[8] - model[OFFSET + 2],
    )


@device
def interval(knots, count, x):
    """Return how many of the first ``count`` knots are <= x."""
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        if knots[middle] <= x:
            low = middle + 1
        else:
            high = middle
    return low


@device
def summed_curves(model, d1, d2, d3, twist, by_d):
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
