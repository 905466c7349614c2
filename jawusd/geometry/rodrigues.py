"""Rodrigues' formula in arithmetic operators alone, for floats, arrays, tensors and graph values.

With W the skew matrix of a rotation vector omega and x = |omega|^2, the rotation is ``I + a W + b W W`` and its left
Jacobian ``I + b W + c W W``, where a = sin t / t, b = (1 - cos t) / t^2, c = (t - sin t) / t^3 and t = sqrt(x) (Sola,
Deray, Atchuthan 2018, eqs. 132 to 148). This file imports only the standard library: it is copied into the
single-file reader.
"""

from __future__ import annotations

import math
from typing import Protocol, TypeVar

# Squared angle [rad^2] below which the closed forms lose precision; the series used instead are exact to double
# precision.
SMALL_SQUARED_ANGLE = 1e-4


class Number(Protocol):
    """The arithmetic that formulas need, between two values of a number type and between a value and a float."""

    def __add__(self: N, other: N | float, /) -> N: ...
    def __radd__(self: N, other: float, /) -> N: ...
    def __sub__(self: N, other: N | float, /) -> N: ...
    def __rsub__(self: N, other: float, /) -> N: ...
    def __mul__(self: N, other: N | float, /) -> N: ...
    def __rmul__(self: N, other: float, /) -> N: ...
    def __truediv__(self: N, other: N | float, /) -> N: ...
    def __neg__(self: N) -> N: ...


N = TypeVar("N", bound=Number)
Triple = tuple[N, N, N]


def angle_series(x: N) -> Triple[N]:
    """Return the coefficients a, b and c at a small squared angle x [rad^2], from their power series."""
    return (
        1.0 - x / 6.0 * (1.0 - x / 20.0 * (1.0 - x / 42.0)),
        0.5 - x / 24.0 * (1.0 - x / 30.0 * (1.0 - x / 56.0)),
        1.0 / 6.0 - x / 120.0 * (1.0 - x / 42.0 * (1.0 - x / 72.0)),
    )


def angle_quotients(x: N, angle: N, sine: N, sine_of_half: N) -> Triple[N]:
    """Return a, b and c at a squared angle x [rad^2], not small, given the angle, its sine and the sine of its half."""
    return sine / angle, 2.0 * sine_of_half * sine_of_half / x, (angle - sine) / (x * angle)


def angle_coefficients(x: float) -> Triple[float]:
    """Return the coefficients a, b and c of Rodrigues' formula at a squared angle x [rad^2]."""
    if x < SMALL_SQUARED_ANGLE:
        return angle_series(x)
    angle = math.sqrt(x)
    return angle_quotients(x, angle, math.sin(angle), math.sin(0.5 * angle))


def cross(a: Triple[N], b: Triple[N]) -> Triple[N]:
    """Return the cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def dot(a: Triple[N], b: Triple[N]) -> N:
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def apply_series(omega: Triple[N], v: Triple[N], first: N | float, second: N | float) -> Triple[N]:
    """Return ``(I + first W + second W W) v``: a rotation, its left Jacobian or its inverse applied to v."""
    once = cross(omega, v)
    twice = cross(omega, once)
    return (
        v[0] + once[0] * first + twice[0] * second,
        v[1] + once[1] * first + twice[1] * second,
        v[2] + once[2] * first + twice[2] * second,
    )


def turning(omega: Triple[N], a: N | float, b: N | float) -> tuple[Triple[N], Triple[N], Triple[N]]:
    """Return the rows of ``a W + b W W``, the rotation minus the identity, which is accurate for small rotations."""
    x, y, z = omega
    ax, ay, az = x * a, y * a, z * a
    bx, by, bz = x * b, y * b, z * b
    xx, yy, zz, xy, xz, yz = x * bx, y * by, z * bz, x * by, x * bz, y * bz
    return (-(yy + zz), xy - az, xz + ay), (xy + az, -(xx + zz), yz - ax), (xz - ay, yz + ax, -(xx + yy))
