"""The exact jaw model as ONNX operators, and the search for the nearest pose of the model.

As in `jawusd.evaluator.encoding`, damped Gauss-Newton minimises the distance, in an ONNX loop. It converges slowly for
poses far from those of the model: if any row has not converged, a second loop continues with Newton's method.
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
from jawusd.evaluator.nearest import MIN_STIFFNESS
from jawusd.evaluator.operations import triple
from jawusd.geometry.rodrigues import apply_series, dot
from jawusd.geometry.se3 import se3_adjoint, se3_inverse
from jawusd.rig.onnx_chart import (
    CHARTS,
    SHIFTS_MM,
    STEP_MM,
    Chart,
    ParameterChart,
    loop_body,
    moved_vectors,
    stored,
    zero_column,
)
from jawusd.rig.onnx_graph import Graph, Value


def decode_motion(g: Graph, rig: JawRig, d: Value) -> RigidMotion[Value]:
    """Add the model to a graph and return the motion in the anatomical frame of parameters d (n, 3) [mm]."""
    formula = MODELS[rig.kind](flat_arrays(rig.arrays))
    return formula.motion(triple(g.parts(d, 3)), stored(formula.tables), g)


def add_margin(g: Graph, rig: JawRig, d: Value) -> Value:
    """Add the signed distance (n, 1) to the bound [mm] to a graph."""
    formula = BoundFormula(flat_arrays(rig.arrays))
    return formula.margin(triple(g.parts(d, 3)), stored(formula.tables), g)


def add_twist(g: Graph, rig: JawRig, motion: RigidMotion[Value], name: str) -> None:
    """Add the twists (omega [rad], v [mm]) of motions in the skull frame as an output, shape (n, 6)."""
    x = dot(motion.omega, motion.omega)
    a, b, _ = g.angle_coefficients(x)
    v = apply_series(motion.omega, motion.t, -0.5, g.inverse_coefficient(x, a, b))
    to_skull = se3_adjoint(se3_inverse(rig.T_anatomical_skull))
    g.op("MatMul", g.concat([*motion.omega, *v]), g.constant(to_skull.T), name=name)


def images(g: Graph, rig: JawRig, motion: RigidMotion[Value], vectors: Array) -> Value:
    """Return homogeneous vectors (4, m) of the mandible frame in the skull frame, shape (n, 3 m), exact at d = 0."""
    to_skull = se3_inverse(rig.T_anatomical_skull)[:3, :3]
    at_rest = rig.T_anatomical_skull @ rig.T_rest @ vectors
    # entry (i, j) of [turn | t] moves vector k by to_skull[:, i] at_rest[j, k]
    matrix = np.einsum("ci,jk->ijkc", to_skull, at_rest).reshape(12, -1)
    entries = g.concat([x for row, shift in zip(motion.turn, motion.t) for x in (*row, shift)])
    return entries @ matrix + g.constant((rig.T_rest @ vectors)[:3].T.reshape(1, -1))


_GAUSS_NEWTON, _NEWTON = 12, 60  # maximum numbers of iterations
# Step length below which a row has converged; its last step is taken without another evaluation of the model.
_CONVERGED_MM = 1e-6
_START_DAMPING = 1e-6
_MIN_DAMPING = 1e-12
# Numbers of columns passed between iterations; `normal` (4, 4) holds the products of three derivatives and residual.
_LOOP_STATE = {"x": 3, "normal": 16, "trial": 3, "damping": 1}
_MATRIX, _SLOPE, _COST = [0, 1, 2, 4, 5, 6, 8, 9, 10], [3, 7, 11], [15]


def add_encoder(g: Graph, rig: JawRig, pose: Value, d: str, residual: str) -> None:
    """Add to a graph parameters `d` (n, 3) [mm] and rms landmark distances `residual` (n,) [mm] of poses (n, 4, 4)."""
    f = Graph(np.float64, "f_")
    chart = CHARTS.get(rig.kind, ParameterChart)(rig)
    at_rest = rig.T_anatomical_skull @ rig.T_rest
    vectors = at_rest @ landmark_vectors(rig.landmarks)
    flat = f.reshape(f.op("Cast", pose, to=TensorProto.DOUBLE), [-1, 16])
    f.op("MatMul", flat, f.constant(_images_of_pose(rig, vectors, at_rest)), name="target")
    incisor = np.append(rig.arrays["incisor"], 1.0)[:, None]
    u = flat @ _images_of_pose(rig, incisor, at_rest) - f.constant(incisor[:3].T)
    start = chart.start(f, u)
    unknown = np.array([[*[0.0] * 15, np.inf]])  # the start is evaluated in the first iteration
    zero = zero_column(f, start)  # propagates NaN from the pose
    some = f.op("Greater", f.op("Size", start), f.constant(0, np.int64))
    state = [start, zero + f.constant(unknown), start, zero + _START_DAMPING]
    x, normal, trial, damping = _search(f, chart, vectors, False, some, state)
    moving = _moving(f, x - trial)
    x, normal, trial, _ = _search(f, chart, vectors, True, moving, [x, normal, trial, damping])
    slope, cost = (f.op("Gather", normal, f.constant(at, np.int64), axis=1) for at in (_SLOPE, _COST))
    step = x - trial
    short = f.op("LessOrEqual", f.op("ReduceMax", f.op("Abs", step), axes=[1], keepdims=1), _CONVERGED_MM)
    step = f.op("Where", short, step, 0.0)
    last_cost = f.op("Max", cost - f.sum_columns(slope * step), 0.0)
    distance = f.op("Squeeze", f.sqrt(last_cost + cost * 0.0), f.constant([1], np.int64))
    known = chart.parameters(f, x - step + cost * 0.0)
    g.nodes += f.nodes
    g.initializers += f.initializers
    g.op("Cast", known, to=g.elem_type, name=d)
    g.op("Cast", distance, to=g.elem_type, name=residual)


def _images_of_pose(rig: JawRig, vectors: Array, at_rest: Array) -> Array:
    """Return the matrix (16, 3 k) that maps flattened poses to moved vectors (4, k), anatomical frame."""
    in_mandible = se3_inverse(at_rest) @ vectors
    # entry (i, j) of the pose moves vector k by T_anatomical_skull[:, i] in_mandible[j, k]
    matrix = np.einsum("ai,jk->ijak", rig.T_anatomical_skull[:3], in_mandible)
    return matrix.reshape(16, -1)


def _search(g: Graph, chart: Chart, vectors: Array, newton: bool, going: Value, state: list[Value]) -> list[Value]:
    """Add a loop that continues a search if `going`, and return its state."""
    prefix, iterations = ("n_", _NEWTON) if newton else ("b_", _GAUSS_NEWTON)
    names = [value.name for value in (g.constant(iterations, np.int64), going, *state)]
    outputs = [f"{g.prefix}{prefix}{name}" for name in _LOOP_STATE]
    g.nodes.append(helper.make_node("Loop", names, outputs, body=_body(prefix, chart, vectors, newton)))
    return [Value(g, name) for name in outputs]


def _body(prefix: str, chart: Chart, vectors: Array, newton: bool) -> onnx.GraphProto:
    """Return the loop body: a damped step, accepted if it reduces the cost."""
    b = Graph(np.float64, prefix)
    x, normal, trial, damping = (Value(b, f"{prefix}{name}") for name in _LOOP_STATE)
    tried = (_curved if newton else _measured)(b, chart, vectors, trial, Value(b, "target"))
    place = b.constant(_COST, np.int64)
    better = b.op("LessOrEqual", b.op("Gather", tried, place, axis=1), b.op("Gather", normal, place, axis=1))
    x = b.op("Where", better, trial, x, name=f"{prefix}x_out")
    normal = b.op("Where", better, tried, normal, name=f"{prefix}normal_out")
    reduced = b.op("Max", damping * 0.1, _MIN_DAMPING)
    amount = b.op("Where", better, reduced, damping * 10.0, name=f"{prefix}damping_out")
    matrix, slope = (b.op("Gather", normal, b.constant(at, np.int64), axis=1) for at in (_MATRIX, _SLOPE))
    # a third of the trace, on the diagonal
    diagonal = np.outer(np.eye(3).ravel(), np.eye(3).ravel()) / 3.0
    stiff = matrix + (matrix @ diagonal) * amount + b.constant(MIN_STIFFNESS * np.eye(3).reshape(1, 9))
    step = _solved(b, stiff, slope)
    b.op("Sub", x, step, name=f"{prefix}trial_out")
    _moving(b, step, name=f"{prefix}going_out")
    return loop_body(b, "step", _LOOP_STATE)


def _moving(g: Graph, step: Value, name: str | None = None) -> Value:
    """Return whether any of the steps (n, 3) [mm] is too long for convergence; comparisons with NaN are false."""
    long = g.op("Cast", g.op("Greater", g.op("Abs", step), _CONVERGED_MM), to=TensorProto.INT64)
    return g.op("Greater", g.op("ReduceSum", long, keepdims=0), g.constant(0, np.int64), name=name)


def _solved(g: Graph, matrix: Value, right: Value) -> Value:
    """Return the solutions (n, 3) of symmetric systems with matrices (n, 9) and right sides (n, 3), by cofactors."""
    cofactors = _cofactors(g, matrix)
    product = g.op("MatMul", g.reshape(cofactors, [-1, 3, 3]), g.reshape(right, [-1, 3, 1]))
    return g.reshape(product, [-1, 3]) / _determinant(matrix, cofactors)


def _cofactors(g: Graph, matrix: Value) -> Value:
    """Return the cofactors (n, 9) of matrices (n, 9)."""
    i, j = np.divmod(np.arange(9), 3)

    def entries(down: int, across: int) -> Value:
        at = 3 * ((i + down) % 3) + (j + across) % 3
        return g.op("Gather", matrix, g.constant(at, np.int64), axis=1)

    return entries(1, 1) * entries(2, 2) - entries(1, 2) * entries(2, 1)


def _determinant(matrix: Value, cofactors: Value) -> Value:
    """Return the determinants (n, 1), expanded along the first row."""
    return (matrix * cofactors) @ np.repeat([[1.0], [0.0]], [3, 6], axis=0)


def _measured(g: Graph, chart: Chart, vectors: Array, x: Value, target: Value) -> Value:
    """Return the products (n, 16) of the derivatives and the residual of the moved vectors at x (n, 3)."""
    motion = chart.motion(g, x)
    weight = vectors[3]
    # vectors relative to the reference point, which is displaced by `shift`
    turned = g.op("MatMul", motion.R, g.constant(vectors[:3] - np.outer(chart.point, weight)))
    spread = np.einsum("ia,k->iak", np.eye(3), weight).reshape(3, -1)  # a shift (3,) moves the images by (3 k,)
    at_point = motion.shift @ spread + g.constant((chart.point @ spread).reshape(1, 1, -1))
    count = len(weight)
    residual = g.reshape(turned, [-1, 1, 3 * count]) + at_point - g.reshape(target, [-1, 1, 3 * count])
    derivatives = g.reshape(moved_vectors(g, motion.w, turned), [-1, 3, 3 * count]) + motion.shift_x @ spread
    rows = g.concat([derivatives, residual])
    return g.reshape(g.op("MatMul", rows, g.op("Transpose", rows, perm=[0, 2, 1])), [-1, 16])


def _curved(g: Graph, chart: Chart, vectors: Array, x: Value, target: Value) -> Value:
    """Return `_measured` with half the Hessian, by central differences, as the matrix where it is definite."""
    around = g.reshape(g.reshape(x, [-1, 1, 3]) + g.constant(SHIFTS_MM[None]), [-1, 3])
    targets = g.reshape(g.reshape(target, [-1, 1, 12]) + g.constant(np.zeros((1, 7, 12))), [-1, 12])
    measured = g.reshape(_measured(g, chart, vectors, around, targets), [-1, 112])
    place = np.eye(112).reshape(7, 16, 112)
    slopes = place[:, _SLOPE]
    half = (slopes[1:4] - slopes[4:]) / (4.0 * STEP_MM)
    curved = np.array(place[0])
    curved[_MATRIX] = (half + half.swapaxes(0, 1)).reshape(9, 112)
    newton, plain = measured @ curved.T, measured @ place[0].T
    matrix = g.op("Gather", newton, g.constant(_MATRIX, np.int64), axis=1)
    xx, xy, _, _, yy, *_ = g.parts(matrix, 9)
    leading = g.concat([xx, xx * yy - xy * xy, _determinant(matrix, _cofactors(g, matrix))])
    definite = g.op("Greater", g.op("ReduceMin", leading, axes=[1], keepdims=1), 0.0)
    return g.op("Where", definite, newton, plain)
