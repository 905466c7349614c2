"""Cubic Hermite curves and polyharmonic splines, written once for every number type; see `jawusd.evaluator.formula`.

This file imports only the standard library and modules that do the same: it is copied into the single-file reader.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from jawusd.evaluator.operations import Operations, Rows, Table, triple
from jawusd.geometry.rodrigues import N, Triple, dot


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


_CURVE_TABLES = ("start", "power0", "power1", "power2", "power3")


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


_VANISHING = 1e-12  # sums below this fraction of the sum of all weights count as zero


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
    in which the sums of ``p^3 W_i`` and of ``p q c_i W_i`` vanish.

    Args:
        q: The argument; see `spline_input`.
        centres, weights: c_i and W_i, one per row.
        linear: L, 3 inputs times 3 outputs.
        spread: See `spread_of`.
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
