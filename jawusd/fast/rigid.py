"""Decorators that compile functions, and compiled rotations, rigid motions and small linear algebra, one at a time."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import partial
from math import cos, sqrt, tan
from typing import TypeVar, cast

import numba
from numba.extending import register_jitable

from jawusd.base.arrays import Array
from jawusd.evaluator import gauge
from jawusd.evaluator.gauge import Elementary
from jawusd.geometry import rodrigues
from jawusd.geometry.rodrigues import angle_coefficients, apply_series, dot, turning

F = TypeVar("F")

_in_memory = partial(numba.njit, nogil=True, error_model="numpy")
_cacheable: list[bool] = []  # whether machine code can be cached on disk; empty until the first function is compiled


def compiled(signature: str) -> Callable[[F], F]:
    """Return a decorator that compiles a function for the argument types of a signature.

    Without a writable cache folder the code is kept in memory only, and one RuntimeWarning is issued.
    """

    def compile_function(function: F) -> F:
        if not _cacheable or _cacheable[0]:
            try:
                made = cast("F", _in_memory(signature, cache=True)(function))
            except (OSError, RuntimeError) as error:  # no cache folder is writable, or the disk is full
                _cacheable[:] = [False]
                _warn(error)
            else:
                _cacheable[:] = [True]
                return made
        return cast("F", _in_memory(signature)(function))

    return compile_function


def _warn(error: Exception) -> None:
    warnings.warn(
        f"jawusd.fast cannot cache its compiled code on disk ({error}): every process compiles for some 20 seconds. "
        "Set NUMBA_CACHE_DIR to a writable folder.",
        RuntimeWarning,
        stacklevel=4,
    )


Vector = tuple[float, float, float]

# device functions are not cached themselves: they are inlined into the functions of `kernels`, which are cached on disk
device = numba.njit(nogil=True, error_model="numpy")
# like `device`, but sums may be reassociated
summing = numba.njit(nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})

# Plain functions from other modules, called by compiled code. Without inlining, the functions in an `Elementary` would
# be addresses in the machine code, which could then not be cached on disk.
for _function in (
    *(rodrigues.angle_series, rodrigues.angle_quotients, rodrigues.angle_coefficients, rodrigues.cross, rodrigues.dot),
    *(rodrigues.apply_series, rodrigues.turning, gauge.path_polynomial, gauge.path),
    *(gauge.arch, gauge.drop, gauge.fade, gauge.displacement, gauge.opening_equation, gauge.inverse),
    *(gauge.spline_input, gauge.gradient_by_u),
):
    register_jitable(forceinline=True, nogil=True, error_model="numpy")(_function)

# Squared angle [rad^2] below which derivatives of the coefficients use series, since closed forms lose precision.
_SERIES_SQUARED = 0.09


@device
def _sqrt(x: float) -> float:
    return math.sqrt(x)


@device
def _exp(x: float) -> float:
    return math.exp(x)


@device
def _clip(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


@device
def interval(knots: Array, count: int, x: float) -> int:
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
def _glide(table: Array, d2: float, d3: float) -> Vector:
    """Return the result of `curves.GlideTable.at_floats` for a packed table (see `kinds`); zeros without a table."""
    count2, count3 = int(table[0]), int(table[1])
    if count2 == 0:
        return 0.0, 0.0, 0.0
    side, front = table[2:], table[3 + 2 * count2 :]
    i, j = interval(side, count2, d2), interval(front, count3, d3)
    s, t = d2 - side[count2 + i], d3 - front[count3 + j]
    c = table[4 + 2 * count2 + 2 * count3 + 16 * (i * (count3 + 1) + j) :]
    down = down_2 = down_3 = 0.0
    for k in range(3, -1, -1):  # Horner's scheme, from the highest power of d3 to the lowest
        a = ((c[12 + k] * s + c[8 + k]) * s + c[4 + k]) * s + c[k]
        b = (3.0 * c[12 + k] * s + 2.0 * c[8 + k]) * s + c[4 + k]
        down_3 = down_3 * t + down
        down = down * t + a
        down_2 = down_2 * t + b
    return down, down_2, down_3


FLOATS = Elementary(_sqrt, _exp, _clip, cast("Callable[[object, float, float], Vector]", _glide))


@device
def coefficient_slopes(squared: float, a: float, b: float, c: float) -> tuple[float, float]:
    """Return the derivatives of b and c of `angle_coefficients` with respect to the squared angle."""
    x = squared
    if x < _SERIES_SQUARED:
        return (
            -1 / 24 + x * (1 / 360 + x * (-1 / 13440 + x * (1 / 907200 + x * (-1 / 95800320)))),
            -1 / 120 + x * (1 / 2520 + x * (-1 / 120960 + x * (1 / 9979200 + x * (-5 / 6227020800)))),
        )
    return (0.5 * a - b) / x, (-0.5 * (cos(sqrt(x)) - a) / x - c) / x


@device
def inverse_coefficient(squared: float) -> tuple[float, float]:
    """Return (1 - h cot h)/a^2, h = a/2, of the inverse left Jacobian, and its derivative with respect to a^2."""
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
def rotate(omega: Vector, M: Array) -> None:
    """Write the rotation of a rotation vector [rad] to the first three columns of M (3, 4)."""
    a, b, _ = angle_coefficients(dot(omega, omega))
    rows = turning(omega, a, b)
    for i in range(3):
        M[i, 0], M[i, 1], M[i, 2] = rows[i]
        M[i, i] += 1.0


@device
def move(twist: Array, M: Array) -> None:
    """Write the rigid motion exp(twist) to M (3, 4)."""
    omega = (twist[0], twist[1], twist[2])
    rotate(omega, M)
    _, b, c = angle_coefficients(dot(omega, omega))
    M[0, 3], M[1, 3], M[2, 3] = apply_series(omega, (twist[3], twist[4], twist[5]), b, c)


@device
def product(A: Array, first: int, M: Array, B: Array, second: int, out: Array) -> None:
    """Write the first three rows of L M Q to out; L (4, 4) starts at A[first], Q (4, 4) at B[second]."""
    for i in range(3):
        l = A[first + 4 * i :]
        for k in range(4):
            q = B[second + k :]
            total = l[3] if k == 3 else 0.0
            for j in range(3):
                total += l[j] * (M[j, 0] * q[0] + M[j, 1] * q[4] + M[j, 2] * q[8] + M[j, 3] * q[12])
            out[i, k] = total


@device
def solve(A: Array, b: Array, x: Array) -> None:
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
