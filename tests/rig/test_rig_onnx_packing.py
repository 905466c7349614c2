"""Graphs of few wide operators: they compute what numpy and the evaluator do, row by row."""

import numpy as np
import onnxruntime
import pytest
from example_model import example_arrays, example_meta
from example_rig import example_rig, touching_rig
from onnx import TensorProto, helper

from jawusd.evaluator import JawRig
from jawusd.rig.onnx_graph import Graph, Value
from jawusd.rig.onnx_packing import packed
from jawusd.rig.onnx_sidecar import decode_model
from jawusd.rig.sampling import sample_valid


def session(model):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model.SerializeToString(), options)


def many_centres(count):
    return JawRig(example_arrays(centres=count), example_meta())


RIGS = {
    "anchored": example_rig,
    "additive": lambda: example_rig("additive"),
    "anchored, touching": touching_rig,
    "additive, touching": lambda: touching_rig("additive"),
    "few centres": lambda: many_centres(20),
    "many centres": lambda: many_centres(120),
}


@pytest.mark.parametrize("name", RIGS)
def test_packed_graph_equals_the_evaluator_with_few_operators(name):
    rig = RIGS[name]()
    model = decode_model(rig, np.float64)
    assert len(model.graph.node) <= 130  # 303 for the example, 341 where teeth touch, before packing
    d = sample_valid(rig, 300, seed=8)
    pose, twist, margin = session(model).run(["pose", "twist", "margin"], {"d": d})
    np.testing.assert_allclose(pose, rig.pose(d), atol=1e-11)
    np.testing.assert_allclose(twist, rig.twist(d), atol=1e-11)
    np.testing.assert_allclose(margin, rig.margin(d), atol=1e-11)


@pytest.mark.parametrize("name", ["anchored, touching", "additive"])
def test_what_overflows_far_away_spoils_nothing_nearer(name):
    """At ten metres the series of large angles overflow in single precision; the pose does not use them there."""
    rig = RIGS[name]()
    d = (1e4 * np.random.default_rng(2).normal(size=(100, 3))).astype(np.float32)
    for found in session(decode_model(rig)).run(None, {"d": d}):
        assert np.isfinite(found).all()


def everything(g, x, table):
    """All kinds of operators that graphs of rigs have, on columns x (n, 3)."""
    a, b, c = g.parts(x, 3)
    near = g.op("Less", a, 0.25)
    chosen = g.op("Where", near, a * b, 2.0 - a / (b * b + 1.0))
    turned = g.parts(g.concat([chosen, c, g.sqrt(a * a + 1.0)]) @ [[1, 0, 2], [0, 1, 0], [3, 0, -1]], 3)
    wide = [g.constant(column[None]) for column in table.T]
    kernels = sum(((u - v) * (u - v) for u, v in zip((a, b), wide)), g.constant(0.0))
    spread = g.parts(kernels * g.sqrt(kernels) @ np.ones((len(table), 2)), 2)
    (level,) = g.lookup(c, np.array([[-1.0], [0.0], [0.5]]), [np.array([[1.0], [3.0], [-2.0], [7.0]])])
    peak = g.log_sum_exp([a * b, g.exp(c * 0.1), g.clip(b, -0.5, 0.5)])
    g.concat([*turned, *spread, level[0], peak, g.op("Sin", a) - g.op("Max", b, 0.1)], name="y")


def everything_in_numpy(x, table):
    a, b, c = x.T
    chosen = np.where(a < 0.25, a * b, 2.0 - a / (b * b + 1.0))
    root = np.sqrt(a * a + 1.0)
    spread = (((x[:, None, :2] - table) ** 2).sum(2) ** 1.5).sum(1)
    level = np.array([1.0, 3.0, -2.0, 7.0])[np.searchsorted([-1.0, 0.0, 0.5], c, side="right")]
    peak = np.log(np.exp(a * b) + np.exp(np.exp(c * 0.1)) + np.exp(np.clip(b, -0.5, 0.5)))
    columns = [chosen + 3 * root, c, 2 * chosen - root, spread, spread, level, peak, np.sin(a) - np.maximum(b, 0.1)]
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("rows", [5, 100])  # wide values are computed by themselves beyond 48 columns
def test_all_operators_that_rigs_use(rows):
    rng = np.random.default_rng(4)
    table, x = rng.normal(size=(rows, 2)), rng.normal(size=(50, 3))
    x[:3, 2] = [-1.0, 0.0, 0.5]  # on the knots
    g = Graph(np.float64)
    everything(g, Value(g, "x"), table)
    start, end = (helper.make_tensor_value_info(n, TensorProto.DOUBLE, ["N", k]) for n, k in (("x", 3), ("y", 8)))
    for graph in (g, packed(g, {"x": 3}, ["y"])):
        built = helper.make_graph(graph.nodes, "test", [start], [end], graph.initializers)
        model = helper.make_model(built, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        (y,) = session(model).run(["y"], {"x": x})
        np.testing.assert_allclose(y, everything_in_numpy(x, table), rtol=1e-12, atol=1e-12)


def test_operators_that_may_mix_rows_are_refused():
    g = Graph(np.float32)
    g.op("Softmax", Value(g, "x"), axis=0, name="y")
    with pytest.raises(NotImplementedError, match="Softmax"):
        packed(g, {"x": 3}, ["y"])
