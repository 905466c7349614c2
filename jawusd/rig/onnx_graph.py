"""Write formulas as ONNX graphs: each operation on a `Value` adds a node to its `Graph`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import factorial

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

from jawusd.base.arrays import Array
from jawusd.evaluator.formula import long_angle_series
from jawusd.evaluator.operations import triple
from jawusd.geometry.rodrigues import Triple, angle_quotients

# absolute Bernoulli numbers |B_2k|, k = 1..8, in the series of the inverse left Jacobian
_BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510)
_INVERSE_SERIES = [number / factorial(2 * k) for k, number in enumerate(_BERNOULLI, start=1)]
# Squared angle below which the closed forms suffer from cancellation in float32; above, the series is inaccurate.
_SERIES_BELOW_RAD2 = 0.25

FloatType = type[np.float32] | type[np.float64]


def _operator(kind: str, *, swapped: bool = False) -> Callable[[Value, Value | float], Value]:
    """Return the method of a binary operator, by default with the value on the left."""
    return lambda value, other: value.graph.op(kind, *((other, value) if swapped else (value, other)))


@dataclass(frozen=True)
class Value:
    """A value in a graph: a column (n, 1), or an array of m columns (n, m); see `jawusd.evaluator.operations`."""

    graph: Graph = field(repr=False)
    name: str

    __add__, __radd__ = _operator("Add"), _operator("Add", swapped=True)
    __sub__, __rsub__ = _operator("Sub"), _operator("Sub", swapped=True)
    __mul__, __rmul__ = _operator("Mul"), _operator("Mul", swapped=True)
    __truediv__ = _operator("Div")

    def __neg__(self) -> Value:
        return self.graph.op("Mul", self, -1.0)

    def __matmul__(self, matrix: ArrayLike) -> Value:
        """Return rows (n, k) times a constant matrix (k, m)."""
        return self.graph.op("MatMul", self, self.graph.constant(matrix))


@dataclass(eq=False)
class Graph:
    """A graph under construction, of one floating-point type; implements `Operations` on its values."""

    dtype: FloatType  # float32 or float64
    prefix: str = ""  # prefix of all names; nested graphs must not share names
    nodes: list[onnx.NodeProto] = field(default_factory=list)  # operators added so far
    initializers: list[onnx.TensorProto] = field(default_factory=list)  # constants added so far
    _found: dict[tuple[str, ...], Value] = field(default_factory=dict)
    _polynomials: dict[tuple[str, bytes], list[Value]] = field(default_factory=dict)
    _constants: dict[tuple[str, tuple[int, ...], bytes], Value] = field(default_factory=dict)

    @property
    def elem_type(self) -> int:
        """The ONNX element type of the graph's floating-point values."""
        return TensorProto.DOUBLE if self.dtype is np.float64 else TensorProto.FLOAT

    def constant(self, value: ArrayLike, dtype: type[np.int64] | type[np.bool_] | None = None) -> Value:
        """Add a constant, by default of the graph's type. Equal constants are added once."""
        array = np.array(value, dtype=dtype or self.dtype)
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._constants:
            self._constants[key] = Value(self, f"{self.prefix}c{len(self._constants)}")
            self.initializers.append(numpy_helper.from_array(array, self._constants[key].name))
        return self._constants[key]

    def op(
        self, kind: str, *inputs: Value | float, name: str | None = None, **attributes: int | Sequence[int]
    ) -> Value:
        """Add an operator and return its output; an equal operator is reused."""
        names = [(x if isinstance(x, Value) else self.constant(x)).name for x in inputs]
        key = (kind, *names, str(sorted(attributes.items())))
        if name is None and key in self._found:
            return self._found[key]
        output = name or f"{self.prefix}{kind.lower()}{len(self.nodes)}"
        node = helper.make_node(kind, names, [output])
        node.attribute.extend(helper.make_attribute(key, value) for key, value in sorted(attributes.items()))
        self.nodes.append(node)
        return self._found.setdefault(key, Value(self, output))

    def concat(self, parts: Sequence[Value]) -> Value:
        """Return values joined along axis 1."""
        return self.op("Concat", *parts, axis=1)

    def parts(self, a: Value, count: int, *, axis: int = 1) -> list[Value]:
        """Split a value into equal parts along an axis."""
        names = [f"{self.prefix}part{len(self.nodes)}_{i}" for i in range(count)]
        self.nodes.append(helper.make_node("Split", [a.name], names, axis=axis))
        return [Value(self, name) for name in names]

    def groups(self, a: Value, widths: Sequence[int]) -> list[Value]:
        """Split a value along axis 1 into parts of given widths."""
        names = [f"{self.prefix}group{len(self.nodes)}_{i}" for i in range(len(widths))]
        sizes = self.constant(widths, np.int64)
        self.nodes.append(helper.make_node("Split", [a.name, sizes.name], names, axis=1))
        return [Value(self, name) for name in names]

    def sum_columns(self, a: Value) -> Value:
        """Return the sum over axis 1, keeping it: (n, k) to (n, 1)."""
        return self.op("ReduceSum", a, self.constant([1], np.int64), keepdims=1)

    def reshape(self, a: Value, shape: Sequence[int]) -> Value:
        """Return a value reshaped."""
        return self.op("Reshape", a, self.constant(shape, np.int64))

    def sqrt(self, x: Value) -> Value:
        """Return the square root."""
        return self.op("Sqrt", x)

    def exp(self, x: Value) -> Value:
        """Return the exponential."""
        return self.op("Exp", x)

    def clip(self, x: Value, low: float, high: float) -> Value:
        """Return x limited to [low, high]."""
        return self.op("Clip", x, low, high)

    def angle_coefficients(self, squared: Value) -> Triple[Value]:
        """Return a, b and c of `jawusd.geometry.rodrigues` at a squared angle [rad^2]."""
        small, far, series = self._near_and_far(squared)
        angle = self.sqrt(far)
        quotients = angle_quotients(far, angle, self.op("Sin", angle), self.op("Sin", 0.5 * angle))
        return triple([self.op("Where", small, x, y) for x, y in zip(series, quotients)])

    def inverse_coefficient(self, squared: Value, a: Value, b: Value) -> Value:
        """Return e of the inverse left Jacobian ``I - W / 2 + e W W``: ``(1 - a / (2 b)) / x`` (Barfoot 2017, 7.77)."""
        small, far, series = self._near_and_far(squared)
        return self.op("Where", small, series[3], (1.0 - a / (2.0 * b)) / far)

    def angle_slopes(self, squared: Value, coefficients: Triple[Value]) -> tuple[Value, Value]:
        """Return db/dx = ``(a - 2 b) / 2x`` and dc/dx = ``(b - 3 c) / 2x``, where x is the squared angle."""
        small, far, _ = self._near_and_far(squared)
        a, b, c = coefficients
        near = self.op("Min", squared, _SERIES_BELOW_RAD2)
        slopes = [[k * value for k, value in enumerate(series)][1:] for series in long_angle_series()[1:]]
        quotients = ((a - 2.0 * b) / (2.0 * far), (b - 3.0 * c) / (2.0 * far))
        b_x, c_x = (self.op("Where", small, x, y) for x, y in zip(self.polynomials(slopes, near), quotients))
        return b_x, c_x

    def _near_and_far(self, squared: Value) -> tuple[Value, Value, list[Value]]:
        """Return a mask of small squared angles, squared angles clipped for the closed forms, and values of the series.

        Both branches are evaluated everywhere and must not overflow, because infinity times 0 is NaN.
        """
        near = self.op("Min", squared, _SERIES_BELOW_RAD2)
        series = self.polynomials([*long_angle_series(), _INVERSE_SERIES], near)
        return self.op("Less", squared, _SERIES_BELOW_RAD2), self.op("Max", squared, _SERIES_BELOW_RAD2), series

    def polynomials(self, coefficients: Sequence[Sequence[float]], x: Value) -> list[Value]:
        """Return polynomials of x as its powers times a matrix, with a third as many operators as Horner's scheme."""
        degree = max(map(len, coefficients)) - 1
        powers = [x]
        while len(powers) < degree:
            half = len(powers) // 2
            powers.append(powers[half] * powers[len(powers) - half - 1])
        table = np.array([[*each, *[0.0] * (degree + 1 - len(each))] for each in coefficients]).T
        key = (x.name, table.tobytes())
        if key not in self._polynomials:
            self._polynomials[key] = self.parts(
                self.concat(powers) @ table[1:] + self.constant(table[:1]), len(table.T)
            )
        return self._polynomials[key]

    def log_sum_exp(self, terms: Sequence[Value]) -> Value:
        """Return the logarithm of the sum of exponentials, computed without overflow."""
        joined = self.concat(terms)
        peak = self.op("ReduceMax", joined, axes=[1], keepdims=1)
        return peak + self.op("Log", self.sum_columns(self.exp(joined - peak)))

    def columns(self, table: Array) -> list[tuple[Value]]:
        """Return the columns of a table (m, k), each as a constant (1, m)."""
        return [(self.constant(column[None]),) for column in table.T]

    def weighted_sum(self, factors: Sequence[Value], weights: Array) -> Triple[Value]:
        """Return the sum of the rows of a table (m, 3), weighted by factors (n, m), as three columns (n, 1)."""
        return triple(self.parts(factors[0] @ weights, 3))

    def lookup(self, x: Value, knots: Array, tables: Sequence[Array]) -> list[tuple[Value]]:
        """Return from each table the row (n, k) whose index is the number of knots (m, 1) at or below x.

        It is row 0 plus, for each knot at or below x, the difference of two consecutive rows: a matrix product.
        """
        passed = self.op("Cast", self.op("GreaterOrEqual", x, self.constant(knots.T)), to=self.elem_type)
        return [(passed @ np.diff(table, axis=0) + self.constant(table[:1]),) for table in tables]

    def split(self, row: Sequence[Value], width: int) -> list[Value]:
        """Return the columns (n, 1) of a value (n, width)."""
        return self.parts(row[0], width)


def float_type(model: onnx.ModelProto) -> FloatType:
    """Return the numpy type of a model's first input."""
    elem_type = model.graph.input[0].type.tensor_type.elem_type
    return np.float64 if elem_type == TensorProto.DOUBLE else np.float32
