"""The ONNX sidecar against the evaluator, run by onnxruntime."""

import numpy as np
import onnx
import onnxruntime
import pytest
from example_rig import example_rig, mandible_vertices, moved

from jawusd.errors import FormatError
from jawusd.geometry import se3_exp
from jawusd.rig.arrays import model_hash
from jawusd.rig.onnx_check import onnx_error_mm
from jawusd.rig.onnx_sidecar import OPSET, decode_model, encode_model, write_onnx
from jawusd.rig.sampling import sample_valid


def run(rig, d, dtype, outputs=("pose", "twist", "margin")):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(decode_model(rig, dtype).SerializeToString(), options)
    return session.run(list(outputs), {"d": np.asarray(d, dtype=dtype)})


@pytest.mark.parametrize(("dtype", "pose_mm", "relative"), [(np.float32, 0.01, 2e-5), (np.float64, 1e-9, 1e-11)])
def test_graph_equals_the_evaluator(kind, dtype, pose_mm, relative):
    rig, vertices = example_rig(kind), mandible_vertices()
    d = sample_valid(rig, 1000, seed=4).astype(dtype)
    pose, twist, margin = run(rig, d, dtype)
    assert (pose.shape, twist.shape, margin.shape) == ((1000, 4, 4), (1000, 6), (1000,))
    exact = d.astype(np.float64)
    difference = moved(pose.astype(np.float64), vertices) - moved(rig.pose(exact), vertices)
    assert np.linalg.norm(difference, axis=-1).max() < pose_mm
    np.testing.assert_allclose(twist, rig.twist(exact), atol=60 * relative)
    np.testing.assert_allclose(margin, rig.margin(exact), atol=60 * relative)


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-7, 1e-3, 3.0])
def test_small_and_large_parameters(kind, scale):
    """Far outside the bounds too: a solver passes there, and nothing may divide by zero or turn to NaN."""
    rig = example_rig(kind)
    d = scale * np.random.default_rng(1).normal(size=(50, 3)) * [14, 4, 3]
    pose, twist, margin = run(rig, d, np.float64)
    np.testing.assert_allclose(pose, rig.pose(d), atol=1e-9)
    np.testing.assert_allclose(twist, rig.twist(d), atol=1e-9)
    np.testing.assert_allclose(margin, rig.margin(d), atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 7])
def test_any_batch_size(kind, count):
    pose, twist, margin = run(example_rig(kind), np.zeros((count, 3)), np.float32)
    assert (len(pose), len(twist), len(margin)) == (count, count, count)
    if count:
        np.testing.assert_allclose(pose[0], example_rig(kind).arrays["T_rest"], atol=1e-5)


def test_a_nan_row_stays_in_its_row(kind):
    (pose,) = run(example_rig(kind), [[5, 0, 0], [np.nan, 0, 0], [5, 0, 0]], np.float32, ["pose"])
    assert np.isnan(pose[1, :3]).any() and np.isfinite(pose[[0, 2]]).all()
    np.testing.assert_array_equal(pose[0], pose[2])


def search(rig, T, dtype):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL  # loads ten times faster
    session = onnxruntime.InferenceSession(encode_model(rig, dtype).SerializeToString(), options)
    return session.run(["d", "residual"], {"pose": np.asarray(T, dtype=dtype)})


@pytest.mark.parametrize(("dtype", "tolerance_mm"), [(np.float32, 2e-5), (np.float64, 1e-9)])
def test_encoder_inverts_the_decoder(kind, dtype, tolerance_mm):
    rig = example_rig(kind)
    d = sample_valid(rig, 500, seed=6)
    found, residual = search(rig, rig.pose(d), dtype)
    assert (found.shape, residual.shape) == ((500, 3), (500,))
    np.testing.assert_allclose(found, d, atol=tolerance_mm)
    assert residual.max() < tolerance_mm


def test_encoder_finds_what_the_evaluator_finds_for_noisy_poses(kind):
    rig = example_rig(kind)
    rng = np.random.default_rng(9)
    noise = se3_exp(rng.normal(size=(200, 6)) * [0.01, 0.01, 0.01, 0.5, 0.5, 0.5])
    T = noise @ rig.pose(sample_valid(rig, 200, seed=7))
    expected, distance = rig.encode(T)
    assert np.median(distance) > 0.5
    found, residual = search(rig, T, np.float64)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(residual, distance, atol=1e-9)


def test_encoder_keeps_nan_in_its_row_and_takes_empty_batches(kind):
    rig = example_rig(kind)
    T = rig.pose([[10, 1, 0.5], [0, 0, 0], [20, 0, 0]])
    T[1, 2, 3] = np.nan
    found, residual = search(rig, T, np.float64)
    assert np.isnan(found[1]).all() and np.isnan(residual[1])
    np.testing.assert_allclose(found[[0, 2]], [[10, 1, 0.5], [20, 0, 0]], atol=1e-9)
    found, residual = search(rig, np.zeros((0, 4, 4)), np.float32)
    assert (found.shape, residual.shape) == ((0, 3), (0,))


def test_file_says_what_it_is(kind, tmp_path):
    rig = example_rig(kind)
    path = write_onnx(tmp_path / "actor.onnx", decode_model(rig))
    model = onnx.load(path)
    properties = {entry.key: entry.value for entry in model.metadata_props}
    assert properties["rig_hash"] == model_hash(rig)
    assert (properties["length_unit"], properties["angle_unit"]) == ("mm", "rad")
    assert (properties["twist_order"], properties["kind"]) == ("omega v", kind)
    assert model.opset_import[0].version == OPSET
    assert [entry.name for entry in model.graph.output] == ["pose", "twist", "margin"]
    assert path.stat().st_size < 100_000


def test_check_measures_the_distance_and_refuses_other_files(kind, tmp_path):
    rig = example_rig(kind)
    d = sample_valid(rig, 50)
    path = write_onnx(tmp_path / "actor.onnx", decode_model(rig))
    assert onnx_error_mm(path, rig, d) < 1e-3
    other = example_rig("additive" if kind == "anchored" else "anchored")
    with pytest.raises(FormatError, match="another model"):
        onnx_error_mm(path, other, d)
    path.write_bytes(b"no graph")
    with pytest.raises(FormatError, match="not a valid ONNX file"):
        onnx_error_mm(path, rig, d)
    model = decode_model(rig)
    del model.metadata_props[:]
    onnx.save(model, path)
    with pytest.raises(FormatError, match="jawusd-onnx/1"):
        onnx_error_mm(path, rig, d)
