"""The ONNX sidecars, run by onnxruntime, against the evaluator."""

import json
import pickle
import shutil
import subprocess
import sys

import numpy as np
import onnx
import onnxruntime
import pytest
from example_model import example_arrays, example_meta
from example_people import save
from example_rig import FPS, example_meshes, example_rig, mandible_vertices, moved, touching_rig
from onnx.reference import ReferenceEvaluator
from scipy.optimize import least_squares

import jawusd
from jawusd.base.errors import FormatError, RigError
from jawusd.evaluator import JawRig, Reason
from jawusd.geometry import se3_exp
from jawusd.rig import onnx_sidecar
from jawusd.rig.bake import bake_rig
from jawusd.rig.onnx_sidecar import OPSET, check_written, decode_model, encode_model, onnx_error_mm, write_onnx
from jawusd.rig.table import sample_valid


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


RIGS = {
    "anchored, touching": touching_rig,
    "additive, touching": lambda: touching_rig("additive"),
    "few centres": lambda: JawRig(example_arrays(centres=20), example_meta()),
    "many centres": lambda: JawRig(example_arrays(centres=120), example_meta()),
}


@pytest.mark.parametrize("name", RIGS)
def test_graphs_of_other_rigs_equal_the_evaluator(name):
    rig = RIGS[name]()
    d = sample_valid(rig, 300, seed=8)
    pose, twist, margin = run(rig, d, np.float64)
    np.testing.assert_allclose(pose, rig.pose(d), atol=1e-11)
    np.testing.assert_allclose(twist, rig.twist(d), atol=1e-11)
    np.testing.assert_allclose(margin, rig.margin(d), atol=1e-11)


@pytest.mark.parametrize("name", ["anchored, touching", "additive, touching"])
def test_what_overflows_far_away_spoils_nothing_nearer(name):
    """At 10 m the series of large angles overflow in single precision, where the pose does not use them."""
    d = 1e4 * np.random.default_rng(2).normal(size=(100, 3))
    for found in run(RIGS[name](), d, np.float32):
        assert np.isfinite(found).all()


@pytest.mark.parametrize("name", ["anchored, touching", "additive, touching", "many centres"])
def test_single_precision_suffices_far_from_the_bound(name):
    rig, vertices = RIGS[name](), mandible_vertices()
    d = np.random.default_rng(3).uniform(-200.0, 200.0, (500, 3)).astype(np.float32)
    (pose,) = run(rig, d, np.float32, ["pose"])
    difference = moved(pose.astype(np.float64), vertices) - moved(rig.pose(d.astype(np.float64)), vertices)
    assert np.linalg.norm(difference, axis=-1).max() < 0.05


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-7, 1e-3, 3.0])
def test_small_and_large_parameters(kind, scale):
    """Far outside the bounds too, where solvers may pass: no division by zero, no NaN."""
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


@pytest.mark.parametrize("name", RIGS)
def test_encoder_inverts_the_decoder_of_other_rigs(name):
    """A measured glide surface, and splines with few or many centres."""
    rig = RIGS[name]()
    d = sample_valid(rig, 300, seed=12)
    found, residual = search(rig, rig.pose(d), np.float64)
    np.testing.assert_allclose(found, d, atol=1e-7)
    assert residual.max() < 1e-9


def test_kinds_without_a_chart_of_their_own_are_searched_by_differences(monkeypatch):
    rig = example_rig("additive")
    d = sample_valid(rig, 100, seed=14)
    monkeypatch.setattr("jawusd.rig.onnx_encoder.CHARTS", {})
    found, residual = search(rig, rig.pose(d), np.float64)
    np.testing.assert_allclose(found, d, atol=1e-6)
    assert residual.max() < 1e-6


def test_one_pose_far_from_the_model_does_not_change_the_others(kind):
    """The second loop runs for all rows if one has not converged."""
    rig = example_rig(kind)
    d = sample_valid(rig, 50, seed=13)
    T = rig.pose(d)
    far = se3_exp([0.3, -0.3, 0.2, 20.0, -15.0, 10.0]) @ T[:1]
    (alone, _), (found, residual) = search(rig, far, np.float64), search(rig, np.concatenate([T, far]), np.float64)
    assert residual[-1] > 5.0
    np.testing.assert_allclose(found[:-1], d, atol=1e-7)
    np.testing.assert_allclose(found[-1:], alone, atol=1e-6)


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


