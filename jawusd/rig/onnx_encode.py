"""The encoder as an ONNX loop: damped Gauss-Newton from the nearest of many starts.

The distance of two poses is that of `jawusd.evaluator.encoding`: four homogeneous vectors stand for all landmarks.
"""

from __future__ import annotations

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper

from jawusd.evaluator import JawRig
from jawusd.evaluator.encoding import landmark_vectors
from jawusd.rig.onnx_graph import Graph
from jawusd.rig.onnx_model import decode_motion
from jawusd.rig.sampling import valid_box

_ITERATIONS = 30
_SETTLED_MM = 1e-7  # a row is done when its step is shorter; the loop ends when all are
_STARTS = (19, 11, 11)
_WIDER_MM = 3.0  # poses a little outside the bounds find a start as well
_STEP_MM = 1e-3  # of the central differences
_START_DAMPING = 1e-6
_SMALLEST_DAMPING = 1e-12


def add_encoder(g: Graph, rig: JawRig, pose: str, d: str, residual: str) -> None:
    """Add the search to a graph.

    Args:
        g: the graph, of the type of inputs and outputs.
        rig: the exact model.
        pose: name of the poses (n, 4, 4).
        d: name of the output: parameters (n, 3) [mm].
        residual: name of the output: rms landmark distances (n,) [mm].
    """
    f = Graph(np.dtype(np.float64), "f_")
    vectors = landmark_vectors(rig.arrays["landmarks"])
    wide = f.op("Cast", pose, to=TensorProto.DOUBLE)
    target = f.matmul(f.op("Reshape", wide, f.constant([-1, 16], np.int64)), _images_of_matrix(vectors))
    target = f.op("Identity", target, name="target")
    start, cost = _nearest_start(f, rig, vectors, target)
    damping = f.add(f.mul(cost, 0.0), _START_DAMPING)
    trips = f.constant(_ITERATIONS, np.int64)
    going = f.constant(True, np.bool_)
    found = ["f_d", "f_cost", "f_damping"]
    f.nodes.append(helper.make_node("Loop", [trips, going, start, cost, damping], found, body=_body(rig, vectors)))
    # a NaN in the pose is in its cost, not in its start
    settled = f.add("f_d", f.mul("f_cost", 0.0))
    distance = f.op("Squeeze", f.op("Sqrt", "f_cost"), f.constant([1], np.int64))
    g.nodes += f.nodes
    g.initializers += f.initializers
    g.op("Cast", settled, to=g.elem_type, name=d)
    g.op("Cast", distance, to=g.elem_type, name=residual)


def _images_of_matrix(vectors: NDArray) -> NDArray:
    """Return the matrix (16, 12) that takes a flat pose to the images of the four vectors, vector by vector."""
    matrix = np.zeros((4, 4, 4, 3))
    for row in range(3):
        matrix[row, :, :, row] = vectors
    return matrix.reshape(16, 12)


def _images(g: Graph, rig: JawRig, vectors: NDArray, d: str) -> str:
    """Return the images (n, 12) of the four vectors under the poses of d (n, 3)."""
    motion = decode_motion(g, rig, d)
    at_rest = rig.arrays["T_rest"] @ vectors
    return g.concat(*(motion.carry(g, column[:3], moves=bool(column[3] != 0)) for column in at_rest.T))


