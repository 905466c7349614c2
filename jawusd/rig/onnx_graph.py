"""Write formulas as ONNX graphs: a builder whose methods each add one operator and return its output."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import factorial

import numpy as np
import onnx
from numpy.typing import ArrayLike, NDArray
from onnx import TensorProto, helper, numpy_helper

# |B_2k|, k = 1..8, of the series of the inverse left Jacobian
_BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510)
_SERIES_TERMS = 8
# Below this squared angle the closed forms lose digits to cancellation, above it the series would.
_SERIES_BELOW_RAD2 = 0.25


@dataclass
class Graph:
    """Collect the nodes of a graph of one floating-point type; values are their names.

    Attributes:
        dtype: float32 or float64.
        prefix: start of every name; graphs inside one another must not share names.
        nodes: operators so far.
        initializers: constants so far.
    """

    dtype: np.dtype
    prefix: str = ""
    nodes: list[onnx.NodeProto] = field(default_factory=list)
    initializers: list[onnx.TensorProto] = field(default_factory=list)
    _constants: dict[tuple, str] = field(default_factory=dict)

    @property
    def elem_type(self) -> int:
        """The ONNX element type of the graph's numbers."""
        return TensorProto.DOUBLE if self.dtype == np.float64 else TensorProto.FLOAT

    def constant(self, value: ArrayLike, dtype: type | None = None) -> str:
        """Add a constant (once per value) and return its name."""
        array = np.ascontiguousarray(value, dtype=dtype or self.dtype)
        array = array.reshape(np.shape(value))
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._constants:
            name = f"{self.prefix}c{len(self._constants)}"
            self._constants[key] = name
            self.initializers.append(numpy_helper.from_array(array, name))
        return self._constants[key]

    def op(self, kind: str, *inputs: str | float, name: str | None = None, **attributes: object) -> str:
        """Add an operator and return its one output; plain numbers become constants of the graph's type."""
        names = [value if isinstance(value, str) else self.constant(float(value)) for value in inputs]
        output = name or f"{self.prefix}{kind.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, names, [output], **attributes))
        return output

    def add(self, *terms: str | float) -> str:
        """Return the sum of two or more values."""
        total = terms[0]
        for term in terms[1:]:
            total = self.op("Add", total, term)
        return str(total)

    def mul(self, *factors: str | float) -> str:
        """Return the product of two or more values."""
        product = factors[0]
        for factor in factors[1:]:
            product = self.op("Mul", product, factor)
        return str(product)

    def sub(self, a: str | float, b: str | float) -> str:
        """Return a less b."""
        return self.op("Sub", a, b)

    def div(self, a: str | float, b: str | float) -> str:
        """Return a divided by b."""
        return self.op("Div", a, b)

    def matmul(self, a: str, matrix: ArrayLike) -> str:
        """Return rows a (n, k) times a constant matrix (k, m)."""
        return self.op("MatMul", a, self.constant(matrix))

    def concat(self, *columns: str, axis: int = 1) -> str:
        """Return values joined along an axis."""
        return self.op("Concat", *columns, axis=axis)

    def columns(self, a: str, count: int) -> list[str]:
        """Return the columns (n, 1) of rows (n, count)."""
        return self.split(a, count, axis=1)

    def split(self, a: str, count: int, axis: int) -> list[str]:
        """Return equal parts of a value along an axis."""
        names = [f"{self.prefix}part{len(self.nodes)}_{i}" for i in range(count)]
        self.nodes.append(helper.make_node("Split", [a], names, axis=axis))
        return names

    def sum_rows(self, a: str) -> str:
        """Return the sum over axis 1, keeping it: (n, k) to (n, 1)."""
        return self.op("ReduceSum", a, self.constant([1], np.int64), keepdims=1)

    def clip(self, a: str, low: float, high: float) -> str:
        """Return values limited to an interval."""
        return self.op("Min", self.op("Max", a, low), high)

    def horner(self, x: str, coefficients: list[str] | list[float]) -> str:
        """Return sum_k coefficients[k] x^k."""
        value: str | float = coefficients[-1]
        for coefficient in reversed(coefficients[:-1]):
            value = self.add(self.mul(value, x), coefficient)
        return str(value)

    def hermite(self, x: str, knots: NDArray, values: NDArray, slopes: NDArray) -> str:
        """Evaluate a C1 cubic Hermite curve that goes on straight outside its knots.

        Args:
            x: positions (n, 1).
            knots: (m,), increasing.
            values: (m, k).
            slopes: (m, k).

        Returns:
            Values (n, k).
        """
        h = np.diff(knots)[:, None]
        rise = np.diff(values, axis=0) / h
        square = (3 * rise - 2 * slopes[:-1] - slopes[1:]) / h
        cube = (slopes[:-1] + slopes[1:] - 2 * rise) / h**2
        zero = np.zeros_like(values[:1])
        # one row per interval, the two straight ends among them, each about its own start
        rows = [values[[0]], values[:-1], values[-1:]], [slopes[[0]], slopes[:-1], slopes[-1:]]
        powers = [np.concatenate(row) for row in (*rows, [zero, square, zero], [zero, cube, zero])]
        starts = np.concatenate([knots[:1], knots])[:, None]
        passed = self.op("Cast", self.op("GreaterOrEqual", x, self.constant(knots[None])), to=TensorProto.INT64)
        interval = self.op("ReduceSum", passed, self.constant([1], np.int64), keepdims=0)
        s = self.sub(x, self.op("Gather", self.constant(starts), interval, axis=0))
        return self.horner(s, [self.op("Gather", self.constant(power), interval, axis=0) for power in powers])

    def cross(self, a: str, b: str) -> str:
        """Return the cross products of rows (n, 3)."""
        ax, ay, az = self.columns(a, 3)
        bx, by, bz = self.columns(b, 3)
        return self.concat(
            self.sub(self.mul(ay, bz), self.mul(az, by)),
            self.sub(self.mul(az, bx), self.mul(ax, bz)),
            self.sub(self.mul(ax, by), self.mul(ay, bx)),
        )


