"""The jaw model's formulas, written once for every number type.

Each function takes numbers with ``+ - * /`` and, where a formula needs more, an `Operations` object for that number
type; `jawusd.evaluator.kinds` combines them into models. Only `jawusd.evaluator.gauge` has the gauge a second time,
with derivatives. This file imports only the standard library and modules that do the same: all of them are copied into
the single-file reader, which runs in Python 3.9.

The gauge maps the parameters d = (d1 opening, d2 laterotrusion, d3 protrusion) [mm] to the displacement u [mm] of the
lower incisal point, anatomical frame (x left, y up, z anterior):

    x = gx(d1) + d2
    y = -(d1 + drop(d2, d3) fade(d1))
    z = gz(d1) + rho(d2, d1) + d3

gx, gz: the habitual opening path; rho: the gothic arch of a lateral excursion; drop: how far the jaw must open to slide
with the teeth together, fading out with opening. If it was measured on scans, a table ``sum_r a_r(d2) b_r(d3)`` is
added to drop.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, cast

from jawusd.evaluator.operations import FloatOperations, Operations, Rows, Table, polynomial, rows, triple
from jawusd.geometry.rodrigues import N, Triple, apply_series, dot, turning

# Tolerance [mm] of the inside test: parameters on the bound may round to either side of it.
ON_BOUND_MM = 1e-6
FADE_SOFTNESS_MM = 1.0  # rounding of the kink at d1 = 0 in the fading of the glide surface
LIMIT_SOFTNESS_MM = 4.0  # rounding of the kinks at both path limits
# Length scale of the quadratic terms of rho, d2^2 / 10 mm; gives all coefficients a similar magnitude.
ARCH_BOW_MM = 10.0
DROP_BEND = 0.15  # second-order coefficient of the bent drop terms [1/mm]
DROP_SATURATION_MM2 = 16.0  # squared distance, (4 mm)^2, beyond which the drop terms become linear
_CURVE_TABLES = ("start", "power0", "power1", "power2", "power3")
_VANISHING = 1e-12  # sums below this fraction of the sum of all weights count as zero

Arrays = Mapping[str, Sequence[float]]  # the named arrays of a rig, flattened row by row
Numbers = tuple[object, ...]  # nested tuples of floats, or of their counterparts of another number type


class GaugeNumbers(NamedTuple):
    """The scalars of a gauge."""

    path_x: Sequence[float]  # coefficients of gx: ``sum_k c_k (d1 / path_scale_mm)^k, k = 1..5`` [mm]
    path_z: Sequence[float]  # coefficients of gz, likewise
    path_scale_mm: float  # length that scales the argument of the polynomials to order one
    low_mm: float  # smallest d1 of the polynomials, which continue as straight lines outside their limits
    high_mm: float  # largest d1 of the polynomials
    arch: Sequence[float]  # the 7 coefficients of rho
    drop: Sequence[float]  # the 4 coefficients of drop
    softness_mm: float  # radius of the softened absolute value and ramp
    fade_mm: float  # opening over which the glide surface fades out
    glide: object = None  # table of the glide surface, as `gauge.Elementary.glide` expects it; None without one

    @classmethod
    def of(cls, arrays: Arrays, glide: object = None) -> GaugeNumbers:
        """Return the scalars in the named arrays of a rig, with a table of the glide surface."""
        path_x, path_z = (tuple(each) for each in rows(arrays["path_coefficients"], 5))
        (scale_mm,), (low_mm, high_mm) = arrays["path_scale_mm"], arrays["path_limits"]
        terms = (tuple(arrays["glide_arch"]), tuple(arrays["glide_drop"]))
        (softness_mm,), (fade_mm,) = arrays["glide_softness_mm"], arrays["glide_fade_mm"]
        return cls(path_x, path_z, scale_mm, low_mm, high_mm, *terms, softness_mm, fade_mm, glide)


def long_angle_series() -> list[list[float]]:
    """Return a, b and c of `jawusd.geometry.rodrigues` as series of the squared angle [rad^2], to 1e-8 up to 2 rad."""
    return [[(-1.0) ** k / math.factorial(2 * k + start) for k in range(8)] for start in (1, 2, 3)]


def soft_absolute(x: N, softness_mm: float, ops: Operations[N, Table]) -> N:
    """Return |x| with the kink rounded, zero at zero: ``sqrt(x^2 + e^2) - e``."""
    return ops.sqrt(x * x + softness_mm * softness_mm) - softness_mm


def soft_ramp(x: N, softness_mm: float, ops: Operations[N, Table]) -> N:
    """Return max(x, 0) with the kink rounded, zero at zero: ``(x + sqrt(x^2 + e^2) - e) / 2``."""
    return 0.5 * (x + soft_absolute(x, softness_mm, ops))


def bent(x: N, ops: Operations[N, Table]) -> N:
    """Return ``0.15 x^2 / sqrt(1 + x^2 / 16)`` [mm]: a drop that is quadratic near 0 and linear far from it."""
    square = x * x
    return DROP_BEND * square / ops.sqrt(1.0 + square / DROP_SATURATION_MM2)


def path(gauge: GaugeNumbers, d1: N, ops: Operations[N, Table]) -> tuple[N, N]:
    """Return gx and gz [mm] at opening d1 [mm]."""
    inside = ops.clip(d1, gauge.low_mm, gauge.high_mm)
    s, beyond = inside / gauge.path_scale_mm, d1 - inside
    both = (gauge.path_x, gauge.path_z)
    slopes = [[k * x / gauge.path_scale_mm for k, x in enumerate(c, start=1)] for c in both]
    x, z, slope_x, slope_z = ops.polynomials([*both, *slopes], s)
    return x * s + slope_x * beyond, z * s + slope_z * beyond


def arch(gauge: GaugeNumbers, d1: N, d2: N, ops: Operations[N, Table]) -> N:
    """Return rho [mm]: how far forward a lateral excursion d2 [mm] moves the incisal point at opening d1 [mm]."""
    rise = soft_ramp(d1 - gauge.low_mm, LIMIT_SOFTNESS_MM, ops)
    stop = soft_ramp(d1 - gauge.high_mm, LIMIT_SOFTNESS_MM, ops)
    t = (rise - stop + gauge.low_mm) / gauge.path_scale_mm
    c = gauge.arch
    side = soft_absolute(d2, gauge.softness_mm, ops)
    bow = polynomial([c[5] / ARCH_BOW_MM, c[6] / ARCH_BOW_MM], t)
    return side * polynomial(c[:3], t) + d2 * (polynomial(c[3:5], t) + d2 * bow)


def drop(gauge: GaugeNumbers, d2: N, d3: N, ops: Operations[N, Table]) -> N:
    """Return how far the tooth-glide surface pushes the jaw down at d2, d3 [mm]."""
    side = soft_absolute(d2, gauge.softness_mm, ops)
    front = soft_ramp(d3, gauge.softness_mm, ops)
    c = gauge.drop
    return side * c[0] + front * c[1] + bent(side, ops) * c[2] + bent(front, ops) * c[3]


def fade(gauge: GaugeNumbers, d1: N, ops: Operations[N, Table]) -> N:
    """Return the weight of the glide surface at opening d1 [mm]."""
    x = soft_ramp(d1, FADE_SOFTNESS_MM, ops) / gauge.fade_mm
    return ops.exp(-(x * x))


def glide(width: int, d2: N, d3: N, tables: Mapping[str, Table], ops: Operations[N, Table]) -> N:
    """Return the value [mm] of the glide table at d2, d3 [mm]: the sum of products of ``width`` pairs of curves."""
    side, front = (ops.split(curve(name, x, tables, ops), width) for name, x in (("glide2", d2), ("glide3", d3)))
    total = side[0] * front[0]
    for a, b in zip(side[1:], front[1:]):
        total = total + a * b
    return total


def displacement(gauge: GaugeNumbers, d: Triple[N], ops: Operations[N, Table], table: N | None = None) -> Triple[N]:
    """Return the displacement u [mm] of the incisal point at jaw parameters d [mm]; `glide` returns ``table``."""
    d1, d2, d3 = d
    gx, gz = path(gauge, d1, ops)
    surface = drop(gauge, d2, d3, ops)
    down = d1 + (surface if table is None else surface + table) * fade(gauge, d1, ops)
    return gx + d2, -down, gz + arch(gauge, d1, d2, ops) + d3


def spline_input(gauge: GaugeNumbers, scales: Sequence[float], u: Triple[N], ops: Operations[N, Table]) -> Triple[N]:
    """Return the argument of the spline: u [mm] sheared by the habitual path, divided by the scales [mm]."""
    opening = -u[1]
    gx, gz = path(gauge, opening, ops)
    return opening / scales[0], (u[0] - gx) / scales[1], (u[2] - gz) / scales[2]


def cubic(h: N, y0: N, y1: N, m0: N, m1: N) -> tuple[N, N, N, N]:
    """Return the coefficients, powers 0 to 3, of the cubic over a length h with values y0, y1 and slopes m0, m1."""
    rise = (y1 - y0) / h
    return y0, m0, (3.0 * rise - 2.0 * m0 - m1) / h, (m0 + m1 - 2.0 * rise) / (h * h)


def catmull_rom(before: N, after: N, span: N) -> N:
    """Return the slope at a knot from the values at its two neighbours, which are ``span`` apart."""
    return (after - before) / span


def flat_ended_slopes(knots: Sequence[float], values: Rows) -> Rows:
    """Return the Catmull-Rom slopes of n rows of values at n knots, zero at both ends."""
    slopes = [[0.0] * len(values[0]) for _ in knots]
    for i in range(1, len(knots) - 1):
        span = knots[i + 1] - knots[i - 1]
        slopes[i] = [catmull_rom(x, y, span) for x, y in zip(values[i - 1], values[i + 1])]
    return slopes


def curve_tables(name: str, knots: Sequence[float], values: Rows, slopes: Rows) -> dict[str, Rows]:
    """Return the tables of a C1 cubic Hermite curve, continued straight outside its knots; see `curve`.

    They hold the n knots and, for each of the n + 1 intervals with the straight ends, its start and coefficients,
    powers 0 to 3. `values` and `slopes` are n rows of points and derivatives at the knots; `name` begins the tables'
    names.
    """
    still = [0.0] * len(values[0])
    pieces = [[[knots[0]], values[0], slopes[0], still, still]]
    for i in range(len(knots) - 1):
        ends = zip(values[i], values[i + 1], slopes[i], slopes[i + 1])
        powers = zip(*(cubic(knots[i + 1] - knots[i], *end) for end in ends))
        pieces.append([[knots[i]], *map(list, powers)])
    pieces.append([[knots[-1]], values[-1], slopes[-1], still, still])
    tables = {f"{name}_{part}": list(table) for part, table in zip(_CURVE_TABLES, zip(*pieces))}
    return {f"{name}_knot": [[knot] for knot in knots], **tables}


def curve(name: str, x: N, tables: Mapping[str, Table], ops: Operations[N, Table]) -> list[N]:
    """Return the point at x, as a row, of a curve given by the tables of `curve_tables`."""
    s, powers = _interval(name, x, tables, ops)
    return [((c3 * s + c2) * s + c1) * s + c0 for c0, c1, c2, c3 in zip(*powers)]


def curve_derivatives(
    name: str, x: N, tables: Mapping[str, Table], ops: Operations[N, Table]
) -> tuple[list[N], list[N], list[N]]:
    """Return the point of `curve` at x, its derivative and its second derivative, each as a row."""
    s, (c0, c1, c2, c3) = _interval(name, x, tables, ops)
    return (
        [((d * s + c) * s + b) * s + a for a, b, c, d in zip(c0, c1, c2, c3)],
        [(3.0 * d * s + 2.0 * c) * s + b for b, c, d in zip(c1, c2, c3)],
        [6.0 * d * s + 2.0 * c for c, d in zip(c2, c3)],
    )


def _interval(
    name: str, x: N, tables: Mapping[str, Table], ops: Operations[N, Table]
) -> tuple[N, Sequence[Sequence[N]]]:
    """Return the offset of x from the start of its interval, and the polynomial coefficients of that interval."""
    found = ops.lookup(x, tables[f"{name}_knot"], [tables[f"{name}_{part}"] for part in _CURVE_TABLES])
    return x - found[0][0], found[1:]


def spline(
    q: Triple[N],
    centres: Table,
    weights: Table,
    linear: Sequence[Sequence[float]],
    spread: Sequence[float] | None,
    ops: Operations[N, Table],
) -> Triple[N]:
    """Return ``sum_i W_i |q - c_i|^3 + q L``: a polyharmonic spline with a linear tail (Duchon 1977).

    Far from the centres the cubes of distances nearly cancel. If ``sum_i W_i = 0`` and ``sum_i W_i c_i = 0``, the cubes
    are replaced by what remains after cancellation, so that single precision suffices. With ``r = |q - c|``, ``p^2 =
    |q|^2 + 1`` and ``e = c (2 q - c) + 1 = p^2 - r^2``, this is ``r^3 = p^3 - 3/2 p e + (e / (r + p))^2 (r + p / 2)``,
    in which the sums of ``p^3 W_i`` and of ``p q c_i W_i`` vanish. `spline_input` gives q, `spread_of` the spread; c_i,
    W_i and L are given by rows.
    """
    kernels = []
    reference = None if spread is None else ops.sqrt(dot(q, q) + 1.0)
    for x, y, z in zip(*ops.columns(centres)):
        away = (q[0] - x, q[1] - y, q[2] - z)
        squared = dot(away, away)
        r = ops.sqrt(squared)
        if reference is None:
            kernels.append(squared * r)
        else:
            e = x * (q[0] + away[0]) + y * (q[1] + away[1]) + z * (q[2] + away[2]) + 1.0
            share = e / (r + reference)
            kernels.append(share * share * (r + 0.5 * reference))
    total = ops.weighted_sum(kernels, weights)
    if spread is not None and reference is not None:
        total = triple([x + reference * (1.5 * y) for x, y in zip(total, spread)])
    return triple([total[k] + q[0] * linear[0][k] + q[1] * linear[1][k] + q[2] * linear[2][k] for k in range(3)])


def spread_of(centres: Rows, weights: Rows) -> Triple[float] | None:
    """Return ``sum_i W_i |c_i|^2`` of a spline whose sums of ``W_i`` and ``W_i c_i`` vanish; None for any other."""
    size = sum(abs(w) for row in weights for w in row)
    moments = [sum(w[k] * x for x, w in zip(column, weights)) for column in zip(*centres) for k in range(3)]
    moments += [sum(column) for column in zip(*weights)]
    if max(map(abs, moments)) > _VANISHING * size:
        return None
    squares = [x * x + y * y + z * z for x, y, z in centres]
    return triple([sum(w[k] * square for square, w in zip(squares, weights)) for k in range(3)])


@dataclass(frozen=True)
class RigidMotion(Generic[N]):
    """A rigid motion."""

    omega: Triple[N]  # rotation vector [rad]
    turn: tuple[Triple[N], Triple[N], Triple[N]]  # rows of the rotation matrix minus the identity
    t: Triple[N]  # translation [mm]


def anchored_motion(
    omega: Triple[N], u: Triple[N], anchor: Triple[N] | Triple[float], ops: Operations[N, Table]
) -> RigidMotion[N]:
    """Return the motion that rotates by omega [rad] and displaces the anchor [mm] by u [mm]: ``t = u + p - R p``."""
    a, b, _ = ops.angle_coefficients(dot(omega, omega))
    turn = turning(omega, a, b)
    shifts = [u[i] - (row[0] * anchor[0] + row[1] * anchor[1] + row[2] * anchor[2]) for i, row in enumerate(turn)]
    return RigidMotion(omega, turn, triple(shifts))


def twist_motion(omega: Triple[N], v: Triple[N], ops: Operations[N, Table]) -> RigidMotion[N]:
    """Return the motion exp(omega, v) of a twist (omega [rad], v [mm])."""
    a, b, c = ops.angle_coefficients(dot(omega, omega))
    return RigidMotion(omega, turning(omega, a, b), apply_series(omega, v, b, c))


class BoundNumbers(NamedTuple):
    """The scalars of a bound: ends of the captured openings, rounding and offset, all in mm."""

    first_mm: float
    last_mm: float
    softness_mm: float
    offset_mm: float


class BoundFormula:
    """The slice hull: which jaw parameters are anatomically possible; tables, numbers as in `AnchoredFormula`."""

    def __init__(self, arrays: Arrays) -> None:
        knots, directions = arrays["slice_d1"], rows(arrays["slice_directions"], 2)
        supports = rows(arrays["slice_support"], len(directions))
        slopes = flat_ended_slopes(knots, supports)  # the supports are constant beyond the ends
        self.tables = {"directions": directions, **curve_tables("support", knots, supports, slopes)}
        softness_mm, offset_mm = arrays["slice_softness_mm"][0], arrays["slice_margin_mm"][0]
        self.numbers = BoundNumbers(knots[0], knots[-1], softness_mm, offset_mm)

    def margin(
        self,
        d: Triple[N],
        tables: Mapping[str, Table],
        ops: Operations[N, Table],
        numbers: Numbers | None = None,
    ) -> N:
        """Return the signed distance of d [mm] to the bound [mm], positive inside.

        A soft maximum combines the half-planes ``n_k . (d2, d3) <= h_k(d1)`` and the ends of the captured openings.
        """
        first_mm, last_mm, softness_mm, offset_mm = cast("BoundNumbers", numbers or self.numbers)
        d1, d2, d3 = d
        supports = curve("support", d1, tables, ops)
        sides = [d2 * x + d3 * y - h for x, y, h in zip(*ops.columns(tables["directions"]), supports)]
        terms = [x / softness_mm for x in (*sides, first_mm - d1, d1 - last_mm)]
        return offset_mm - softness_mm * ops.log_sum_exp(terms)

    def middle(self, d1: float) -> tuple[float, float]:
        """Return d2, d3 [mm] in the middle of the section at d1 [mm]: the Steiner point of evenly spaced directions."""
        reach = curve("support", d1, self.tables, FloatOperations())
        xx = xy = yy = hx = hy = 0.0
        for (x, y), h in zip(self.tables["directions"], reach):
            xx, xy, yy, hx, hy = xx + x * x, xy + x * y, yy + y * y, hx + h * x, hy + h * y
        scale = 1.0 / (xx * yy - xy * xy)
        return scale * (yy * hx - xy * hy), scale * (xx * hy - xy * hx)
