"""The charts of the kinds of models as ONNX operators: motions with derivatives, as in `jawusd.evaluator.models`.

For single poses, the running time depends on the number of operators. The vectors and matrices of a pose are therefore
packed into one value, except in the scalar formulas of the gauge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import onnx
from onnx import TensorProto, helper

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.evaluator.arrays import flat_arrays
from jawusd.evaluator.formula import curve_derivatives
from jawusd.evaluator.gauge import (
    INVERSE_ITERATIONS,
    INVERSE_STEP_MM,
    MAX_DOUBLINGS,
    MIN_INVERSE_SLOPE,
    PATIENCE,
    Elementary,
    opening_equation,
    spline_input,
)
from jawusd.evaluator.kinds import ADDITIVE, ANCHORED, MODELS
from jawusd.evaluator.models import AnchoredModel
from jawusd.evaluator.operations import Rows, triple
from jawusd.geometry.rodrigues import Triple
from jawusd.geometry.so3 import hat
from jawusd.rig.onnx_graph import Graph, Value

_OPENING_TOLERANCE = 1e-10  # step of the opening below which it has converged, relative to 1 mm plus the opening
#: Step of finite differences, and displacements of a point for central differences: none, forward, backward [mm].
STEP_MM = 1e-3
SHIFTS_MM = STEP_MM * np.array([np.zeros(3), *np.eye(3), *-np.eye(3)])
# Maps 1, s, s^2, s^3 to themselves and their derivatives with respect to s.
_POWERS = np.hstack([np.eye(4), np.diag([1.0, 2.0, 3.0], 1)])
_HAT = hat(np.eye(3)).reshape(3, 9)  # maps rows (n, 3) to skew matrices (n, 9)


@dataclass(frozen=True)
class ChartMotion:
    """A motion in the anatomical frame and its derivatives with respect to the chart, for rows of poses."""

    R: Value  # rotation, shape (n, 3, 3)
    shift: Value  # displacement of the model's reference point [mm], shape (n, 1, 3)
    w: Value  # spatial derivatives of the rotation [rad/mm], one row for each coordinate, shape (n, 3, 3)
    shift_x: Value  # derivatives of the displacement, one row for each coordinate, shape (n, 3, 3), or (1, 3, 3)


class AnchoredChart:
    """Chart whose coordinates are the displacement u of the lower incisal point; the spline maps u to the rotation."""

    def __init__(self, rig: JawRig) -> None:
        self._model = AnchoredModel.from_arrays(rig.arrays)
        # point: the reference point at rest, anatomical frame [mm], shape (3,)
        self._gauge, self.point = self._model.gauge.numbers, self._model.incisor

    def start(self, g: Graph, u: Value) -> Value:
        """Return u: the chart coordinates of this model are the displacements."""
        return u

    def motion(self, g: Graph, x: Value) -> ChartMotion:
        """Return the motions that displace the incisal point by x (n, 3) [mm]."""
        scales = self._model.scales
        q, slopes = spline_input(self._gauge, scales.tolist(), triple(g.parts(x, 3)), self._elementary(g))
        omega, omega_q = self._spline(g, g.concat(q))
        # dq_i / dx_j: constant, except for the slopes of the habitual path in the row of y
        by_slope, constant = np.zeros((2, 3, 3)), np.zeros((3, 3))
        by_slope[0, 1, 1], by_slope[1, 1, 2] = 1.0 / scales[1:]
        constant[1, 0], constant[0, 1], constant[2, 2] = -1.0 / scales[0], 1.0 / scales[1], 1.0 / scales[2]
        q_x = g.concat(slopes) @ by_slope.reshape(2, 9) + g.constant(constant.reshape(1, 9))
        omega_x = g.op("MatMul", g.reshape(q_x, [-1, 3, 3]), omega_q)
        turning = _Turning(g, omega)
        w = g.op("MatMul", omega_x, turning.left_transposed())
        return ChartMotion(turning.rotation(), g.reshape(x, [-1, 1, 3]), w, g.constant(np.eye(3)[None]))

    def parameters(self, g: Graph, x: Value) -> Value:
        """Return d by a search in the opening d1 alone, as `jawusd.evaluator.gauge.Gauge.inverse` does."""
        u = triple(g.parts(x, 3))
        zero = u[1] * 0.0
        state = [-u[1], zero - np.inf, zero + np.inf, x]
        some = g.op("Greater", g.op("Size", x), g.constant(0, np.int64))
        outputs = [f"{g.prefix}opening", f"{g.prefix}low", f"{g.prefix}high", f"{g.prefix}parameters"]
        names = [value.name for value in (g.constant(INVERSE_ITERATIONS, np.int64), some, *state)]
        g.nodes.append(helper.make_node("Loop", names, outputs, body=self._opening_step(u)))
        return Value(g, outputs[-1])

    def _opening_step(self, u: Triple[Value]) -> onnx.GraphProto:
        """Return the loop body: a Newton step, or bisection if the step leaves the bracket or has stalled."""
        o = Graph(np.float64, "o_")
        x, low, high = (Value(o, f"o_{name}") for name in ("opening", "low", "high"))
        outer = triple([Value(o, value.name) for value in u])
        d2, d3, remainder, slope = opening_equation(self._gauge, outer, x, self._elementary(o))
        usable = o.op("Where", o.op("Greater", slope, MIN_INVERSE_SLOPE), slope, 1.0)
        step = o.clip(-remainder / usable, -INVERSE_STEP_MM, INVERSE_STEP_MM)
        lower = o.op("Where", o.op("Less", remainder, 0.0), x, low, name="o_low_out")
        upper = o.op("Where", o.op("Greater", remainder, 0.0), x, high, name="o_high_out")
        span = upper - lower
        bounded = o.op("Less", span, np.inf)
        late = o.op("Max", o.op("Cast", Value(o, "o_count"), to=TensorProto.DOUBLE) - float(PATIENCE), 0.0)
        doubled = step * o.op("Pow", 2.0, o.op("Min", late, float(MAX_DOUBLINGS)))
        stride = o.clip(doubled, -INVERSE_STEP_MM, INVERSE_STEP_MM)
        newton = x + o.op("Where", bounded, step, stride)
        leaves = o.op("Or", o.op("LessOrEqual", newton, lower), o.op("GreaterOrEqual", newton, upper))
        odd = o.op("Greater", o.op("Mod", late, 2.0, fmod=1), 0.5)
        halve = o.op("And", bounded, o.op("Or", leaves, odd))
        size, allowed = o.op("Abs", step), (o.op("Abs", x) + 1.0) * _OPENING_TOLERANCE
        done = o.op("LessOrEqual", size, allowed)
        changed = o.op("Where", halve, lower + 0.5 * span, newton)
        o.op("Where", done, x, changed, name="o_opening_out")
        o.op("Where", done, o.concat([x, d2, d3]), np.nan, name="o_parameters_out")
        # comparisons with NaN are false, so rows with NaN do not keep the loop running
        moving = o.op("Cast", o.op("Greater", size, allowed), to=TensorProto.INT64)
        o.op("Greater", o.op("ReduceSum", moving, keepdims=0), o.constant(0, np.int64), name="o_going_out")
        return loop_body(o, "opening", {"opening": 1, "low": 1, "high": 1, "parameters": 3})

    def _spline(self, g: Graph, q: Value) -> tuple[Value, Value]:
        """Return the spline at q (n, 3), as `AnchoredModel._spline`, and its gradient (n, 3 inputs, 3 outputs)."""
        model = self._model
        centres, squares = model.centres, model.centres_squared
        kernel, linear = model.weights[: len(centres)], model.weights[len(centres) :]
        squared = g.sum_columns(q * q)
        apart = g.concat([q, squared]) @ np.vstack([-2.0 * centres.T, np.ones(len(centres))])
        r = g.sqrt(g.op("Max", apart + g.constant(squares[None]), 0.0))
        factors = np.concatenate([np.ones((len(centres), 1)), centres, squares[:, None]], axis=1)
        sums = g.reshape(r @ (factors[:, :, None] * kernel[:, None]).reshape(len(centres), 15), [-1, 5, 3])
        monomials = g.concat([squared, q * -2.0, zero_column(g, q) + 1.0])
        value = g.reshape(g.op("MatMul", g.reshape(monomials, [-1, 1, 5]), sums), [-1, 3])
        plain, by_centre, _ = g.groups(sums, [1, 3, 1])
        gradient = 3.0 * (g.reshape(q, [-1, 3, 1]) * plain - by_centre) + g.constant(linear[None])
        return value + q @ linear - g.constant(model.offset[None]), gradient

    def _elementary(self, g: Graph) -> Elementary[Value]:
        return Elementary(g.sqrt, g.exp, g.clip, lambda _, d2, d3: self._glide(g, d2, d3))

    def _glide(self, g: Graph, d2: Value, d3: Value) -> Triple[Value]:
        """Return the downward offset of the glide surface [mm] and its derivatives (d2 and d3), each (n, 1)."""
        table = self._model.gauge.glide
        if table is None:
            nothing = g.constant([[0.0]])
            return nothing, nothing, nothing
        count, rows = len(table.starts[1]), []
        cells = [self._interval(g, d, knots) for d, knots in zip((d2, d3), table.knots, strict=True)]
        for d, cell, starts in zip((d2, d3), cells, table.starts, strict=True):
            s = d - g.op("Gather", g.constant(starts[:, None]), cell, axis=0)
            square = s * s
            # rows 1, s, s^2, s^3 and their derivatives
            powers = g.concat([s, square, square * s]) @ _POWERS[1:] + g.constant(_POWERS[:1])
            rows.append(g.reshape(powers, [-1, 2, 4]))
        cell = cells[0] * g.constant(count, np.int64) + cells[1]
        coefficients = g.reshape(
            g.op("Gather", g.constant(table.coefficients.reshape(-1, 16)), cell, axis=0), [-1, 4, 4]
        )
        across = g.op("Transpose", rows[1], perm=[0, 2, 1])
        product = g.op("MatMul", g.op("MatMul", rows[0], coefficients), across)
        value, by_3, by_2, _ = g.parts(g.reshape(product, [-1, 4]), 4)
        return value, by_2, by_3

    @staticmethod
    def _interval(g: Graph, d: Value, knots: Array) -> Value:
        """Return the number of knots at or below d (n, 1), shape (n,)."""
        passed = g.op("Cast", g.op("GreaterOrEqual", d, g.constant(knots[None])), to=TensorProto.INT64)
        return g.op("ReduceSum", passed, g.constant([1], np.int64), keepdims=0)


class ParameterChart:
    """Chart of the jaw parameters d of any kind of model, with derivatives by central differences."""

    def __init__(self, rig: JawRig) -> None:
        self._formula = MODELS[rig.kind](flat_arrays(rig.arrays))
        self._starts, self.point = rig.model.starts, np.zeros(3)

    def start(self, g: Graph, u: Value) -> Value:
        """Return the grid points whose incisal displacement is nearest to u."""
        starts = self._starts
        # |a - b|^2 without |b|^2, which is the same for all grid points
        squares = (starts.displacements**2).sum(axis=1)
        distance = u @ (-2.0 * starts.displacements.T) + g.constant(squares[None])
        nearest = g.op("Gather", g.constant(starts.d), g.op("ArgMin", distance, axis=1, keepdims=0), axis=0)
        return nearest + zero_column(g, u)

    def motion(self, g: Graph, x: Value) -> ChartMotion:
        """Return the motions at d = x (n, 3) [mm]."""
        around = triple(g.parts(g.reshape(g.reshape(x, [-1, 1, 3]) + g.constant(SHIFTS_MM[None]), [-1, 3]), 3))
        found = self._formula.motion(around, stored(self._formula.tables), g)
        entries = g.reshape(g.concat([*(entry for row in found.turn for entry in row), *found.t]), [-1, 7, 12])
        turn, shift = np.split(np.eye(12), [9], axis=1)
        at_x, ahead, behind = g.groups(entries, [1, 3, 3])
        slopes = (ahead - behind) * (0.5 / STEP_MM)
        R = g.reshape(at_x @ turn + g.constant(np.eye(3).reshape(1, 1, 9)), [-1, 3, 3])
        inverse = g.reshape(g.op("Transpose", R, perm=[0, 2, 1]), [-1, 1, 3, 3])
        skew = g.reshape(g.op("MatMul", g.reshape(slopes @ turn, [-1, 3, 3, 3]), inverse), [-1, 3, 9])
        return ChartMotion(R, at_x @ shift, skew @ (0.5 * _HAT.T), slopes @ shift)

    def parameters(self, g: Graph, x: Value) -> Value:
        """Return x."""
        return x


class AdditiveChart(ParameterChart):
    """Chart of the jaw parameters d, which the curves map to twists."""

    def motion(self, g: Graph, x: Value) -> ChartMotion:
        """Return the motions at d = x (n, 3) [mm], with exact derivatives."""
        tables = stored(self._formula.tables)
        curves = [curve_derivatives(f"curve{i}", d, tables, g) for i, d in enumerate(g.parts(x, 3), start=1)]
        (first,), (second,), (third,) = (value for value, _, _ in curves)
        omega, v = g.parts(first + second + third, 2)
        slopes = g.reshape(g.concat([slope for _, (slope,), _ in curves]), [-1, 3, 6])
        omega_x, v_x = g.parts(slopes, 2, axis=2)
        turning = _Turning(g, omega)
        left = turning.left_transposed()
        row = g.reshape(v, [-1, 1, 3])
        along = g.op("MatMul", omega_x, turning.left_change_transposed(v))
        shift_x = g.op("MatMul", v_x, left) + along
        return ChartMotion(turning.rotation(), g.op("MatMul", row, left), g.op("MatMul", omega_x, left), shift_x)


Chart = AnchoredChart | ParameterChart
#: Charts with exact derivatives, by kind; `ParameterChart` serves other kinds.
CHARTS: dict[str, Callable[[JawRig], Chart]] = {ANCHORED: AnchoredChart, ADDITIVE: AdditiveChart}


class _Turning:
    """Powers of the skew matrix W (n, 9) of rotation vectors, and the coefficients a, b, c of Rodrigues' formula."""

    def __init__(self, g: Graph, omega: Value) -> None:
        """Compute the powers and coefficients for rotation vectors (n, 3) [rad]."""
        self._g, self._omega = g, omega
        self._W, self._squared = omega @ _HAT, g.sum_columns(omega * omega)
        matrix = g.reshape(self._W, [-1, 3, 3])
        self._WW = g.reshape(g.op("MatMul", matrix, matrix), [-1, 9])
        self._coefficients = g.angle_coefficients(self._squared)

    def rotation(self) -> Value:
        """Return the rotation matrix, shape (n, 3, 3)."""
        a, b, _ = self._coefficients
        return self._matrix(self._W * a + self._WW * b)

    def left_transposed(self) -> Value:
        """Return the transposed left Jacobian, shape (n, 3, 3)."""
        _, b, c = self._coefficients
        return self._matrix(self._WW * c - self._W * b)  # W is antisymmetric, W W symmetric

    def left_change_transposed(self, v: Value) -> Value:
        """Return the transposed derivative of the left Jacobian times v (n, 3), with respect to omega, (n, 3, 3).

        It is ``2 (b' W v + c' W W v) omega^T - b [v] - c (W [v] + [W v])``, where [v] is the skew matrix of v, and b'
        and c' are derivatives with respect to the squared angle.
        """
        g, (_, b, c) = self._g, self._coefficients
        b_x, c_x = g.angle_slopes(self._squared, self._coefficients)
        W = g.reshape(self._W, [-1, 3, 3])
        skew = v @ _HAT
        once = g.reshape(g.op("MatMul", W, g.reshape(v, [-1, 3, 1])), [-1, 3])
        twice = g.reshape(g.op("MatMul", W, g.reshape(once, [-1, 3, 1])), [-1, 3])
        along = 2.0 * (once * b_x + twice * c_x)
        outer = g.op("MatMul", g.reshape(self._omega, [-1, 3, 1]), g.reshape(along, [-1, 1, 3]))
        # [v]^T = -[v], and (W [v])^T = [v] W
        product = g.reshape(g.op("MatMul", g.reshape(skew, [-1, 3, 3]), W), [-1, 9])
        return outer + g.reshape(skew * b + (once @ _HAT - product) * c, [-1, 3, 3])

    def _matrix(self, flat: Value) -> Value:
        return self._g.reshape(flat + self._g.constant(np.eye(3).reshape(1, 9)), [-1, 3, 3])