def test_encoder_finds_the_bottom_for_poses_far_from_the_model(kind):
    """Gauss-Newton alone is slow there; scipy finds no better d around the result."""
    rig = example_rig(kind)
    rng = np.random.default_rng(10)
    noise = se3_exp(rng.normal(size=(40, 6)) * [0.1, 0.1, 0.1, 6.0, 6.0, 6.0])
    T = noise @ rig.pose(sample_valid(rig, 40, seed=11))
    found, residual = search(rig, T, np.float64)
    assert np.median(residual) > 5.0
    landmarks = np.column_stack([rig.landmarks, np.ones(len(rig.landmarks))])
    for start, pose, distance in zip(found, T, residual):

        def offsets(d, pose=pose):
            return ((rig.pose(d) - pose)[:3] @ landmarks.T).ravel() / np.sqrt(len(landmarks))

        best = least_squares(offsets, start, x_scale=5.0, xtol=1e-15, ftol=1e-15, gtol=1e-12)
        assert np.linalg.norm(offsets(start)) == pytest.approx(distance, abs=1e-6)
        assert distance - np.linalg.norm(best.fun) < 1e-6
        np.testing.assert_allclose(start, best.x, atol=5e-3)


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
    assert properties["rig_hash"] == rig.model_hash
    assert (properties["length_unit"], properties["angle_unit"]) == ("mm", "rad")
    assert (properties["twist_order"], properties["kind"]) == ("omega v", kind)
    assert model.opset_import[0].version == OPSET
    assert [entry.name for entry in model.graph.output] == ["pose", "twist", "margin"]
    assert path.stat().st_size < 100_000
    arrays = json.loads(properties["arrays"])
    assert arrays["landmarks"] == rig.landmarks.tolist() and arrays["tolerance_mm"] == rig.tolerance_mm
    assert arrays["residual_limit_mm"] == rig.limits.residual_mm


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


@pytest.mark.parametrize("installed", [True, False])
def test_what_was_written_is_checked_by_either_runtime(kind, tmp_path, monkeypatch, installed):
    rig, used = example_rig(kind), []
    monkeypatch.setattr(onnx_sidecar, "ReferenceEvaluator", lambda model: used.append(1) or ReferenceEvaluator(model))
    if not installed:
        monkeypatch.setitem(sys.modules, "onnxruntime", None)
    path = write_onnx(tmp_path / "actor.onnx", decode_model(rig))
    check_written(path, rig)
    assert bool(used) != installed
    model = decode_model(rig)
    bite = rig.T_rest[:3].T.reshape(1, 12).astype(np.float32)
    (weights,) = [x for x in model.graph.initializer if np.array_equal(onnx.numpy_helper.to_array(x), bite)]
    bite[0, 9] += 0.02  # mm, to the left
    weights.CopyFrom(onnx.numpy_helper.from_array(bite, weights.name))
    write_onnx(path, model)
    with pytest.raises(RigError, match=r"actor.onnx: is 0\.020 mm from the model; the maximum is 0.01 mm"):
        check_written(path, rig)


