"""The exact jaw model and its inverse as ONNX operators.

The encoder is an ONNX loop: damped Gauss-Newton from the nearest of many starts. The distance of two poses is that of
`jawusd.evaluator.encoding`: four homogeneous vectors represent all landmarks.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.evaluator.arrays import flat_arrays
from jawusd.evaluator.encoding import landmark_vectors
from jawusd.evaluator.formula import MODELS, BoundFormula, RigidMotion
from jawusd.evaluator.operations import Rows, triple
from jawusd.geometry.rodrigues import Triple, apply_series, cross, dot
from jawusd.geometry.se3 import se3_adjoint, se3_inverse
from jawusd.rig.onnx_graph import Graph, Value
from jawusd.rig.table import grid_points, valid_box

_ITERATIONS = 30
_CONVERGED_MM = 1e-7  # step length below which a row has converged; the loop ends when all rows have
_STARTS = (19, 11, 11)  # number of starts along d1, d2, d3
_START_MARGIN_MM = 3.0  # extension of the grid beyond the bounds, for poses slightly outside
_STEP_MM = 1e-3  # step of the central differences in d
_START_DAMPING = 1e-6
_MIN_DAMPING = 1e-12
_LOOP_STATE = {"d": 3, "cost": 1, "damping": 1}  # numbers of columns of the values passed between iterations


def decode_motion(g: Graph, rig: JawRig, d: Value) -> RigidMotion[Value]:
    """Add the model to a graph and return the motion in the anatomical frame of parameters d (n, 3) [mm]."""
    formula = MODELS[rig.kind](flat_arrays(rig.arrays))
    return formula.motion(triple(g.parts(d, 3)), _stored(formula.tables), g)


def add_margin(g: Graph, rig: JawRig, d: Value) -> Value:
    """Add the signed distance (n, 1) to the bound [mm] to a graph."""
    formula = BoundFormula(flat_arrays(rig.arrays))
    return formula.margin(triple(g.parts(d, 3)), _stored(formula.tables), g)


def add_twist(g: Graph, rig: JawRig, motion: RigidMotion[Value], name: str) -> None:
    """Add the twists (omega [rad], v [mm]) of motions as an output, skull frame, shape (n, 6)."""
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
    start, cost = _nearest_start(f, rig, vectors, target)
    state = [f.constant(_ITERATIONS, np.int64), f.constant(True, np.bool_), start, cost, cost * 0.0 + _START_DAMPING]
    found = ["f_d", "f_cost", "f_damping"]
    f.nodes.append(helper.make_node("Loop", [value.name for value in state], found, body=_body(rig, vectors)))
    found_d, found_cost, _ = (Value(f, name) for name in found)
    # a NaN of the pose propagates to the cost, but not to the start
    checked_d = found_d + found_cost * 0.0
    distance = f.op("Squeeze", f.sqrt(found_cost), f.constant([1], np.int64))
    g.nodes += f.nodes
    g.initializers += f.initializers
    g.op("Cast", checked_d, to=g.elem_type, name=d)
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


def _nearest_start(g: Graph, rig: JawRig, vectors: Array, target: Value) -> tuple[Value, Value]:
    """Return the grid point (n, 3) whose vectors are nearest to the target, and the squared distance (n, 1)."""
    box = valid_box(rig) + np.array([-_START_MARGIN_MM, _START_MARGIN_MM])
    axes = [np.linspace(low, high, count) for (low, high), count in zip(box, _STARTS, strict=True)]
    grid = grid_points(axes)
    candidates = np.swapaxes((rig.pose(grid) @ vectors)[:, :3], 1, 2).reshape(-1, 12)
    # |a - b|^2 without |a|^2, which is the same for all candidates
    distance = g.constant((candidates**2).sum(axis=1)[None]) - (target @ candidates.T) * 2.0
    nearest = g.op("ArgMin", distance, axis=1, keepdims=0)
    start = g.op("Gather", g.constant(grid), nearest, axis=0)
    return start, _cost(g, _images(g, rig, vectors, start) - target)


def _body(rig: JawRig, vectors: Array) -> onnx.GraphProto:
    """Return the loop body: a damped Gauss-Newton step (Levenberg 1944, Marquardt 1963), accepted if it is better."""
    b = Graph(np.float64, "b_")
    d, cost, damping = (Value(b, f"b_{name}") for name in _LOOP_STATE)
    target = Value(b, "target")
    shifts = _STEP_MM * np.concatenate([np.eye(3), -np.eye(3)])
    around = b.concat([d + b.constant(shift[None]) for shift in shifts], axis=0)
    moved = b.parts(_images(b, rig, vectors, around), 6, axis=0)
    J = [(ahead - behind) * (0.5 / _STEP_MM) for ahead, behind in zip(moved[:3], moved[3:], strict=True)]
    step = _damped_step(b, J, _images(b, rig, vectors, d) - target, damping)
    trial = d - step
    trial_cost = _cost(b, _images(b, rig, vectors, trial) - target)
    better = b.op("LessOrEqual", trial_cost, cost)
    b.op("Where", better, trial, d, name="b_d_out")
    b.op("Where", better, trial_cost, cost, name="b_cost_out")
    reduced = b.op("Max", damping * 0.1, _MIN_DAMPING)
    b.op("Where", better, reduced, damping * 10.0, name="b_damping_out")
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


def _damped_step(g: Graph, J: list[Value], r: Value, damping: Value) -> Value:
    """Return (J^T J + damping tr/3)^-1 J^T r by Cramer's rule, shape (n, 3), for three columns J (n, 12) each."""
    products = {(i, j): g.sum_columns(J[i] * J[j]) for i in range(3) for j in range(i, 3)}
    extra = (products[0, 0] + products[1, 1] + products[2, 2]) * damping * (1.0 / 3.0)

    def column(j: int) -> Triple[Value]:
        x, y, z = (
            products[min(i, j), max(i, j)] + extra if i == j else products[min(i, j), max(i, j)] for i in range(3)
        )
        return x, y, z

    columns = [column(j) for j in range(3)]
    gx, gy, gz = (g.sum_columns(column * r) for column in J)
    minors = [cross(columns[(j + 1) % 3], columns[(j + 2) % 3]) for j in range(3)]
    determinant = dot(columns[0], minors[0])
    return g.concat([dot((gx, gy, gz), minor) for minor in minors]) / determinant


def _cost(g: Graph, r: Value) -> Value:
    return g.sum_columns(r * r)
