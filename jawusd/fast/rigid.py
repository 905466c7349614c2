"""Compiled: rotations, rigid motions and small linear algebra, for one row.

Formulas as in `jawusd.geometry`, which gives their sources.
"""

from __future__ import annotations

from math import cos, sin, sqrt, tan

import numba

# inlined into the functions of `rows` and `searches`, which are the ones kept on disk
device = numba.njit(nogil=True, error_model="numpy")

_SMALL_ANGLE_SQUARED = 1e-4  # as geometry.so3: the series are exact below
_SERIES_SQUARED = 0.09  # below, derivatives of the coefficients come from their series; closed forms lose digits


@device
def cross(a0, a1, a2, b0, b1, b2):
    """Return the cross product."""
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@device
def angle_coefficients(squared):
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


@device
def coefficient_slopes(squared, a, b, c):
    """Return the derivatives by a^2 of the second and third of `angle_coefficients`."""
    x = squared
    if x < _SERIES_SQUARED:
        return (
            -1 / 24 + x * (1 / 360 + x * (-1 / 13440 + x * (1 / 907200 + x * (-1 / 95800320)))),
            -1 / 120 + x * (1 / 2520 + x * (-1 / 120960 + x * (1 / 9979200 + x * (-5 / 6227020800)))),
        )
    return (0.5 * a - b) / x, (-0.5 * (cos(sqrt(x)) - a) / x - c) / x


@device
def inverse_coefficient(squared):
    """Return (1 - h cot h)/a^2, h = a/2, of the inverse left Jacobian, and its derivative by a^2."""
    x = squared
    if x < _SERIES_SQUARED:
        return (
            1 / 12 + x * (1 / 720 + x * (1 / 30240 + x * (1 / 1209600 + x * (1 / 47900160 + x * 5.2841901e-10)))),
            1 / 720 + x * (2 / 30240 + x * (3 / 1209600 + x * (4 / 47900160 + x * (5 * 5.2841901e-10)))),
        )
    angle = sqrt(x)
    cot = 1.0 / tan(0.5 * angle)
    rest = 1.0 - 0.5 * angle * cot
    return rest / x, (0.25 * (0.5 * x * (1.0 + cot * cot) - angle * cot) - rest) / (x * x)


@device
def rotate(w0, w1, w2, M):
    """Write the rotation of a rotation vector [rad] to the first three columns of M (3, 4)."""
    xx, yy, zz = w0 * w0, w1 * w1, w2 * w2
    a, b, _ = angle_coefficients(xx + yy + zz)
    ax, ay, az, xy, xz, yz = a * w0, a * w1, a * w2, b * w0 * w1, b * w0 * w2, b * w1 * w2
    M[0, 0], M[0, 1], M[0, 2] = 1.0 - b * (yy + zz), xy - az, xz + ay
    M[1, 0], M[1, 1], M[1, 2] = xy + az, 1.0 - b * (xx + zz), yz - ax
    M[2, 0], M[2, 1], M[2, 2] = xz - ay, yz + ax, 1.0 - b * (xx + yy)


@device
def series(w0, w1, w2, first, second, v0, v1, v2):
    """Return ``(I + first W + second W W) v``, W the skew matrix of w: the form of both Jacobians of a rotation."""
    x, y, z = cross(w0, w1, w2, v0, v1, v2)
    xx, yy, zz = cross(w0, w1, w2, x, y, z)
    return v0 + first * x + second * xx, v1 + first * y + second * yy, v2 + first * z + second * zz


@device
def move(twist, M):
    """Write the rigid motion exp(twist) to M (3, 4)."""
    w0, w1, w2 = twist[0], twist[1], twist[2]
    rotate(w0, w1, w2, M)
    _, b, c = angle_coefficients(w0 * w0 + w1 * w1 + w2 * w2)
    M[0, 3], M[1, 3], M[2, 3] = series(w0, w1, w2, b, c, twist[3], twist[4], twist[5])


@device
def product(A, first, M, B, second, out):
    """Write the first three rows of L M Q to out, L (4, 4) in A from ``first`` and Q (4, 4) in B from ``second``."""
    for i in range(3):
        l = A[first + 4 * i :]
        for k in range(4):
            q = B[second + k :]
            total = l[3] if k == 3 else 0.0
            for j in range(3):
                total += l[j] * (M[j, 0] * q[0] + M[j, 1] * q[4] + M[j, 2] * q[8] + M[j, 3] * q[12])
            out[i, k] = total


@device
def solve(A, b, x):
    """Write the solution of A x = b, A (3, 3) symmetric, by cofactors; finite even where A is singular."""
    a, p, q, c, s, f = A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2]
    c00, c01, c02 = c * f - s * s, q * s - p * f, p * s - q * c
    c11, c12, c22 = a * f - q * q, p * q - a * s, a * c - p * p
    determinant = a * c00 + p * c01 + q * c02
    scale = 1.0 / (determinant if determinant != 0.0 else 1.0)
    b0, b1, b2 = b[0], b[1], b[2]
    x[0] = (c00 * b0 + c01 * b1 + c02 * b2) * scale
    x[1] = (c01 * b0 + c11 * b1 + c12 * b2) * scale
    x[2] = (c02 * b0 + c12 * b1 + c22 * b2) * scale
