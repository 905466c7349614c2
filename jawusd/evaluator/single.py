"""One pose at a time: the same formulas as `gauge` and `models` in plain floats.

A call on one pose through the array functions spends nearly all its time starting numpy operations on three numbers.
DCC callbacks and face solvers ask for single poses, so the way from d to a pose and its derivative is written out once
more here; tests hold both to the same results.
"""

from __future__ import annotations

from bisect import bisect_right
from math import exp, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jawusd.evaluator.gauge import (
    ARCH_BOW_MM,
    DROP_BEND,
    DROP_SATURATION_MM2,
    FADE_SOFTNESS_MM,
    LIMIT_SOFTNESS_MM,
)
from jawusd.geometry.arrays import Array

if TYPE_CHECKING:
    from jawusd.evaluator.curves import HermiteCurve
    from jawusd.evaluator.gauge import Gauge
    from jawusd.evaluator.models import AdditiveModel, AnchoredModel

Vector = tuple[float, float, float]
Rows = list[list[float]]

_SMALL_ANGLE_SQUARED = 1e-4
_NEWTON_STEPS = 12
_NEWTON_SETTLED_MM = 1e-8  # the step after it would be below the last digit
_LEAST_NEWTON_SLOPE = 0.2


class SingleAnchored:
    """`AnchoredModel` for one finite d or u."""

    def __init__(self, model: AnchoredModel) -> None:
        self._gauge = SingleGauge(model.gauge)
        self._scales = tuple(model.scales.tolist())
        self._incisor = tuple(model.incisor.tolist())
        self._offset = tuple(model.offset.tolist())
        self._linear = model.weights[len(model.centres) :].tolist()
        self._kernel = np.ascontiguousarray(model.weights[: len(model.centres)])
        self._moments = np.ascontiguousarray(model.moments[:, :12].T)
        # |q - c|^2 as one product with (q, |q|^2, 1)
        self._distances = np.column_stack([-2.0 * model.centres, np.ones(len(model.centres)), model.centres_squared])

    def motion(self, d1: float, d2: float, d3: float) -> Rows:
        """Return the rows of M(d), 4x4."""
        ux, uy, uz = self._gauge.displacement(d1, d2, d3)
        gx, gz = self._gauge.path(-uy)
        omega, _ = self._rotation((-uy, ux - gx, uz - gz))
        return self._anchored(_rotation_rows(*omega), (ux, uy, uz))

    def decode_derivative(self, d: Array) -> tuple[Array, Array, Array]:
        """Return R (1, 3, 3), t (1, 3) and S (1, 6, 3) for one row d (1, 3)."""
        u, by_d = self._gauge.displacement_jacobian(*d[0].tolist())
        return self._derivative(u, np.array(by_d))

    def motion_derivative_at(self, u: Array) -> tuple[Array, Array, Array]:
        """Return R (1, 3, 3), t (1, 3) and S (1, 6, 3) by u for one row u (1, 3)."""
        return self._derivative(tuple(u[0].tolist()), np.eye(3))

    def parameters_at(self, u: Array) -> Array | None:
        """Return the d (1, 3) of one row u (1, 3), or None where plain Newton does not settle."""
        found = self._gauge.inverse(tuple(u[0].tolist()))
        return None if found is None else np.array([found])

    def _derivative(self, u: Vector, by_d: Array) -> tuple[Array, Array, Array]:
        ux, uy, uz = u
        gx, gz, gx_1, gz_1 = self._gauge.path_slopes(-uy)
        omega, r = self._rotation((-uy, ux - gx, uz - gz))
        s0, s1, s2 = self._scales
        q = (-uy / s0, (ux - gx) / s1, (uz - gz) / s2)
        sums = self._moments.dot(r).tolist()
        # 3 sum W r (q - c) plus the linear terms, per output; then the shear from u to q
        omega_u = []
        for k in range(3):
            plain = sums[k]
            a, b, c = (3.0 * (plain * q[i] - sums[3 + 3 * k + i]) + self._linear[i][k] for i in range(3))
            b, c = b / s1, c / s2
            omega_u.append((b, -a / s0 + b * gx_1 + c * gz_1, c))
        rows = _rotation_rows(*omega)
        M = np.array(self._anchored(rows, u))
        S = np.empty((1, 6, 3))
        spin = S[0, :3] = np.array(_left_jacobian_rows(*omega)).dot(np.array(omega_u)).dot(by_d)
        px, py, pz = (a + b for a, b in zip(u, self._incisor))
        S[0, 3:] = by_d + np.array(((0.0, -pz, py), (pz, 0.0, -px), (-py, px, 0.0))).dot(spin)
        return M[None, :3, :3], M[None, :3, 3], S

    def _anchored(self, rows: Rows, u: Vector) -> Rows:
        """Return the rows of the motion with this rotation that carries the incisal point by u."""
        px, py, pz = self._incisor
        for row, shift, p in zip(rows, u, self._incisor):
            row.append(shift + p - (row[0] * px + row[1] * py + row[2] * pz))
        rows.append([0.0, 0.0, 0.0, 1.0])
        return rows

    def _rotation(self, sheared: Vector) -> tuple[Vector, Array]:
        """Return f(u) [rad] and the distances to the centres (m,), from the sheared displacement [mm]."""
        s0, s1, s2 = self._scales
        q0, q1, q2 = sheared[0] / s0, sheared[1] / s1, sheared[2] / s2
        squared = np.abs(self._distances.dot(np.array((q0, q1, q2, q0 * q0 + q1 * q1 + q2 * q2, 1.0))))
        r = np.sqrt(squared)
        kx, ky, kz = (squared * r).dot(self._kernel).tolist()
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = self._linear
        ox, oy, oz = self._offset
        return (
            kx + q0 * ax + q1 * bx + q2 * cx - ox,
            ky + q0 * ay + q1 * by + q2 * cy - oy,
            kz + q0 * az + q1 * bz + q2 * cz - oz,
        ), r


