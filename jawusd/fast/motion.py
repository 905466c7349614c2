"""Compiled: a rig's motions M(d), their twists, derivatives and poses, for one row.

`model` is what `packing.packed_model` returns, `w` the scratch that `scratch` makes for one call.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from jawusd.evaluator.gauge import (
    INVERSE_ITERATIONS,
    INVERSE_STEP_MM,
    INVERSE_TOLERANCE_MM,
    LEAST_INVERSE_SLOPE,
    PATIENCE,
)
from jawusd.fast.forms import (
    displacement,
    gauge_arch,
    gauge_drop,
    gauge_fade,
    gauge_path,
    spline,
    spline_derivative,
    summed_curves,
)
from jawusd.fast.packing import CLOSED, COUNT, FROM_ANATOMICAL, INCISOR
from jawusd.fast.rigid import (
    angle_coefficients,
    coefficient_slopes,
    cross,
    device,
    inverse_coefficient,
    move,
    product,
    rotate,
    series,
)

Scratch = namedtuple("Scratch", "centres u u_d omega_u twist twist_d M S")


@device
def scratch(model):
    """Return the memory one call works in: never shared, so that threads do not meet."""
    return Scratch(
        np.empty(4 * int(model[COUNT])),
        np.empty(3),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(6),
        np.empty((6, 3)),
        np.empty((3, 4)),
        np.empty((6, 3)),
    )


@device
def motion(model, d1, d2, d3, w):
    """Write M(d) to w.M; of an anchored model also u and the rotation vector, of an additive one the twist."""
    if model[COUNT] == 0:
        summed_curves(model, d1, d2, d3, w.twist, w.twist_d)
        move(w.twist, w.M)
        return
    u0, u1, u2 = displacement(model, d1, d2, d3, w.u_d)
    w.twist[0], w.twist[1], w.twist[2] = spline(model, u0, u1, u2, w.centres)
    _anchor(model, u0, u1, u2, w)


@device
def _anchor(model, u0, u1, u2, w):
    """Write to w.M the motion that rotates by w.twist[:3] and carries the incisal point by u."""
    rotate(w.twist[0], w.twist[1], w.twist[2], w.M)
    p0, p1, p2 = model[INCISOR], model[INCISOR + 1], model[INCISOR + 2]
    w.u[0], w.u[1], w.u[2] = u0, u1, u2
    for i in range(3):
        w.M[i, 3] = w.u[i] + model[INCISOR + i] - (w.M[i, 0] * p0 + w.M[i, 1] * p1 + w.M[i, 2] * p2)


@device
def motion_by_displacement(model, u0, u1, u2, w):
    """Write the motion of an anchored model that carries the incisal point by u, and S by u, to w.M and w.S."""
    w.twist[0], w.twist[1], w.twist[2] = spline_derivative(model, u0, u1, u2, w.centres, w.omega_u)
    _anchor(model, u0, u1, u2, w)
    w0, w1, w2 = w.twist[0], w.twist[1], w.twist[2]
    _, b, c = angle_coefficients(w0 * w0 + w1 * w1 + w2 * w2)
    p0, p1, p2 = u0 + model[INCISOR], u1 + model[INCISOR + 1], u2 + model[INCISOR + 2]
    for k in range(3):
        s0, s1, s2 = series(w0, w1, w2, b, c, w.omega_u[0, k], w.omega_u[1, k], w.omega_u[2, k])
        # the incisal point itself moves by du: w x (u + p) + v = du
        v0, v1, v2 = cross(p0, p1, p2, s0, s1, s2)
        w.S[0, k], w.S[1, k], w.S[2, k] = s0, s1, s2
        w.S[3, k], w.S[4, k], w.S[5, k] = v0, v1, v2
        w.S[3 + k, k] += 1.0


@device
def motion_derivative(model, d1, d2, d3, w):
    """Write M(d) and its spatial derivative to w.M and w.S; of an additive model also its twist's to w.twist_d."""
    if model[COUNT] == 0:
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
def _spatial(w):
    """Write to w.S the spatial derivative of exp(twist) whose twist changes by w.twist_d.

    With t = v + b w x v + c w x (w x v) the translation, a change of the twist turns by W = J dw and shifts the
    origin by dt - W x t.
    """
    w0, w1, w2, v0, v1, v2 = w.twist[0], w.twist[1], w.twist[2], w.twist[3], w.twist[4], w.twist[5]
    squared = w0 * w0 + w1 * w1 + w2 * w2
    a, b, c = angle_coefficients(squared)
    b_1, c_1 = coefficient_slopes(squared, a, b, c)
    x0, x1, x2 = cross(w0, w1, w2, v0, v1, v2)
    y0, y1, y2 = cross(w0, w1, w2, x0, x1, x2)
    for k in range(3):
        e0, e1, e2 = w.twist_d[0, k], w.twist_d[1, k], w.twist_d[2, k]
        s0, s1, s2 = series(w0, w1, w2, b, c, e0, e1, e2)
        t0, t1, t2 = series(w0, w1, w2, b, c, w.twist_d[3, k], w.twist_d[4, k], w.twist_d[5, k])
        f0, f1, f2 = cross(e0, e1, e2, v0, v1, v2)
        g0, g1, g2 = cross(w0, w1, w2, f0, f1, f2)
        h0, h1, h2 = cross(e0, e1, e2, x0, x1, x2)
        along = 2.0 * (w0 * e0 + w1 * e1 + w2 * e2)
        r0, r1, r2 = cross(s0, s1, s2, w.M[0, 3], w.M[1, 3], w.M[2, 3])
        w.S[0, k], w.S[1, k], w.S[2, k] = s0, s1, s2
        w.S[3, k] = t0 + b * f0 + c * (g0 + h0) + along * (b_1 * x0 + c_1 * y0) - r0
        w.S[4, k] = t1 + b * f1 + c * (g1 + h1) + along * (b_1 * x1 + c_1 * y1) - r1
        w.S[5, k] = t2 + b * f2 + c * (g2 + h2) + along * (b_1 * x2 + c_1 * y2) - r2