def _nearest_start(g: Graph, rig: JawRig, vectors: NDArray, target: str) -> tuple[str, str]:
    """Return the grid point (n, 3) whose images are nearest to the target, and its squared distance (n, 1)."""
    box = valid_box(rig) + np.array([-_WIDER_MM, _WIDER_MM])
    axes = [np.linspace(*row, count) for row, count in zip(box, _STARTS, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    images = np.swapaxes((rig.pose(grid) @ vectors)[:, :3], 1, 2).reshape(-1, 12)
    # |a - b|^2 without the |a|^2 that all candidates share
    distance = g.sub(g.constant((images**2).sum(axis=1)[None]), g.mul(g.matmul(target, images.T), 2.0))
    nearest = g.op("ArgMin", distance, axis=1, keepdims=0)
    start = g.op("Gather", g.constant(grid), nearest, axis=0)
    return start, _cost(g, g.sub(_images(g, rig, vectors, start), target))


def _body(rig: JawRig, vectors: NDArray) -> onnx.GraphProto:
    """Return the body of the loop: one damped Gauss-Newton step (Levenberg 1944, Marquardt 1963), kept if better."""
    b = Graph(np.dtype(np.float64), "b_")
    shifts = _STEP_MM * np.concatenate([np.eye(3), -np.eye(3)])
    around = b.concat(*(b.add("b_d", b.constant(shift[None])) for shift in shifts), axis=0)
    images = b.split(_images(b, rig, vectors, around), 6, axis=0)
    J = [b.mul(b.sub(ahead, behind), 0.5 / _STEP_MM) for ahead, behind in zip(images[:3], images[3:], strict=True)]
    r = b.sub(_images(b, rig, vectors, "b_d"), "target")
    step = _damped_step(b, J, r, "b_damping")
    trial = b.sub("b_d", step)
    trial_cost = _cost(b, b.sub(_images(b, rig, vectors, trial), "target"))
    better = b.op("LessOrEqual", trial_cost, "b_cost")
    b.op("Where", better, trial, "b_d", name="b_d_out")
    b.op("Where", better, trial_cost, "b_cost", name="b_cost_out")
    calmer = b.op("Max", b.mul("b_damping", 0.1), _SMALLEST_DAMPING)
    b.op("Where", better, calmer, b.mul("b_damping", 10.0), name="b_damping_out")
    # a NaN is never longer than anything, so lost rows do not keep the loop going
    long = b.op("Greater", b.op("Abs", step), _SETTLED_MM)
    moving = b.op("ReduceSum", b.op("Cast", long, to=TensorProto.INT64), keepdims=0)
    b.op("Greater", moving, b.constant(0, np.int64), name="b_going_out")
    number, flag = TensorProto.DOUBLE, TensorProto.BOOL

    def carried(suffix: str) -> list[onnx.ValueInfoProto]:
        widths = {"d": 3, "cost": 1, "damping": 1}
        return [helper.make_tensor_value_info(f"b_{n}{suffix}", number, ["N", k]) for n, k in widths.items()]

    counter = helper.make_tensor_value_info("b_count", TensorProto.INT64, [])
    inputs = [counter, helper.make_tensor_value_info("b_going", flag, []), *carried("")]
    outputs = [helper.make_tensor_value_info("b_going_out", flag, []), *carried("_out")]
    return helper.make_graph(b.nodes, "step", inputs, outputs, b.initializers)


def _damped_step(g: Graph, J: list[str], r: str, damping: str) -> str:
    """Return (J^T J + damping tr/3)^-1 J^T r by Cramer's rule, shape (n, 3), for three columns J (n, 12) each."""
    products = {(i, j): g.sum_rows(g.mul(J[i], J[j])) for i in range(3) for j in range(i, 3)}
    trace = g.add(products[0, 0], products[1, 1], products[2, 2])
    extra = g.mul(trace, damping, 1.0 / 3.0)
    for i in range(3):
        products[i, i] = g.add(products[i, i], extra)
    columns = [g.concat(*(products[min(i, j), max(i, j)] for i in range(3))) for j in range(3)]
    gradient = g.concat(*(g.sum_rows(g.mul(column, r)) for column in J))
    minors = [g.cross(columns[(j + 1) % 3], columns[(j + 2) % 3]) for j in range(3)]
    determinant = g.sum_rows(g.mul(columns[0], minors[0]))
    return g.div(g.concat(*(g.sum_rows(g.mul(gradient, minor)) for minor in minors)), determinant)


def _cost(g: Graph, r: str) -> str:
    return g.sum_rows(g.mul(r, r))
