"""The gauge: jaw parameters to the displacement of the incisal point and back, with derivatives.

The formulas are those of `jawusd.evaluator.formula`, differentiated by hand. The functions use only ``+ - * /`` and the
functions of an `Elementary`, so that they run on floats, arrays and tensors. `jawusd.fast` compiles them unchanged,
which is why they use tuples instead of lists. A suffix names the variable of a derivative: ``rho_2`` is the derivative
of rho with respect to d2. `Gauge` applies them to batches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.curves import GlideTable
from jawusd.evaluator.formula import (
    ARCH_BOW_MM,
    DROP_BEND,
    DROP_SATURATION_MM2,
    FADE_SOFTNESS_MM,
    LIMIT_SOFTNESS_MM,
    GaugeNumbers,
)
from jawusd.evaluator.operations import FloatOperations
from jawusd.geometry.rodrigues import N, Triple

INVERSE_TOLERANCE_MM = 1e-13
INVERSE_ITERATIONS = 120
PATIENCE = 8  # iterations after which Newton counts as stalled; then steps are doubled or the bracket is halved
INVERSE_STEP_MM = 20.0
MIN_INVERSE_SLOPE = 0.2  # lower limit of the derivative; smaller values would let Newton steps diverge from the root
MAX_DOUBLINGS = 64


class Elementary(NamedTuple, Generic[N]):
    """Elementary functions of a number type."""

    sqrt: Callable[[N], N]
    exp: Callable[[N], N]
    clip: Callable[[N, float, float], N]
    glide: Callable[[object, N, N], Triple[N]]  # (glide table, d2, d3) -> drop [mm], drop_2, drop_3


def _glide_floats(table: object, d2: float, d3: float) -> Triple[float]:
    return table.at_floats(d2, d3) if isinstance(table, GlideTable) else (0.0, 0.0, 0.0)


def _glide_arrays(table: object, d2: Array, d3: Array) -> Triple[Array]:
    return table.at_arrays(d2, d3) if isinstance(table, GlideTable) else (np.zeros(1), np.zeros(1), np.zeros(1))


FLOATS: Elementary[float] = Elementary(math.sqrt, math.exp, FloatOperations.clip, _glide_floats)
ARRAYS: Elementary[Array] = Elementary(np.sqrt, np.exp, np.clip, _glide_arrays)


def path(gauge: GaugeNumbers, d1: N, f: Elementary[N]) -> tuple[N, N, N, N]:
    """Return gx, gz [mm] and their derivatives gx_1, gz_1 at opening d1 [mm]."""
    scale = gauge.path_scale_mm
    inside = f.clip(d1, gauge.low_mm, gauge.high_mm)
    s, beyond = inside / scale, d1 - inside
    x, x_s = path_polynomial(gauge.path_x, s)
    gx_1 = x_s / scale
    z, z_s = path_polynomial(gauge.path_z, s)
    gz_1 = z_s / scale
    return x * s + gx_1 * beyond, z * s + gz_1 * beyond, gx_1, gz_1


def path_polynomial(coefficients: Sequence[float], s: N) -> tuple[N, N]:
    """Return ``sum_k c_k s^k, k = 1..5`` divided by s, and its derivative, undivided (Horner's scheme)."""
    c1, c2, c3, c4, c5 = coefficients
    b4 = c5 * s + c4
    b3 = b4 * s + c3
    b2 = b3 * s + c2
    b1 = b2 * s + c1
    return b1, (((c5 * s + b4) * s + b3) * s + b2) * s + b1


def arch(gauge: GaugeNumbers, d1: N, d2: N, f: Elementary[N]) -> tuple[N, N, N]:
    """Return rho [mm], rho_1 and rho_2 of a lateral excursion d2 [mm] at opening d1 [mm]."""
    sqrt = f.sqrt
    scale, e, square = gauge.path_scale_mm, gauge.softness_mm, LIMIT_SOFTNESS_MM * LIMIT_SOFTNESS_MM
    rise, stop = d1 - gauge.low_mm, d1 - gauge.high_mm
    rise_root, stop_root = sqrt(rise * rise + square), sqrt(stop * stop + square)
    t = (gauge.low_mm + 0.5 * (rise + rise_root - stop - stop_root)) / scale
    t_1 = 0.5 * (rise / rise_root - stop / stop_root) / scale
    side_root = sqrt(d2 * d2 + e * e)
    side, side_2 = side_root - e, d2 / side_root
    c0, c1, c2, c3, c4, c5, c6 = gauge.arch
    by_side, by_d2, bow = (c2 * t + c1) * t + c0, c4 * t + c3, (c6 * t + c5) / ARCH_BOW_MM
    rho = side * by_side + d2 * (by_d2 + d2 * bow)
    rho_1 = (side * (2.0 * c2 * t + c1) + d2 * (c4 + d2 * (c6 / ARCH_BOW_MM))) * t_1
    return rho, rho_1, side_2 * by_side + by_d2 + 2.0 * d2 * bow


def drop(gauge: GaugeNumbers, d2: N, d3: N, f: Elementary[N]) -> tuple[N, N, N]:
    """Return drop [mm], drop_2 and drop_3 at d2, d3 [mm]."""
    sqrt = f.sqrt
    e = gauge.softness_mm
    side_root, front_root = sqrt(d2 * d2 + e * e), sqrt(d3 * d3 + e * e)
    side, front = side_root - e, 0.5 * (d3 + front_root - e)
    v, w = 1.0 + side * side / DROP_SATURATION_MM2, 1.0 + front * front / DROP_SATURATION_MM2
    side_bend, front_bend = DROP_BEND * side / sqrt(v), DROP_BEND * front / sqrt(w)
    c0, c1, c2, c3 = gauge.drop
    down = (c0 + c2 * side_bend) * side + (c1 + c3 * front_bend) * front
    down_2 = (c0 + c2 * side_bend * (1.0 + v) / v) * (d2 / side_root)
    down_3 = (c1 + c3 * front_bend * (1.0 + w) / w) * 0.5 * (1.0 + d3 / front_root)
    table, table_2, table_3 = f.glide(gauge.glide, d2, d3)
    return down + table, down_2 + table_2, down_3 + table_3


def fade(gauge: GaugeNumbers, d1: N, f: Elementary[N]) -> tuple[N, N]:
    """Return the weight of the glide surface at opening d1 [mm], and its derivative."""
    root = f.sqrt(d1 * d1 + FADE_SOFTNESS_MM * FADE_SOFTNESS_MM)
    x = 0.5 * (d1 + root - FADE_SOFTNESS_MM) / gauge.fade_mm
    share = f.exp(-x * x)
    return share, share * x * (1.0 + d1 / root) / -gauge.fade_mm


def displacement(
    gauge: GaugeNumbers, d1: N, d2: N, d3: N, f: Elementary[N]
) -> tuple[Triple[N], tuple[N, N, N, N, N, N]]:
    """Return u [mm] of d [mm], and its derivatives x_1; y_1, y_2, y_3; z_1, z_2.

    The other derivatives are constant: ``x_2 = z_3 = 1`` and ``x_3 = 0``.
    """
    gx, gz, gx_1, gz_1 = path(gauge, d1, f)
    rho, rho_1, rho_2 = arch(gauge, d1, d2, f)
    down, down_2, down_3 = drop(gauge, d2, d3, f)
    share, share_1 = fade(gauge, d1, f)
    u = gx + d2, -(d1 + down * share), gz + rho + d3
    return u, (gx_1, -(1.0 + down * share_1), -down_2 * share, -down_3 * share, gz_1 + rho_1, rho_2)


def opening_equation(gauge: GaugeNumbers, u: Triple[N], d1: N, f: Elementary[N]) -> tuple[N, N, N, N]:
    """Return the inverse gauge reduced to one equation in d1 [mm].

    Returns d2, d3 [mm] that match the x and z of u at d1, the residual ``d1 + drop fade + y`` [mm], zero at the
    solution, and its derivative by d1.
    """
    gx, gz, gx_1, gz_1 = path(gauge, d1, f)
    d2 = u[0] - gx
    rho, rho_1, rho_2 = arch(gauge, d1, d2, f)
    d3 = u[2] - gz - rho
    down, down_2, down_3 = drop(gauge, d2, d3, f)
    share, share_1 = fade(gauge, d1, f)
    d3_1 = -gz_1 - rho_1 + rho_2 * gx_1
    return d2, d3, d1 + down * share + u[1], 1.0 + down * share_1 + (down_3 * d3_1 - down_2 * gx_1) * share


def inverse(gauge: GaugeNumbers, u: Triple[float], f: Elementary[float]) -> Triple[float]:
    """Return the d [mm] of one u [mm]: Newton on `opening_equation` within a bracket; NaN if it does not converge."""
    low, high, d1 = -math.inf, math.inf, -u[1]
    for iteration in range(INVERSE_ITERATIONS):
        d2, d3, remainder, slope = opening_equation(gauge, u, d1, f)
        step = -remainder / (slope if slope > MIN_INVERSE_SLOPE else 1.0)
        step = min(max(step, -INVERSE_STEP_MM), INVERSE_STEP_MM)
        if abs(step) <= INVERSE_TOLERANCE_MM * (1.0 + abs(d1)):
            return d1, d2, d3
        if remainder < 0.0:
            low = d1
        elif remainder > 0.0:
            high = d1
        late = max(iteration - PATIENCE, 0)
        if low == -math.inf or high == math.inf:
            d1 += min(max(step * 2.0 ** min(late, MAX_DOUBLINGS), -INVERSE_STEP_MM), INVERSE_STEP_MM)
        elif d1 + step <= low or d1 + step >= high or late % 2 == 1:
            d1 = 0.5 * (low + high)
        else:
            d1 += step
    return math.nan, math.nan, math.nan


def spline_input(
    gauge: GaugeNumbers, scales: Sequence[float], u: Triple[N], f: Elementary[N]
) -> tuple[Triple[N], tuple[N, N]]:
    """Return the spline's argument q at u [mm], and the derivatives of the habitual path for `gradient_by_u`."""
    opening = -u[1]
    gx, gz, gx_1, gz_1 = path(gauge, opening, f)
    return (opening / scales[0], (u[0] - gx) / scales[1], (u[2] - gz) / scales[2]), (gx_1, gz_1)


def gradient_by_u(by_q: Triple[N], scales: Sequence[float], slopes: tuple[N, N]) -> Triple[N]:
    """Return the gradient with respect to u of a function whose gradient with respect to q is ``by_q``."""
    opening, side, front = by_q[0] / scales[0], by_q[1] / scales[1], by_q[2] / scales[2]
    return side, side * slopes[0] + front * slopes[1] - opening, front


@dataclass(frozen=True)
class Gauge:
    """The map between d and the incisal displacement u; ``u(0) = 0``."""

    #: coefficients of gx and gz: ``sum_k c_k (d1 / path_scale_mm)^k, k = 1..5`` [mm], shape (2, 5)
    path_coefficients: Array
    path_scale_mm: float  # length that scales the argument of the polynomials to order one
    #: d1 interval [mm] of the polynomials, which continue as straight lines; ``rho`` uses d1 softly clamped to it
    path_limits: tuple[float, float]
    glide_arch: Array  # coefficients of rho, shape (7,)
    glide_drop: Array  # coefficients of drop, shape (4,)
    glide_softness_mm: float  # radius ``e`` of the softened absolute value and ramp
    glide_fade_mm: float  # opening over which the glide surface fades out
    glide: GlideTable | None = None  # table added to drop; None without one
    numbers: GaugeNumbers = field(init=False, repr=False)  # all of the above as floats

    def __post_init__(self) -> None:
        flat = {name: value.ravel().tolist() for name, value in self.arrays().items()}
        object.__setattr__(self, "numbers", GaugeNumbers.of(flat, self.glide))

    def arrays(self) -> dict[str, Array]:
        """Return the gauge's arrays by their names in a rig."""
        names = ("path_coefficients", "path_scale_mm", "path_limits", "glide_arch", "glide_drop")
        own = {name: np.array(getattr(self, name)) for name in (*names, "glide_softness_mm", "glide_fade_mm")}
        return own if self.glide is None else {**own, **self.glide.arrays()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> Gauge:
        """Build the gauge from the named arrays of a rig."""
        low, high = np.asarray(arrays["path_limits"], dtype=float)
        return cls(
            path_coefficients=np.asarray(arrays["path_coefficients"], dtype=float),
            path_scale_mm=float(arrays["path_scale_mm"]),
            path_limits=(float(low), float(high)),
            glide_arch=np.asarray(arrays["glide_arch"], dtype=float),
            glide_drop=np.asarray(arrays["glide_drop"], dtype=float),
            glide_softness_mm=float(arrays["glide_softness_mm"]),
            glide_fade_mm=float(arrays["glide_fade_mm"]),
            glide=GlideTable.from_arrays(arrays),
        )

    def path(self, d1: Array) -> tuple[Array, Array, Array, Array]:
        """Return gx, gz [mm] and their derivatives at the openings d1 [mm], each of the shape of d1."""
        return path(self.numbers, d1, ARRAYS)

    def arch(self, d1: Array, d2: Array) -> tuple[Array, Array, Array]:
        """Return rho(d2, d1) [mm] and its derivatives with respect to d1 and d2."""
        return arch(self.numbers, d1, d2, ARRAYS)

    def drop(self, d2: Array, d3: Array) -> tuple[Array, Array, Array]:
        """Return drop(d2, d3) [mm] and its derivatives with respect to d2 and d3."""
        return drop(self.numbers, d2, d3, ARRAYS)

    def displacement(self, d: Array) -> Array:
        """Return the displacement u [mm] of the incisal point, anatomical frame, shape (n, 3), for d (n, 3)."""
        d1, d2, d3 = d.T
        return np.stack(displacement(self.numbers, d1, d2, d3, ARRAYS)[0], axis=-1)

    def displacement_jacobian(self, d: Array) -> tuple[Array, Array]:
        """Return u (n, 3) [mm] and du/dd, shape (n, 3, 3), for d (n, 3) [mm]."""
        d1, d2, d3 = d.T
        u, (x_1, y_1, y_2, y_3, z_1, z_2) = displacement(self.numbers, d1, d2, d3, ARRAYS)
        jacobian = np.zeros((len(d), 3, 3))
        jacobian[:, 0, 0], jacobian[:, 0, 1] = x_1, 1.0
        jacobian[:, 1, 0], jacobian[:, 1, 1], jacobian[:, 1, 2] = y_1, y_2, y_3
        jacobian[:, 2, 0], jacobian[:, 2, 1], jacobian[:, 2, 2] = z_1, z_2, 1.0
        return np.stack(u, axis=-1), jacobian

    def inverse(self, u: Array) -> Array:
        """Return the d (n, 3) [mm] whose incisal displacement is u (n, 3) [mm]; NaN for rows that do not converge.

        For a given d1 the other two follow in closed form: Newton in d1 inside the tightest bracket so far. A single
        row is solved in floats, by the function `inverse`.
        """
        finite = np.isfinite(u).all(axis=1)
        if len(u) == 1 and finite.all():
            x, y, z = u[0].tolist()
            return np.array([inverse(self.numbers, (x, y, z), FLOATS)])
        d1 = -u[:, 1]
        low, high = np.full(len(u), -np.inf), np.full(len(u), np.inf)
        d = np.full(u.shape, np.nan)
        active = np.flatnonzero(finite)
        for iteration in range(INVERSE_ITERATIONS):
            x = d1[active]
            d2, d3, remainder, slope = opening_equation(self.numbers, tuple(u[active].T), x, ARRAYS)
            step = -remainder / np.where(slope > MIN_INVERSE_SLOPE, slope, 1.0)
            step = np.clip(step, -INVERSE_STEP_MM, INVERSE_STEP_MM)
            done = np.abs(step) <= INVERSE_TOLERANCE_MM * (1.0 + np.abs(x))
            d[active[done]] = np.stack([x, d2, d3], axis=-1)[done]
            low[active] = np.where(remainder < 0, x, low[active])
            high[active] = np.where(remainder > 0, x, high[active])
            d1[active] = _next_opening(x, step, low[active], high[active], iteration)
            active = active[~done]
            if not active.size:
                break
        return d


def _next_opening(x: Array, step: Array, low: Array, high: Array, iteration: int) -> Array:
    """Return the next d1: a Newton step, or bisection if the step leaves the bracket or Newton has stalled."""
    bounded = np.isfinite(low) & np.isfinite(high)
    late = max(iteration - PATIENCE, 0)
    stride = np.clip(step * 2.0 ** min(late, MAX_DOUBLINGS), -INVERSE_STEP_MM, INVERSE_STEP_MM)
    newton = x + np.where(bounded, step, stride)
    halve = bounded & ((newton <= low) | (newton >= high) | (late % 2 == 1))
    middle = 0.5 * (np.where(bounded, low, 0.0) + np.where(bounded, high, 0.0))
    return np.where(halve, middle, newton)
