"""Cubic Hermite curves, written once for every number type; see `jawusd.evaluator.formula`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from jawusd.evaluator.operations import Operations, Rows, Table
from jawusd.geometry.rodrigues import N


def cubic(h: N, y0: N, y1: N, m0: N, m1: N) -> tuple[N, N, N, N]:
    """Return the coefficients, powers 0 to 3, of the cubic Hermite polynomial over an interval of length h.

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

    Args:
        name: Prefix of the names of the tables.
        knots: n increasing parameter values.
        values: Points of the curve at the knots, n rows.
        slopes: Derivatives at the knots, n rows.

    Returns:
        The knots; and for each of the n + 1 intervals, including the two straight ends, its start and its polynomial
        coefficients, powers 0 to 3.
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
