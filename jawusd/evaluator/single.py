"""One pose at a time: the same formulas as `gauge` and `models` in plain floats.

A call on one pose through the array functions spends nearly all its time starting numpy operations on three numbers.
DCC callbacks and face solvers ask for single poses, so the path d -> pose is written out once more here; a test holds
both to the same results.
"""

from __future__ import annotations

from bisect import bisect_right
from math import exp, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from jawusd.evaluator.curves import HermiteCurve
from jawusd.evaluator.gauge import (
    ARCH_BOW_MM,
    DROP_BEND,
    DROP_SATURATION_MM2,
    FADE_SOFTNESS_MM,
    LIMIT_SOFTNESS_MM,
    Gauge,
)
from jawusd.evaluator.models import AdditiveModel, AnchoredModel, JawModelForm

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

_SMALL_ANGLE_SQUARED = 1e-4


class SinglePose:
    """Evaluate one finite d at a time.

    Args:
        model: The jaw model.
        before: Transform applied after the motion M(d), shape (4, 4).
        after: Transform the motion is applied to, shape (4, 4): ``pose = before M(d) after``.
    """

    def __init__(self, model: JawModelForm, before: Array, after: Array) -> None:
        self._before, self._after = before, after
        if isinstance(model, AnchoredModel):
            self._motion = _AnchoredMotion(model)
        else:
            self._motion = _AdditiveMotion(model)

    def pose(self, d1: float, d2: float, d3: float) -> Array:
        """Return the pose (4, 4) at d [mm]."""
        return self._before.dot(np.array(self._motion(d1, d2, d3))).dot(self._after)


class _AnchoredMotion:
    """M(d) of an anchored model as nested lists."""

    def __init__(self, model: AnchoredModel) -> None:
        self._gauge = _FloatGauge(model.gauge)
        self._scales = tuple(model.scales.tolist())
        self._incisor = tuple(model.incisor.tolist())
        count = len(model.centres)
        self._kernel = np.ascontiguousarray(model.weights[:count])
        self._linear = model.weights[count:].tolist()
        self._offset = tuple(model.offset.tolist())
        squared = np.einsum("ij,ij->i", model.centres, model.centres)
        # |q - c|^2 as one product with (q, |q|^2, 1)
        self._distances = np.column_stack([-2.0 * model.centres, np.ones(count), squared])

    def __call__(self, d1: float, d2: float, d3: float) -> list[list[float]]:
        ux, uy, uz = self._gauge.displacement(d1, d2, d3)
        wx, wy, wz = self._rotation(ux, uy, uz)
        rows = _rotation_rows(wx, wy, wz)
        px, py, pz = self._incisor
        for row, u, p in zip(rows, (ux, uy, uz), self._incisor):
            row.append(u + p - (row[0] * px + row[1] * py + row[2] * pz))
        rows.append([0.0, 0.0, 0.0, 1.0])
        return rows

    def _rotation(self, ux: float, uy: float, uz: float) -> Vector:
        gx, gz = self._gauge.path(-uy)
        s0, s1, s2 = self._scales
        q0, q1, q2 = -uy / s0, (ux - gx) / s1, (uz - gz) / s2
        squared = np.abs(self._distances.dot(np.array((q0, q1, q2, q0 * q0 + q1 * q1 + q2 * q2, 1.0))))
        kx, ky, kz = (squared * np.sqrt(squared)).dot(self._kernel).tolist()
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = self._linear
        ox, oy, oz = self._offset
        return (
            kx + q0 * ax + q1 * bx + q2 * cx - ox,
            ky + q0 * ay + q1 * by + q2 * cy - oy,
            kz + q0 * az + q1 * bz + q2 * cz - oz,
        )