@dataclass(frozen=True)
class Rotation:
    """Apply exp of rotation vectors omega (n, 3), and the left Jacobian V of SO(3), to vectors.

    With W = [omega]x and x = |omega|^2: exp = 1 + a W + b W^2, V = 1 + b W + c W^2, V^-1 = 1 - W/2 + e W^2, where
    a = sin t / t, b = (1 - cos t) / t^2, c = (t - sin t) / t^3, e = (1 - a / (2 b)) / t^2, t = sqrt(x)
    (Sola et al. 2018, appendix; Barfoot 2017, 7.77). Series in x near zero, so nothing is divided by zero and no
    digits are lost.
    """

    graph: Graph
    omega: str
    a: str
    b: str
    c: str
    e: str

    @classmethod
    def of(cls, graph: Graph, omega: str) -> Rotation:
        """Add the four coefficients of rotation vectors (n, 3) to a graph."""
        g = graph
        x = g.sum_rows(g.mul(omega, omega))
        small = g.op("Less", x, _SERIES_BELOW_RAD2)
        x_far = g.op("Max", x, _SERIES_BELOW_RAD2)
        t = g.op("Sqrt", x_far)
        sine = g.op("Sin", t)
        half = g.op("Sin", g.mul(t, 0.5))
        far_a = g.div(sine, t)
        far_b = g.div(g.mul(g.mul(half, half), 2.0), x_far)
        far_c = g.div(g.sub(t, sine), g.mul(x_far, t))
        far_e = g.div(g.sub(1.0, g.div(far_a, g.mul(far_b, 2.0))), x_far)

        def blend(offset: int, far: str) -> str:
            series = [(-1.0) ** k / factorial(2 * k + offset) for k in range(_SERIES_TERMS)]
            return g.op("Where", small, g.horner(x, series), far)

        inverse = [number / factorial(2 * k) for k, number in enumerate(_BERNOULLI, start=1)]
        e = g.op("Where", small, g.horner(x, inverse), far_e)
        return cls(graph, omega, blend(1, far_a), blend(2, far_b), blend(3, far_c), e)

    def rotate(self, v: str) -> str:
        """Return exp(omega) v for rows (n, 3)."""
        return self._combine(v, self.a, self.b)

    def integrate(self, v: str) -> str:
        """Return V(omega) v, the translation of the twist (omega, v)."""
        return self._combine(v, self.b, self.c)

    def differentiate(self, t: str) -> str:
        """Return V(omega)^-1 t, the v of the twist whose translation is t."""
        return self._combine(t, self.graph.constant(-0.5), self.e)

    def _combine(self, v: str, first: str, second: str) -> str:
        g = self.graph
        once = g.cross(self.omega, v)
        return g.add(v, g.mul(once, first), g.mul(g.cross(self.omega, once), second))


def float_type(model: onnx.ModelProto) -> type:
    """Return the numpy type of a model's first input."""
    elem_type = model.graph.input[0].type.tensor_type.elem_type
    return np.float64 if elem_type == TensorProto.DOUBLE else np.float32