class SingleGauge:
    """`Gauge` for one d."""

    def __init__(self, gauge: Gauge) -> None:
        self._x, self._z = gauge.path_coefficients.tolist()
        self._scale = gauge.path_scale_mm
        self._low, self._high = gauge.path_limits
        self._arch = gauge.glide_arch.tolist()
        self._drop = gauge.glide_drop.tolist()
        self._softness = gauge.glide_softness_mm
        self._fade_mm = gauge.glide_fade_mm

    def path(self, d1: float) -> tuple[float, float]:
        """Return gx, gz [mm] at d1 [mm]."""
        if not self._low <= d1 <= self._high:
            return self.path_slopes(d1)[:2]
        s = d1 / self._scale
        a, b, c, d, e = self._x
        f, g, h, i, j = self._z
        return ((((e * s + d) * s + c) * s + b) * s + a) * s, ((((j * s + i) * s + h) * s + g) * s + f) * s

    def path_slopes(self, d1: float) -> tuple[float, float, float, float]:
        """Return gx, gz [mm] and their slopes at d1 [mm]."""
        inside = min(max(d1, self._low), self._high)
        s, beyond = inside / self._scale, d1 - inside
        a, b, c, d, e = self._x
        f, g, h, i, j = self._z
        x_1 = ((((5 * e * s + 4 * d) * s + 3 * c) * s + 2 * b) * s + a) / self._scale
        z_1 = ((((5 * j * s + 4 * i) * s + 3 * h) * s + 2 * g) * s + f) / self._scale
        x = ((((e * s + d) * s + c) * s + b) * s + a) * s + x_1 * beyond
        z = ((((j * s + i) * s + h) * s + g) * s + f) * s + z_1 * beyond
        return x, z, x_1, z_1

    def _clamped(self, d1: float) -> tuple[float, float]:
        """Return d1 softly clamped to the limits, in units of the path's scale, and its slope."""
        rise, stop = d1 - self._low, d1 - self._high
        square = LIMIT_SOFTNESS_MM * LIMIT_SOFTNESS_MM
        root_rise, root_stop = sqrt(rise * rise + square), sqrt(stop * stop + square)
        inside = self._low + 0.5 * (rise + root_rise - stop - root_stop)
        return inside / self._scale, 0.5 * (rise / root_rise - stop / root_stop) / self._scale

    def displacement(self, d1: float, d2: float, d3: float) -> Vector:
        """Return u [mm] of d [mm]."""
        gx, gz = self.path(d1)
        t, _ = self._clamped(d1)
        e = self._softness
        c = self._arch
        side = sqrt(d2 * d2 + e * e) - e
        bow = (c[5] + c[6] * t) / ARCH_BOW_MM
        rho = side * ((c[2] * t + c[1]) * t + c[0]) + d2 * (c[4] * t + c[3] + d2 * bow)
        front = 0.5 * (d3 + sqrt(d3 * d3 + e * e) - e)
        c = self._drop
        drop = c[0] * side + c[1] * front + c[2] * _bent(side)[0] + c[3] * _bent(front)[0]
        ramp = 0.5 * (d1 + sqrt(d1 * d1 + FADE_SOFTNESS_MM * FADE_SOFTNESS_MM) - FADE_SOFTNESS_MM) / self._fade_mm
        return gx + d2, -(d1 + drop * exp(-ramp * ramp)), gz + rho + d3

    def displacement_jacobian(self, d1: float, d2: float, d3: float) -> tuple[Vector, Rows]:
        """Return u [mm] of d [mm] and the rows of du/dd."""
        gx, gz, gx_1, gz_1 = self.path_slopes(d1)
        t, t_1 = self._clamped(d1)
        e = self._softness
        c = self._arch
        root2, root3 = sqrt(d2 * d2 + e * e), sqrt(d3 * d3 + e * e)
        side, side_2 = root2 - e, d2 / root2
        front, front_3 = 0.5 * (d3 + root3 - e), 0.5 * (1.0 + d3 / root3)
        by_side, by_d2, bow = (c[2] * t + c[1]) * t + c[0], c[4] * t + c[3], (c[6] * t + c[5]) / ARCH_BOW_MM
        rho = side * by_side + d2 * (by_d2 + d2 * bow)
        rho_1 = (side * (2 * c[2] * t + c[1]) + d2 * (c[4] + d2 * (c[6] / ARCH_BOW_MM))) * t_1
        rho_2 = side_2 * by_side + by_d2 + 2 * d2 * bow
        c = self._drop
        (bent2, bent2_1), (bent3, bent3_1) = _bent(side), _bent(front)
        drop = c[0] * side + c[1] * front + c[2] * bent2 + c[3] * bent3
        drop_2, drop_3 = (c[0] + c[2] * bent2_1) * side_2, (c[1] + c[3] * bent3_1) * front_3
        root1 = sqrt(d1 * d1 + FADE_SOFTNESS_MM * FADE_SOFTNESS_MM)
        ramp, ramp_1 = 0.5 * (d1 + root1 - FADE_SOFTNESS_MM) / self._fade_mm, 0.5 * (1.0 + d1 / root1) / self._fade_mm
        fade = exp(-ramp * ramp)
        fade_1 = -2.0 * fade * ramp * ramp_1
        u = gx + d2, -(d1 + drop * fade), gz + rho + d3
        rows = [[gx_1, 1.0, 0.0], [-(1.0 + drop * fade_1), -drop_2 * fade, -drop_3 * fade], [gz_1 + rho_1, rho_2, 1.0]]
        return u, rows

    def inverse(self, u: Vector) -> Vector | None:
        """Return the d [mm] of u [mm] by plain Newton, or None if that does not settle (see `Gauge.inverse`)."""
        ux, uy, uz = u
        gx, gz = self.path(-uy)
        d1, d2, d3 = -uy, ux - gx, uz - gz
        for _ in range(_NEWTON_STEPS):
            (x, y, z), ((g, _, _), (a, b, c), (h, k, _)) = self.displacement_jacobian(d1, d2, d3)
            rx, ry, rz = ux - x, uy - y, uz - z
            slope = a - b * g - c * (h - k * g)
            if slope > -_LEAST_NEWTON_SLOPE:  # y falls with opening wherever the gauge is a gauge
                return None
            s1 = (ry - b * rx - c * (rz - k * rx)) / slope
            s2 = rx - g * s1
            s3 = rz - h * s1 - k * s2
            d1, d2, d3 = d1 + s1, d2 + s2, d3 + s3
            if abs(s1) + abs(s2) + abs(s3) < _NEWTON_SETTLED_MM:
                return d1, d2, d3
        return None


