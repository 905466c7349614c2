"""The operations that formulas need beyond arithmetic, and their implementation for Python floats.

A table consists of rows of floats, stored in a form that depends on the number type; a column is a sequence of numbers,
or of one array of them, such as a tensor. This file imports only the standard library and `jawusd.geometry.rodrigues`:
it is copied into the single-file reader.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import Protocol, TypeVar

from jawusd.geometry.rodrigues import N, Triple, angle_coefficients

Rows = list[list[float]]
Table = TypeVar("Table", contravariant=True)  # type in which a number type stores rows of floats


def polynomial(coefficients: Sequence[N | float], x: N) -> N:
    """Return ``sum_k coefficients[k] x^k`` for two or more coefficients (Horner's scheme)."""
    value = x * coefficients[-1] + coefficients[-2]
    for coefficient in reversed(coefficients[:-2]):
        value = value * x + coefficient
    return value


def polynomials(coefficients: Sequence[Sequence[N | float]], x: N) -> list[N]:
    """Return several polynomials of x."""
    return [polynomial(each, x) for each in coefficients]


class Operations(Protocol[N, Table]):
    """Operations of a number type beyond arithmetic."""

    def sqrt(self, x: N) -> N:
        """Return the square root."""

    def exp(self, x: N) -> N:
        """Return the exponential."""

    def clip(self, x: N, low: float, high: float) -> N:
        """Return x limited to [low, high]."""

    def angle_coefficients(self, squared: N) -> Triple[N]:
        """Return the coefficients a, b and c of `jawusd.geometry.rodrigues` at a squared angle [rad^2]."""

    def polynomials(self, coefficients: Sequence[Sequence[float]], x: N) -> Sequence[N]:
        """Return several polynomials of x; see `polynomial`."""

    def log_sum_exp(self, terms: Sequence[N]) -> N:
        """Return the logarithm of the sum of the exponentials of all terms."""

    def columns(self, table: Table) -> Sequence[Sequence[N]]:
        """Return the columns of a table."""

    def weighted_sum(self, factors: Sequence[N], weights: Table) -> Triple[N]:
        """Return the sum of the rows of a table with three columns, each multiplied by its factor."""

    def lookup(self, x: N, knots: Table, tables: Sequence[Table]) -> Sequence[Sequence[N]]:
        """Return row i of each table, where i is the number of knots (a table with one column) at or below x."""

    def split(self, row: Sequence[N], width: int) -> Sequence[N]:
        """Return a row as `width` separate numbers."""


class FloatOperations:
    """`Operations` on Python's floats."""

    sqrt = staticmethod(math.sqrt)
    exp = staticmethod(math.exp)
    angle_coefficients = staticmethod(angle_coefficients)
    polynomials = staticmethod(polynomials)

    @staticmethod
    def clip(x: float, low: float, high: float) -> float:
        """Return x limited to [low, high]."""
        return min(max(x, low), high)

    @staticmethod
    def log_sum_exp(terms: Sequence[float]) -> float:
        """Return the logarithm of the sum of exponentials, free of overflow."""
        peak = max(terms)
        return peak + math.log(sum(math.exp(term - peak) for term in terms))

    @staticmethod
    def columns(table: Rows) -> list[tuple[float, ...]]:
        """Return the columns of a table."""
        return list(zip(*table))

    @staticmethod
    def weighted_sum(factors: Sequence[float], weights: Rows) -> Triple[float]:
        """Return the sum of the rows of a table, each multiplied by its factor."""
        x = y = z = 0.0
        for factor, (a, b, c) in zip(factors, weights):
            x, y, z = x + factor * a, y + factor * b, z + factor * c
        return x, y, z

    @staticmethod
    def lookup(x: float, knots: Rows, tables: Sequence[Rows]) -> list[list[float]]:
        """Return row i of each table, where i is the number of knots at or below x."""
        interval = bisect_right(knots, [x])
        return [table[interval] for table in tables]

    @staticmethod
    def split(row: Sequence[float], width: int) -> Sequence[float]:
        """Return the row unchanged: it already consists of separate numbers."""
        return row


def rows(flat: Sequence[float], width: int) -> Rows:
    """Return a flat array split into rows of ``width`` numbers."""
    return [list(flat[i : i + width]) for i in range(0, len(flat), width)]


def triple(values: Sequence[N]) -> Triple[N]:
    """Return three values as a tuple."""
    x, y, z = values
    return x, y, z
