"""The jaw model's formulas, stated once for every kind of number.

Each function takes numbers that know ``+ - * /`` (floats, numpy arrays, torch tensors, values of an ONNX graph, sockets
of Blender nodes) and, where a formula needs more, an `Operations` object for that kind. The torch layer, the ONNX
exporter, the Blender nodes and the single-file reader are built from these functions; `jawusd.evaluator.derivatives`
is the one other statement, with derivatives, for floats, compiled code and numpy.

This file imports nothing but the standard library and `jawusd.geometry.rodrigues`: both are copied into the reader.

The gauge maps the parameters d = (d1 opening, d2 laterotrusion, d3 protrusion) [mm] to the displacement u [mm] of the
lower incisal point, anatomical frame (x left, y up, z anterior):

    x = gx(d1) + d2
    y = -(d1 + drop(d2, d3) fade(d1))
    z = gz(d1) + rho(d2, d1) + d3

gx, gz: the habitual opening path; rho: the gothic arch of a lateral excursion; drop: the tooth-glide surface that the
jaw clears when it slides with the teeth together, fading out with opening.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

from jawusd.geometry.rodrigues import (
    SMALL_SQUARED_ANGLE,
    N,
    Triple,
    angle_quotients,
    angle_series,
    apply_series,
    dot,
)

FADE_SOFTNESS_MM = 1.0  # rounding of the kink at d1 = 0 in the fading of the glide surface
LIMIT_SOFTNESS_MM = 4.0  # rounding of the kinks where the gothic arch stops changing with opening
ARCH_BOW_MM = 10.0  # the quadratic arch features are d2^2 / 10 mm, to keep all coefficients of one order
DROP_BEND = 0.15  # slope gained by the bent drop features per mm, saturating at 4 mm (below)
DROP_SATURATION_MM2 = 16.0

Weights = TypeVar("Weights", contravariant=True)


class GaugeNumbers(NamedTuple):
    """The numbers of a gauge.

    Attributes:
        path_x: Coefficients of gx: ``sum_k c_k (d1 / path_scale_mm)^k, k = 1..5`` [mm].
        path_z: Coefficients of gz, alike.
        path_scale_mm: Length that makes the polynomials' argument of order one.
        low_mm: Smallest d1 at which the polynomials hold; beyond the limits they go on as straight lines.
        high_mm: Largest such d1.
        arch: Coefficients of rho, 7.
        drop: Coefficients of drop, 4.
        softness_mm: Radius of the softened absolute value and ramp.
        fade_mm: Opening over which the glide surface fades out.
    """

    path_x: Sequence[float]
    path_z: Sequence[float]
    path_scale_mm: float
    low_mm: float
    high_mm: float
    arch: Sequence[float]
    drop: Sequence[float]
    softness_mm: float
    fade_mm: float


class Operations(Protocol[N]):
    """What the formulas need of a kind of number beyond arithmetic."""

    def sqrt(self, x: N) -> N:
        """Return the square root."""

    def exp(self, x: N) -> N:
        """Return the exponential."""

    def clip(self, x: N, low: float, high: float) -> N:
        """Return x limited to [low, high]."""

    def angle_coefficients(self, squared: N) -> Triple[N]:
        """Return the coefficients a, b and c of `jawusd.geometry.rodrigues` at a squared angle [rad^2]."""

    def log_sum_exp(self, terms: Sequence[N]) -> N:
        """Return the logarithm of the sum of the exponentials of all terms."""


class FloatOperations:
    """`Operations` on Python's floats."""

    sqrt = staticmethod(math.sqrt)
    exp = staticmethod(math.exp)

    @staticmethod
    def clip(x: float, low: float, high: float) -> float:
        """Return x limited to [low, high]."""
        return min(max(x, low), high)

    @staticmethod
    def angle_coefficients(squared: float) -> Triple[float]:
        """Return a, b and c at a squared angle [rad^2]."""
        if squared < SMALL_SQUARED_ANGLE:
            return angle_series(squared)
        angle = math.sqrt(squared)
        return angle_quotients(squared, angle, math.sin(angle), math.sin(0.5 * angle))

    @staticmethod
    def log_sum_exp(terms: Sequence[float]) -> float:
        """Return the logarithm of the sum of exponentials, free of overflow."""
        peak = max(terms)
        return peak + math.log(sum(math.exp(term - peak) for term in terms))