class SingleAdditive:
    """`AdditiveModel` for one finite d."""

    def __init__(self, model: AdditiveModel) -> None:
        self._curves = [_SingleCurve(curve) for curve in model.curves]

    def motion(self, d1: float, d2: float, d3: float) -> Rows:
        """Return the rows of M(d), 4x4."""
        first, second, third = self._curves
        return motion_rows(*(first(d1) + second(d2) + third(d3)).tolist())


class _SingleCurve:
    """`HermiteCurve.value` at one parameter."""

    def __init__(self, curve: HermiteCurve) -> None:
        self._knots = curve.knots.tolist()
        self._coefficients = list(curve.coefficients.transpose(0, 2, 1).copy())

    def __call__(self, x: float) -> Array:
        interval = bisect_right(self._knots, x)
        s = x - self._knots[max(interval - 1, 0)]
        return self._coefficients[interval].dot(np.array((1.0, s, s * s, s * s * s)))


def motion_rows(wx: float, wy: float, wz: float, vx: float, vy: float, vz: float) -> Rows:
    """Return the rows of the rigid motion of a twist, omega = w [rad] and v [mm], 4x4."""
    rows = _rotation_rows(wx, wy, wz)
    for row, jacobian in zip(rows, _left_jacobian_rows(wx, wy, wz)):
        row.append(jacobian[0] * vx + jacobian[1] * vy + jacobian[2] * vz)
    rows.append([0.0, 0.0, 0.0, 1.0])
    return rows