@device
def logarithm(model, d1, d2, d3, w):
    """Write log M(d) to w.twist."""
    motion(model, d1, d2, d3, w)
    if model[COUNT] != 0:
        _log_translation(w)


@device
def _log_translation(w):
    w0, w1, w2 = w.twist[0], w.twist[1], w.twist[2]
    factor, _ = inverse_coefficient(w0 * w0 + w1 * w1 + w2 * w2)
    t0, t1, t2 = w.M[0, 3], w.M[1, 3], w.M[2, 3]
    w.twist[3], w.twist[4], w.twist[5] = series(w0, w1, w2, -0.5, factor, t0, t1, t2)


@device
def logarithm_derivative(model, d1, d2, d3, w):
    """Write d log M / dd to w.twist_d (6, 3)."""
    motion_derivative(model, d1, d2, d3, w)
    if model[COUNT] == 0:
        return
    w0, w1, w2 = w.twist[0], w.twist[1], w.twist[2]
    factor, slope = inverse_coefficient(w0 * w0 + w1 * w1 + w2 * w2)
    t0, t1, t2 = w.M[0, 3], w.M[1, 3], w.M[2, 3]
    x0, x1, x2 = cross(w0, w1, w2, t0, t1, t2)
    y0, y1, y2 = cross(w0, w1, w2, x0, x1, x2)
    for k in range(3):
        s0, s1, s2 = w.S[0, k], w.S[1, k], w.S[2, k]
        # the rotation vector changes by the inverse Jacobian of the turn; the translation by W x t + V
        e0, e1, e2 = series(w0, w1, w2, -0.5, factor, s0, s1, s2)
        r0, r1, r2 = cross(s0, s1, s2, t0, t1, t2)
        r0, r1, r2 = r0 + w.S[3, k], r1 + w.S[4, k], r2 + w.S[5, k]
        v0, v1, v2 = series(w0, w1, w2, -0.5, factor, r0, r1, r2)
        f0, f1, f2 = cross(e0, e1, e2, t0, t1, t2)
        g0, g1, g2 = cross(w0, w1, w2, f0, f1, f2)
        h0, h1, h2 = cross(e0, e1, e2, x0, x1, x2)
        along = 2.0 * slope * (w0 * e0 + w1 * e1 + w2 * e2)
        w.twist_d[0, k], w.twist_d[1, k], w.twist_d[2, k] = e0, e1, e2
        w.twist_d[3, k] = v0 - 0.5 * f0 + factor * (g0 + h0) + along * y0
        w.twist_d[4, k] = v1 - 0.5 * f1 + factor * (g1 + h1) + along * y1
        w.twist_d[5, k] = v2 - 0.5 * f2 + factor * (g2 + h2) + along * y2


@device
def pose(model, d1, d2, d3, w, out):
    """Write T_skull_mandible (4, 4) to out."""
    motion(model, d1, d2, d3, w)
    product(model, FROM_ANATOMICAL, w.M, model, CLOSED, out)
    out[3, 0] = out[3, 1] = out[3, 2] = 0.0
    out[3, 3] = 1.0


@device
def parameters_at(model, u0, u1, u2):
    """Return the d [mm] of an incisal displacement u [mm]: the search of `evaluator.gauge.Gauge.inverse`."""
    low, high, x = -np.inf, np.inf, -u1
    for iteration in range(INVERSE_ITERATIONS):
        gx, gz, gx_1, gz_1 = gauge_path(model, x)
        d2 = u0 - gx
        rho, rho_1, rho_2 = gauge_arch(model, x, d2)
        d3 = u2 - gz - rho
        drop, drop_2, drop_3 = gauge_drop(model, d2, d3)
        fade, fade_1 = gauge_fade(model, x)
        excess = x + drop * fade + u1
        d3_1 = -gz_1 - rho_1 + rho_2 * gx_1
        slope = 1.0 + drop * fade_1 + (drop_3 * d3_1 - drop_2 * gx_1) * fade
        step = -excess / (slope if slope > LEAST_INVERSE_SLOPE else 1.0)
        step = min(max(step, -INVERSE_STEP_MM), INVERSE_STEP_MM)
        if abs(step) <= INVERSE_TOLERANCE_MM * (1.0 + abs(x)):
            return x, d2, d3
        if excess < 0:
            low = x
        elif excess > 0:
            high = x
        late = max(iteration - PATIENCE, 0)
        if low == -np.inf or high == np.inf:
            x += min(max(step * 2.0 ** min(late, 64), -INVERSE_STEP_MM), INVERSE_STEP_MM)
        elif x + step <= low or x + step >= high or late % 2 == 1:
            x = 0.5 * (low + high)
        else:
            x += step
    return np.nan, np.nan, np.nan