def polynomial(coefficients: Sequence[N | float], x: N) -> N:
    """Return ``sum_k coefficients[k] x^k`` of two coefficients or more (Horner's scheme)."""
    value = x * coefficients[-1] + coefficients[-2]
    for coefficient in reversed(coefficients[:-2]):
        value = value * x + coefficient
    return value


def soft_absolute(x: N, softness_mm: float, ops: Operations[N]) -> N:
    """Return |x| with the kink rounded, zero at zero: ``sqrt(x^2 + e^2) - e``."""
    return ops.sqrt(x * x + softness_mm * softness_mm) - softness_mm


def soft_ramp(x: N, softness_mm: float, ops: Operations[N]) -> N:
    """Return max(x, 0) with the kink rounded, zero at zero: ``(x + sqrt(x^2 + e^2) - e) / 2``."""
    return 0.5 * (x + soft_absolute(x, softness_mm, ops))


def bent(x: N, ops: Operations[N]) -> N:
    """Return ``0.15 x^2 / sqrt(1 + x^2 / 16)`` [mm]: a drop that steepens and then runs straight."""
    square = x * x
    return DROP_BEND * square / ops.sqrt(1.0 + square / DROP_SATURATION_MM2)


def path(gauge: GaugeNumbers, d1: N, ops: Operations[N]) -> tuple[N, N]:
    """Return gx and gz [mm] at opening d1 [mm]."""
    inside = ops.clip(d1, gauge.low_mm, gauge.high_mm)
    s, beyond = inside / gauge.path_scale_mm, d1 - inside

    def along(c: Sequence[float]) -> N:
        slope = polynomial([k * x / gauge.path_scale_mm for k, x in enumerate(c, start=1)], s)
        return polynomial(c, s) * s + slope * beyond

    return along(gauge.path_x), along(gauge.path_z)


def arch(gauge: GaugeNumbers, d1: N, d2: N, ops: Operations[N]) -> N:
    """Return rho [mm]: how far forward a lateral excursion d2 [mm] carries the incisal point at opening d1 [mm]."""
    rise = soft_ramp(d1 - gauge.low_mm, LIMIT_SOFTNESS_MM, ops)
    stop = soft_ramp(d1 - gauge.high_mm, LIMIT_SOFTNESS_MM, ops)
    t = (rise - stop + gauge.low_mm) / gauge.path_scale_mm
    c = gauge.arch
    side = soft_absolute(d2, gauge.softness_mm, ops)
    bow = polynomial([c[5] / ARCH_BOW_MM, c[6] / ARCH_BOW_MM], t)
    return side * polynomial(c[:3], t) + d2 * (polynomial(c[3:5], t) + d2 * bow)


def drop(gauge: GaugeNumbers, d2: N, d3: N, ops: Operations[N]) -> N:
    """Return how far the tooth-glide surface pushes the jaw down at d2, d3 [mm]."""
    side = soft_absolute(d2, gauge.softness_mm, ops)
    front = soft_ramp(d3, gauge.softness_mm, ops)
    c = gauge.drop
    return side * c[0] + front * c[1] + bent(side, ops) * c[2] + bent(front, ops) * c[3]


def fade(gauge: GaugeNumbers, d1: N, ops: Operations[N]) -> N:
    """Return the share of the glide surface felt at opening d1 [mm]."""
    x = soft_ramp(d1, FADE_SOFTNESS_MM, ops) / gauge.fade_mm
    return ops.exp(-(x * x))


def displacement(gauge: GaugeNumbers, d: Triple[N], ops: Operations[N]) -> Triple[N]:
    """Return the displacement u [mm] of the incisal point at the jaw parameters d [mm]."""
    d1, d2, d3 = d
    gx, gz = path(gauge, d1, ops)
    down = d1 + drop(gauge, d2, d3, ops) * fade(gauge, d1, ops)
    return gx + d2, -down, gz + arch(gauge, d1, d2, ops) + d3


def spline_input(gauge: GaugeNumbers, scales: Sequence[float], u: Triple[N], ops: Operations[N]) -> Triple[N]:
    """Return the argument of the spline: u [mm] sheared by the habitual path, over the scales [mm]."""
    opening = -u[1]
    gx, gz = path(gauge, opening, ops)
    return opening / scales[0], (u[0] - gx) / scales[1], (u[2] - gz) / scales[2]


class Kernels(Protocol[N, Weights]):
    """How a kind of number adds up the kernels of a spline."""

    def weighted(self, kernel: N, weights: Weights) -> Triple[N]:
        """Return the kernels, one number or all of a block, times their weights, summed over the block."""