def _bent(x: float) -> tuple[float, float]:
    w = 1.0 + x * x / DROP_SATURATION_MM2
    root = sqrt(w)
    return DROP_BEND * x * x / root, DROP_BEND * x * (1.0 + w) / (w * root)


def _angle_coefficients(squared: float) -> Vector:
    """Return sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 for a^2."""
    if squared < _SMALL_ANGLE_SQUARED:
        return (
            1.0 - squared / 6.0 * (1.0 - squared / 20.0 * (1.0 - squared / 42.0)),
            0.5 - squared / 24.0 * (1.0 - squared / 30.0 * (1.0 - squared / 56.0)),
            1.0 / 6.0 - squared / 120.0 * (1.0 - squared / 42.0 * (1.0 - squared / 72.0)),
        )
    angle = sqrt(squared)
    sine, half = sin(angle), sin(0.5 * angle)
    return sine / angle, 2.0 * half * half / squared, (angle - sine) / (squared * angle)


def _rotation_rows(x: float, y: float, z: float) -> Rows:
    """Return the rows of the rotation matrix of a rotation vector (Rodrigues' formula)."""
    a, b, _ = _angle_coefficients(x * x + y * y + z * z)
    return _series_rows(x, y, z, a, b)


def _left_jacobian_rows(x: float, y: float, z: float) -> Rows:
    """Return the rows of the left Jacobian of a rotation vector."""
    _, b, c = _angle_coefficients(x * x + y * y + z * z)
    return _series_rows(x, y, z, b, c)


def _series_rows(x: float, y: float, z: float, a: float, b: float) -> Rows:
    """Return the rows of ``I + a W + b W W``, W the skew matrix of (x, y, z)."""
    xx, yy, zz = x * x, y * y, z * z
    ax, ay, az = a * x, a * y, a * z
    bxy, bxz, byz = b * x * y, b * x * z, b * y * z
    return [
        [1.0 - b * (yy + zz), bxy - az, bxz + ay],
        [bxy + az, 1.0 - b * (xx + zz), byz - ax],
        [bxz - ay, byz + ax, 1.0 - b * (xx + yy)],
    ]