class _FloatGauge:
    """`Gauge.displacement` in floats."""

    def __init__(self, gauge: Gauge) -> None:
        self._x, self._z = gauge.path_coefficients.tolist()
        self._scale = gauge.path_scale_mm
        self._low, self._high = gauge.path_limits
        self._arch = gauge.glide_arch.tolist()
        self._drop = gauge.glide_drop.tolist()
        self._softness = gauge.glide_softness_mm
        self._fade_mm = gauge.glide_fade_mm

    def path(self, d1: float) -> tuple[float, float]:
        inside = min(max(d1, self._low), self._high)
        s = inside / self._scale
        a, b, c, d, e = self._x
        x = ((((e * s + d) * s + c) * s + b) * s + a) * s
        f, g, h, i, j = self._z
        z = ((((j * s + i) * s + h) * s + g) * s + f) * s
        if d1 != inside:
            beyond = (d1 - inside) / self._scale
            x += beyond * ((((5 * e * s + 4 * d) * s + 3 * c) * s + 2 * b) * s + a)
            z += beyond * ((((5 * j * s + 4 * i) * s + 3 * h) * s + 2 * g) * s + f)
        return x, z

    def displacement(self, d1: float, d2: float, d3: float) -> Vector:
        gx, gz = self.path(d1)
        rise, stop = d1 - self._low, d1 - self._high
        e = LIMIT_SOFTNESS_MM
        t = (self._low + 0.5 * (rise + sqrt(rise * rise + e * e) - stop - sqrt(stop * stop + e * e))) / self._scale
        e = self._softness
        c = self._arch
        side = sqrt(d2 * d2 + e * e) - e
        bow = (c[5] + c[6] * t) / ARCH_BOW_MM
        rho = side * ((c[2] * t + c[1]) * t + c[0]) + d2 * (c[4] * t + c[3] + d2 * bow)
        front = 0.5 * (d3 + sqrt(d3 * d3 + e * e) - e)
        c = self._drop
        drop = c[0] * side + c[1] * front + DROP_BEND * (
            c[2] * side * side / sqrt(1.0 + side * side / DROP_SATURATION_MM2)
            + c[3] * front * front / sqrt(1.0 + front * front / DROP_SATURATION_MM2)
        )
        ramp = 0.5 * (d1 + sqrt(d1 * d1 + FADE_SOFTNESS_MM * FADE_SOFTNESS_MM) - FADE_SOFTNESS_MM) / self._fade_mm
        return gx + d2, -(d1 + drop * exp(-ramp * ramp)), gz + rho + d3


class _AdditiveMotion:
    """M(d) of an additive model as nested lists."""

    def __init__(self, model: AdditiveModel) -> None:
        self._curves = [_FloatCurve(curve) for curve in model.curves]

    def __call__(self, d1: float, d2: float, d3: float) -> list[list[float]]:
        first, second, third = self._curves
        wx, wy, wz, vx, vy, vz = (first(d1) + second(d2) + third(d3)).tolist()
        rows = _rotation_rows(wx, wy, wz)
        _, b, c = _angle_coefficients(wx * wx + wy * wy + wz * wz)
        ax, ay, az = wy * vz - wz * vy, wz * vx - wx * vz, wx * vy - wy * vx
        rows[0].append(vx + b * ax + c * (wy * az - wz * ay))
        rows[1].append(vy + b * ay + c * (wz * ax - wx * az))
        rows[2].append(vz + b * az + c * (wx * ay - wy * ax))
        rows.append([0.0, 0.0, 0.0, 1.0])
        return rows


class _FloatCurve:
    """`HermiteCurve.value` at one parameter."""

    def __init__(self, curve: HermiteCurve) -> None:
        self._knots = curve.knots.tolist()
        self._coefficients = list(curve.coefficients.transpose(0, 2, 1).copy())

    def __call__(self, x: float) -> Array:
        interval = bisect_right(self._knots, x)
        s = x - self._knots[max(interval - 1, 0)]
        return self._coefficients[interval].dot(np.array((1.0, s, s * s, s * s * s)))


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


def _rotation_rows(x: float, y: float, z: float) -> list[list[float]]:
    """Return the rows of the rotation matrix of a rotation vector (Rodrigues' formula)."""
    xx, yy, zz = x * x, y * y, z * z
    a, b, _ = _angle_coefficients(xx + yy + zz)
    ax, ay, az = a * x, a * y, a * z
    bxy, bxz, byz = b * x * y, b * x * z, b * y * z
    return [
        [1.0 - b * (yy + zz), bxy - az, bxz + ay],
        [bxy + az, 1.0 - b * (xx + zz), byz - ax],
        [bxz - ay, byz + ax, 1.0 - b * (xx + yy)],
    ]