def test_weights_in_other_files_are_not_read(tmp_path, monkeypatch):
    rig = example_rig()
    model = decode_model(rig)
    weights = model.graph.initializer[0]
    weights.data_location = onnx.TensorProto.EXTERNAL
    weights.ClearField("raw_data")
    entry = weights.external_data.add()
    entry.key, entry.value = "location", "weights.bin"
    (tmp_path / "weights.bin").write_bytes(bytes(1000))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FormatError, match="not a valid ONNX file"):
        onnx_error_mm(write_onnx(tmp_path / "actor.onnx", model), rig, sample_valid(rig, 5))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a baked example rig."""
    made = tmp_path_factory.mktemp("actor")
    bake_rig(made, example_rig(), example_meshes(), name="x", fps=FPS, table_size=17)
    return made


def outside_and_inside(rig):
    """Return parameters everywhere and far outside the bound."""
    low, high = rig.d_range.T
    return np.random.default_rng(5).uniform(low - 5, high + 5, (300, 3))


def test_a_rig_of_its_onnx_file_poses_and_judges(folder):
    rig, exact = jawusd.load(folder / "actor.onnx"), example_rig()
    d = outside_and_inside(exact)
    vertices = mandible_vertices()
    assert np.linalg.norm(moved(rig.pose(d), vertices) - moved(exact.pose(d), vertices), axis=-1).max() < 0.01
    assert np.abs(rig.pose(d) - exact.pose(d)).max() > 0  # single precision: the graph has computed it
    np.testing.assert_allclose(rig.twist(d), exact.twist(d), atol=1e-3)
    np.testing.assert_allclose(rig.margin(d), exact.margin(d), atol=1e-4)
    T = exact.pose(d)
    for found, wanted in zip(
        (rig.validate(T), rig.validate_parameters(d)), (exact.validate(T), exact.validate_parameters(d))
    ):
        np.testing.assert_array_equal(found.valid, wanted.valid)
        np.testing.assert_array_equal(found.reason, wanted.reason)
    np.testing.assert_allclose(rig.encode(T).d, d, atol=1e-3)
    assert rig.is_inside(rig.project(d)).all()  # including the bound
    for single in d[:5]:
        np.testing.assert_allclose(rig.pose(single), exact.pose(single), atol=1e-3)
        assert rig.is_inside(single) == exact.is_inside(single)
    assert np.isnan(rig.pose([[np.nan, 0, 0], [1e12, 0, 0]])[:, :3]).any() and np.isnan(rig.margin([np.inf, 0, 0]))
    again = pickle.loads(pickle.dumps(rig))
    np.testing.assert_array_equal(again.pose(d), rig.pose(d))


def old(model):
    """Return a graph as older versions wrote it, without the rig in its metadata."""
    kept = {entry.key: entry.value for entry in model.metadata_props if entry.key not in ("arrays", "header")}
    onnx.helper.set_model_props(model, kept)
    return model


@pytest.mark.parametrize("name", ["anchored, touching", "additive, touching"])
def test_the_onnx_file_alone_judges_as_its_rig(name, tmp_path):
    touching = RIGS[name]()
    deeper = {"contact_values": touching.arrays["contact_values"] - 100.0}  # by 1 mm, so that teeth collide
    exact = JawRig({**touching.arrays, **deeper}, touching.meta)
    write_onnx(tmp_path / "actor.onnx", decode_model(exact))
    rig = jawusd.load(tmp_path / "actor.onnx")
    assert rig.model_hash == exact.model_hash and rig.meta == exact.meta
    rng = np.random.default_rng(3)
    d = rng.uniform(*(exact.d_range + [-5.0, 5.0]).T, (20_000, 3))
    collide = exact.clearance(d).clearance_mm < exact.contact.limit_mm - 0.05
    d = np.concatenate([d[:300], d[collide & (exact.margin(d) > 0.2)][:100]])
    T = se3_exp(rng.normal(size=(len(d), 6)) * [0.003, 0.003, 0.003, 0.2, 0.2, 0.2]) @ exact.pose(d)
    pairs = ((rig.validate(T), exact.validate(T)), (rig.validate_parameters(d), exact.validate_parameters(d)))
    for found, wanted in pairs:
        np.testing.assert_array_equal(found.reason, wanted.reason)
        assert {int(flag) for flag in Reason if flag and (wanted.reason & flag).any()} >= {8, 32}
    np.testing.assert_allclose(rig.pose(d), exact.pose(d), atol=1e-2)
    np.testing.assert_array_equal(rig.clearance(d).clearance_mm, exact.clearance(d).clearance_mm)


def test_a_damaged_rig_in_the_metadata_is_rejected(tmp_path):
    model = decode_model(example_rig())
    kept = {entry.key: entry.value for entry in model.metadata_props}
    other = json.dumps({**json.loads(kept["arrays"]), "tolerance_mm": 0.5})
    path = tmp_path / "actor.onnx"
    for arrays, message in (
        ("[" * 100_000, "no usable rig"),
        ("[]", "no usable rig"),
        ("{}", "no usable rig"),
        ('{"landmarks": [[1], "a"]}', "no usable rig"),
        (other, "another model"),
    ):
        onnx.helper.set_model_props(model, {**kept, "arrays": arrays})
        write_onnx(path, model)
        with pytest.raises(FormatError, match=message):
            jawusd.load(path)


def test_a_model_beside_an_older_onnx_file_will_do_and_encoding_falls_back(tmp_path):
    write_onnx(tmp_path / "actor.onnx", old(decode_model(example_rig())))
    with pytest.raises(FormatError, match=r"neither actor.usda nor model.npz"):
        jawusd.load(tmp_path / "actor.onnx")
    save(example_rig(), tmp_path / "model.npz")
    rig = jawusd.load(tmp_path / "actor.onnx")
    np.testing.assert_allclose(rig.pose([20.0, 1, 0.5]), example_rig().pose([20.0, 1, 0.5]), atol=1e-3)
    np.testing.assert_allclose(rig.encode(example_rig().pose([20.0, 1, 0.5])).d, [20, 1, 0.5], atol=1e-8)


def test_onnx_files_that_cannot_pose_are_refused(folder, tmp_path):
    (copied := tmp_path / "actor").mkdir()
    save(example_rig(), copied / "model.npz")
    for name, make, message in (
        ("encode.onnx", lambda: (folder / "actor_encode.onnx").read_bytes(), "is an encoder"),
        ("other.onnx", lambda: old(decode_model(example_rig("additive"))).SerializeToString(), "another model"),
        ("cut.onnx", lambda: (folder / "actor.onnx").read_bytes()[:5000], "not a valid ONNX file"),
    ):
        (copied / name).write_bytes(make())
        with pytest.raises(FormatError, match=message):
            jawusd.load(copied / name)
    with pytest.raises(FormatError, match="cannot be read|no such file"):
        jawusd.load(copied / "missing.onnx")
    for option in ("fast", "untrusted"):
        with pytest.raises(ValueError, match="onnxruntime"):
            jawusd.load(folder / "actor.onnx", **{option: True})


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
def test_nothing_is_sent_anywhere(anchored_folder, tmp_path):
    """Onnxruntime 1.31 contacts a telemetry server about ten seconds after it is loaded."""
    code = "import sys, time; from jawusd.rig import validate_stage; validate_stage(sys.argv[1]); time.sleep(15)"
    log = tmp_path / "calls"
    line = ["strace", "-f", "-qq", "-e", "trace=connect", "-o", log, sys.executable, "-c", code]
    subprocess.run([*line, anchored_folder / "actor.usda"], check=True)
    assert "connect(" not in log.read_text()