def moved_vectors(g: Graph, w: Value, vectors: Value) -> Value:
    """Return the cross products of w_j (n, 3, 3) and column vectors (n, 3, k), shape (n, 3 j, 3 k)."""
    skew = g.reshape(w @ _HAT, [-1, 9, 3])
    return g.op("MatMul", skew, vectors)


def loop_body(g: Graph, name: str, state: dict[str, int]) -> onnx.GraphProto:
    """Return a graph as a loop body that reads NAME and writes NAME_out, prefixed, of given numbers of columns."""

    def columns(suffix: str) -> list[onnx.ValueInfoProto]:
        return [
            helper.make_tensor_value_info(f"{g.prefix}{key}{suffix}", TensorProto.DOUBLE, ["N", width])
            for key, width in state.items()
        ]

    counter = helper.make_tensor_value_info(f"{g.prefix}count", TensorProto.INT64, [])
    going, out = (helper.make_tensor_value_info(f"{g.prefix}going{s}", TensorProto.BOOL, []) for s in ("", "_out"))
    return helper.make_graph(g.nodes, name, [counter, going, *columns("")], [out, *columns("_out")], g.initializers)


def zero_column(g: Graph, rows: Value) -> Value:
    """Return zeros (n, 1), NaN for rows with a NaN."""
    return g.sum_columns(rows) * 0.0


def stored(tables: dict[str, Rows]) -> dict[str, Array]:
    """Return tables as arrays, which graphs store as constants."""
    return {name: np.array(table) for name, table in tables.items()}