def spline(
    q: Triple[N],
    blocks: Iterable[tuple[Triple[N] | Triple[float], Weights]],
    linear: Sequence[Sequence[float]],
    kernels: Kernels[N, Weights],
    ops: Operations[N],
) -> Triple[N]:
    """Return ``sum_i W_i |q - c_i|^3 + q L``: a polyharmonic spline with a linear tail (Duchon 1977).

    Args:
        q: Where, see `spline_input`.
        blocks: Centres and kernel weights, one centre at a time or, for kinds that hold many numbers, several.
        linear: The linear terms, 3 inputs times 3 outputs.
        kernels: Sums weighted kernels.
        ops: Operations on numbers.
    """
    x, y, z = (q[0] * linear[0][k] + q[1] * linear[1][k] + q[2] * linear[2][k] for k in range(3))
    for centre, weights in blocks:
        away = (q[0] - centre[0], q[1] - centre[1], q[2] - centre[2])
        squared = dot(away, away)
        a, b, c = kernels.weighted(squared * ops.sqrt(squared), weights)
        x, y, z = x + a, y + b, z + c
    return x, y, z


class RigidMotion(NamedTuple, Generic[N]):
    """A rigid motion.

    Attributes:
        omega: Rotation vector [rad].
        t: Translation [mm].
        coefficients: a, b and c of `jawusd.geometry.rodrigues` for omega.
    """

    omega: Triple[N]
    t: Triple[N]
    coefficients: Triple[N]

    def rotate(self, v: Triple[N]) -> Triple[N]:
        """Return a vector turned."""
        return apply_series(self.omega, v, self.coefficients[0], self.coefficients[1])


def anchored_motion(omega: Triple[N], u: Triple[N], anchor: Triple[N], ops: Operations[N]) -> RigidMotion[N]:
    """Return the motion that turns by omega [rad] and carries the anchor [mm] by u [mm]: ``t = u + p - R p``."""
    still = RigidMotion(omega, u, ops.angle_coefficients(dot(omega, omega)))
    turned = still.rotate(anchor)
    t = tuple(u[i] + anchor[i] - turned[i] for i in range(3))
    return still._replace(t=(t[0], t[1], t[2]))


def twist_motion(omega: Triple[N], v: Triple[N], ops: Operations[N]) -> RigidMotion[N]:
    """Return the motion exp(omega, v) of a twist (omega [rad], v [mm])."""
    a, b, c = ops.angle_coefficients(dot(omega, omega))
    return RigidMotion(omega, apply_series(omega, v, b, c), (a, b, c))


def cubic(h: N, y0: N, y1: N, m0: N, m1: N) -> tuple[N, N, N, N]:
    """Return the powers 0..3 of the cubic Hermite polynomial over an interval of length h.

    Args:
        h: Length of the interval.
        y0: Value at its start.
        y1: Value at its end.
        m0: Slope at its start.
        m1: Slope at its end.
    """
    rise = (y1 - y0) / h
    return y0, m0, (3.0 * rise - 2.0 * m0 - m1) / h, (m0 + m1 - 2.0 * rise) / (h * h)


def catmull_rom(before: N, after: N, span: N) -> N:
    """Return the slope at a knot from the values before and after it, span apart."""
    return (after - before) / span


def signed_distance(v: Sequence[N], softness_mm: float, margin_mm: float, ops: Operations[N]) -> N:
    """Return how far outside a slice hull a point lies [mm], negative inside: the soft maximum of its half-spaces.

    Args:
        v: How far outside each half-space it lies [mm], see `half_spaces`.
        softness_mm: Radius of the rounding where half-spaces meet.
        margin_mm: Distance by which the hull is wider than its supports.
        ops: Operations on numbers.
    """
    return softness_mm * ops.log_sum_exp([x / softness_mm for x in v]) - margin_mm


def half_spaces(
    d: Triple[N],
    directions: Iterable[tuple[N, N] | tuple[float, float]],
    supports: Iterable[N],
    first_mm: float,
    last_mm: float,
) -> list[N]:
    """Return how far outside each half-space of a slice hull d [mm] lies [mm].

    Args:
        d: Jaw parameters.
        directions: Unit normals in (d2, d3).
        supports: The supports h_k at d1 [mm], one for each direction.
        first_mm: Smallest captured opening.
        last_mm: Largest captured opening.
    """
    d1, d2, d3 = d
    sides = [d2 * n[0] + d3 * n[1] - h for n, h in zip(directions, supports)]
    return [*sides, first_mm - d1, d1 - last_mm]
