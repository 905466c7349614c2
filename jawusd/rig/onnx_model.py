"""The exact jaw model and its inverse as ONNX operators.

The encoder is an ONNX loop: damped Newton's method from the nearest of many starting points. The distance of two poses
is that of `jawusd.evaluator.encoding`: four homogeneous vectors represent all landmarks. The running time depends more
on the number of operators than on the number of rows. Each iteration therefore evaluates the model once, at a stencil
of points around each d, whose differences are its first and second derivatives.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.evaluator.arrays import flat_arrays
from jawusd.evaluator.encoding import landmark_vectors
from jawusd.evaluator.formula import BoundFormula, RigidMotion
from jawusd.evaluator.kinds import MODELS
from jawusd.evaluator.operations import Rows, triple
from jawusd.geometry.rodrigues import apply_series, dot
from jawusd.geometry.se3 import se3_adjoint, se3_inverse
from jawusd.rig.onnx_graph import Graph, Value
from jawusd.rig.table import grid_points, valid_box

_ITERATIONS = 40
_FIRST_NEWTON = 5  # first iteration with the full Hessian, which is often misleading farther from the minimum
# Step length below which a row has converged. The loop ends when all rows have converged; their last steps, which
# double the number of correct digits, are taken without another evaluation of the model.
_CONVERGED_MM = 1e-5
_STARTS = (19, 11, 11)  # number of starts along d1, d2, d3
_START_MARGIN_MM = 3.0  # extension of the grid beyond the bounds [mm], for poses slightly outside
_STEP_MM = 1e-3  # step of the finite differences in d [mm]
_START_DAMPING = 1e-6
_MIN_DAMPING = 1e-12
# Numbers of columns for a point of the search: d, its cost (squared distance), half the gradient of the cost, and half
# its Hessian, once in the Gauss-Newton approximation and once in full; see `_PAIRS`.
_POINT = {"d": 3, "cost": 1, "slope": 3, "gauss_newton": 6, "newton": 6}
# numbers of columns that an iteration passes to the next one
_LOOP_STATE = {"point": sum(_POINT.values()), "trial": 3, "damping": 1}
_PAIRS = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]  # stored entries of a symmetric matrix
_PLACE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # place of each entry of a symmetric matrix in its stored form


def decode_motion(g: Graph, rig: JawRig, d: Value) -> RigidMotion[Value]:
    """Add the model to a graph and return the motion in the anatomical frame of parameters d (n, 3) [mm]."""
    formula = MODELS[rig.kind](flat_arrays(rig.arrays))
    return formula.motion(triple(g.parts(d, 3)), _stored(formula.tables), g)


def add_margin(g: Graph, rig: JawRig, d: Value) -> Value:
    """Add the signed distance (n, 1) to the bound [mm] to a graph."""
    formula = BoundFormula(flat_arrays(rig.arrays))
    return formula.margin(triple(g.parts(d, 3)), _stored(formula.tables), g)


def add_twist(g: Graph, rig: JawRig, motion: RigidMotion[Value], name: str) -> None:
    """Add the twists (omega [rad], v [mm]) of motions in the skull frame as an output, shape (n, 6)."""
    x = dot(motion.omega, motion.omega)
    a, b, _ = g.angle_coefficients(x)
    v = apply_series(motion.omega, motion.t, -0.5, g.inverse_coefficient(x, a, b))
    to_skull = se3_adjoint(se3_inverse(rig.T_anatomical_skull))
    g.op("MatMul", g.concat([*motion.omega, *v]), g.constant(to_skull.T), name=name)


def images(g: Graph, rig: JawRig, motion: RigidMotion[Value], vectors: Array) -> Value:
    """Return homogeneous vectors (4, m) of the mandible frame transformed to the skull frame, shape (n, 3 m).

    The result is a displacement from the closed teeth, so that d = 0 is exact in any precision.
    """
    to_skull = se3_inverse(rig.T_anatomical_skull)[:3, :3]
    at_rest = rig.T_anatomical_skull @ rig.T_rest @ vectors
    # entry (i, j) of [turn | t] moves vector k by to_skull[:, i] at_rest[j, k]
    matrix = np.einsum("ci,jk->ijkc", to_skull, at_rest).reshape(12, -1)
    entries = g.concat([x for row, shift in zip(motion.turn, motion.t) for x in (*row, shift)])
    return entries @ matrix + g.constant((rig.T_rest @ vectors)[:3].T.reshape(1, -1))


def _stored(tables: dict[str, Rows]) -> dict[str, Array]:
    return {name: np.array(table) for name, table in tables.items()}


def add_encoder(g: Graph, rig: JawRig, pose: Value, d: str, residual: str) -> None:
    """Add the encoder to a graph.

    Args:
        pose: Poses (n, 4, 4).
        d: Name of the output: parameters (n, 3) [mm].
        residual: Name of the output: rms landmark distances (n,) [mm].
    """
    f = Graph(np.float64, "f_")
    vectors = landmark_vectors(rig.landmarks)
    flat = f.reshape(f.op("Cast", pose, to=TensorProto.DOUBLE), [-1, 16])
    target = f.op("MatMul", flat, f.constant(_images_of_pose(vectors)), name="target")
    start = _nearest_start(f, rig, vectors, target)
    unknown = np.array([[np.inf, *[0.0] * 15]])  # the start is evaluated in the first iteration
    point = f.concat([start, target @ np.zeros((12, 16)) + f.constant(unknown)])  # propagates NaN from the pose
    damping = start @ np.zeros((3, 1)) + _START_DAMPING
    some = f.op("Greater", f.op("Size", target), f.constant(0, np.int64))
    state = [f.constant(_ITERATIONS, np.int64), some, point, start, damping]
    outputs = ["f_point", "f_trial", "f_damping"]
    f.nodes.append(helper.make_node("Loop", [value.name for value in state], outputs, body=_body(rig, vectors)))
    found, cost, slope, *_ = f.columns_of(Value(f, "f_point"), list(_POINT.values()))
    step = found - Value(f, "f_trial")
    short = f.op("LessOrEqual", f.op("ReduceMax", f.op("Abs", step), axes=[1], keepdims=1), _CONVERGED_MM)
    step = f.op("Where", short, step, 0.0)
    last_cost = f.op("Max", cost - f.sum_columns(slope * step), 0.0)
    distance = f.op("Squeeze", f.sqrt(last_cost + cost * 0.0), f.constant([1], np.int64))
    known = found - step + cost * 0.0
    g.nodes += f.nodes
    g.initializers += f.initializers
    g.op("Cast", known, to=g.elem_type, name=d)
    g.op("Cast", distance, to=g.elem_type, name=residual)


def _images_of_pose(vectors: Array) -> Array:
    """Return the matrix (16, 12) that maps a flat pose to the transformed four vectors, vector by vector."""
    matrix = np.zeros((4, 4, 4, 3))
    for i in range(3):
        matrix[i, :, :, i] = vectors
    return matrix.reshape(16, 12)


def _images(g: Graph, rig: JawRig, vectors: Array, d: Value) -> Value:
    """Return the four vectors transformed by the poses of d (n, 3), shape (n, 12)."""
    return images(g, rig, decode_motion(g, rig, d), vectors)


def _nearest_start(g: Graph, rig: JawRig, vectors: Array, target: Value) -> Value:
    """Return the grid point (n, 3) whose vectors are nearest to the target."""
    box = valid_box(rig) + np.array([-_START_MARGIN_MM, _START_MARGIN_MM])
    axes = [np.linspace(low, high, count) for (low, high), count in zip(box, _STARTS, strict=True)]
    grid = grid_points(axes)
    candidates = np.swapaxes((rig.pose(grid) @ vectors)[:, :3], 1, 2).reshape(-1, 12)
    # |a - b|^2 without |a|^2, which is the same for all candidates
    distance = g.constant((candidates**2).sum(axis=1)[None]) - (target @ candidates.T) * 2.0
    return g.op("Gather", g.constant(grid), g.op("ArgMin", distance, axis=1, keepdims=0), axis=0)


def _body(rig: JawRig, vectors: Array) -> onnx.GraphProto:
    """Return the loop body: a damped step of Newton's method, accepted if it reduces the cost.

    In the first iterations, and where the Hessian is not positive definite, the Gauss-Newton approximation is used
    (Nocedal and Wright 2006, section 10.3).
    """
    b = Graph(np.float64, "b_")
    point, trial, damping = (Value(b, f"b_{name}") for name in _LOOP_STATE)
    tried = b.concat([trial, _measured(b, rig, vectors, trial)])
    place = b.constant([3], np.int64)
    cost, cost_tried = (b.op("Gather", x, place, axis=1) for x in (point, tried))
    better = b.op("LessOrEqual", cost_tried, cost)
    kept = b.op("Where", better, tried, point, name="b_point_out")
    reduced = b.op("Max", damping * 0.1, _MIN_DAMPING)
    amount = b.op("Where", better, reduced, damping * 10.0, name="b_damping_out")
    d, _, slope, gauss_newton, newton = b.columns_of(kept, list(_POINT.values()))
    minors, determinant = _minors(b, newton)
    leading = b.concat([newton @ np.eye(6)[:, :1], minors @ np.eye(6)[:, 5:], determinant])
    definite = b.op("Greater", b.op("ReduceMin", leading, axes=[1], keepdims=1), 0.0)
    late = b.op("GreaterOrEqual", Value(b, "b_count"), b.constant(_FIRST_NEWTON, np.int64))
    on_diagonal = np.outer([1, 0, 0, 1, 0, 1], [1, 0, 0, 1, 0, 1]) / 3.0
    hessian = b.op("Where", b.op("And", definite, late), newton, gauss_newton) + (gauss_newton @ on_diagonal) * amount
    minors, determinant = _minors(b, hessian)
    products = (minors @ np.eye(6)[:, _PLACE.ravel()]) * (slope @ np.tile(np.eye(3), 3))
    step = (products @ np.repeat(np.eye(3), 3, axis=0)) / determinant
    b.op("Sub", d, step, name="b_trial_out")
    # comparisons with NaN are false, so rows with NaN do not keep the loop running
    long = b.op("Greater", b.op("Abs", step), _CONVERGED_MM)
    moving = b.op("ReduceSum", b.op("Cast", long, to=TensorProto.INT64), keepdims=0)
    b.op("Greater", moving, b.constant(0, np.int64), name="b_going_out")

    def state(suffix: str) -> list[onnx.ValueInfoProto]:
        return [
            helper.make_tensor_value_info(f"b_{name}{suffix}", TensorProto.DOUBLE, ["N", width])
            for name, width in _LOOP_STATE.items()
        ]

    counter = helper.make_tensor_value_info("b_count", TensorProto.INT64, [])
    going, going_out = (helper.make_tensor_value_info(f"b_going{s}", TensorProto.BOOL, []) for s in ("", "_out"))
    inputs, outputs = [counter, going, *state("")], [going_out, *state("_out")]
    return helper.make_graph(b.nodes, "step", inputs, outputs, b.initializers)


def _measured(g: Graph, rig: JawRig, vectors: Array, d: Value) -> Value:
    """Return the columns of `_POINT` that follow d, at points d (n, 3), by central and mixed differences."""
    unit = np.eye(3)
    mixed = [unit[i] + unit[j] for i, j in _PAIRS if i != j]
    shifts = _STEP_MM * np.array([np.zeros(3), *unit, *-unit, *mixed])
    around = g.reshape(g.reshape(d, [-1, 1, 3]) + g.constant(shifts[None]), [-1, 3])
    target = g.reshape(Value(g, "target"), [-1, 1, 12])
    offsets = g.reshape(_images(g, rig, vectors, around), [-1, 10, 12]) - target
    at = np.eye(10)
    centre, ahead, behind, both = at[0], at[1:4], at[4:7], iter(at[7:])
    first = (ahead - behind) / (2.0 * _STEP_MM)
    second = [
        (ahead[i] + behind[i] - 2.0 * centre if i == j else next(both) - ahead[i] - ahead[j] + centre) / _STEP_MM**2
        for i, j in _PAIRS
    ]
    differences = np.array([at[0], *first, *second])
    derivatives, low = (g.op("MatMul", g.constant(rows), offsets) for rows in (differences, differences[:4]))
    products = g.op("MatMul", derivatives, g.op("Transpose", low, perm=[0, 2, 1]))
    return g.reshape(products, [-1, 40]) @ _selection()


def _selection() -> Array:
    """Return the matrix (40, 16) from products of residual and derivatives (10, 4) to the columns of `_POINT`."""
    place = np.eye(40).reshape(10, 4, 40)
    gauss_newton = [place[1 + i, 1 + j] for i, j in _PAIRS]
    newton = [product + place[4 + k, 0] for k, product in enumerate(gauss_newton)]
    return np.array([place[0, 0], *place[1:4, 0], *gauss_newton, *newton]).T


def _minors(g: Graph, matrix: Value) -> tuple[Value, Value]:
    """Return the adjugates (n, 6) and determinants (n, 1) of symmetric matrices (n, 6)."""
    xx, xy, xz, yy, yz, zz = range(6)
    factors = ((yy, xz, xy, xx, xy, xx), (zz, yz, yz, zz, xz, yy), (yz, xy, xz, xz, xx, xy), (yz, zz, yy, xz, yz, xy))
    a, b, c, e = (matrix @ np.eye(6)[:, columns] for columns in factors)
    minors = a * b - c * e
    return minors, (matrix * minors) @ np.array([[1.0], [1.0], [1.0], [0.0], [0.0], [0.0]])
