"""One bound: all tests for inside agree on margin >= 0, for 5,000 parameters in and around the bound.

The oracle is the definition of the bound, with scipy; points nearer to it than 1e-6 mm may fall to either side. The rig
has a tolerance of 1 mm for measured poses, which only the verdicts on measured poses may use.
"""

import importlib
import json
import re
import sys
import types
import zipfile

import numpy as np
import onnxruntime
import pytest
import torch
from example_model import example_arrays, example_meta, touching_arrays
from example_rig import FPS, example_meshes, example_motion
from example_tracks import make_tracks
from pxr import Usd
from report_data import report_data
from scipy.interpolate import CubicHermiteSpline
from scipy.special import logsumexp
from typer.testing import CliRunner

import jawusd
from jawusd.cli.main import app
from jawusd.evaluator import JawRig
from jawusd.evaluator.__main__ import main as evaluator_main
from jawusd.formats.model import JawModel, save_model
from jawusd.formats.performance import SolvedJaw, SolveState
from jawusd.formats.poses import write_parameters, write_poses
from jawusd.media.side_by_side import StatusBar
from jawusd.pipeline.library import retarget
from jawusd.plugins import extension
from jawusd.report.solve_page import observation_figure
from jawusd.report.verdicts import judge
from jawusd.rig import load_rig
from jawusd.rig.animation import write_animation
from jawusd.rig.bake import bake_rig
from jawusd.rig.onnx_sidecar import decode_model
from jawusd.rig.rules import RULES
from jawusd.solvers import JawLayer
from jawusd.viewer.plots import solve_html
from jawusd.viewer.pose_panel import verdict_html
from jawusd.viewer.readouts import measure_pose
from jawusd.viewer.session import Session

COUNT, TOLERANCE_MM, UNDECIDED_MM = 5000, 1.0, 1e-6
ARRAYS = example_arrays() | {"tolerance_mm": np.array(TOLERANCE_MM)}
RIG = JawRig(ARRAYS, example_meta())


def oracle_margin(d):
    """The margin from its definition: supports by scipy's Hermite spline, combined by scipy's soft maximum."""
    knots, support = ARRAYS["slice_d1"], ARRAYS["slice_support"]
    slopes = np.zeros_like(support)
    slopes[1:-1] = (support[2:] - support[:-2]) / (knots[2:] - knots[:-2])[:, None]
    reach = CubicHermiteSpline(knots, support, slopes)(np.clip(d[:, 0], knots[0], knots[-1]))
    ends = np.stack([knots[0] - d[:, 0], d[:, 0] - knots[-1]], axis=1)
    v = np.concatenate([d[:, 1:] @ ARRAYS["slice_directions"].T - reach, ends], axis=1)
    soft = ARRAYS["slice_softness_mm"]
    return ARRAYS["slice_margin_mm"] - soft * logsumexp(v / soft, axis=1)


def in_and_around():
    """Random parameters, and as many moved along the gradient to margins from 1e-5 to 2 mm on either side."""
    rng = np.random.default_rng(0)
    d = rng.uniform([-3, -11, -3], [46, 12, 9], (COUNT, 3))
    near, wanted = d[COUNT // 2 :], rng.choice([-1, 1], COUNT // 2) * 10 ** rng.uniform(-5, np.log10(2), COUNT // 2)
    for _ in range(8):
        h = 1e-6
        rises = [oracle_margin(near + h * e) - oracle_margin(near - h * e) for e in np.eye(3)]
        gradient = np.stack(rises, axis=1) / (2 * h)
        near += ((wanted - oracle_margin(near)) / (gradient**2).sum(1))[:, None] * gradient
    return d


D = in_and_around()
MARGIN = oracle_margin(D)
DECIDED = np.abs(MARGIN) > UNDECIDED_MM
INSIDE = MARGIN > 0


def disagreements(inside):
    return int((np.asarray(inside)[DECIDED] != INSIDE[DECIDED]).sum())


def words_of_measured(margin):
    """The expected verdict on a measured pose."""
    if margin >= 0:
        return "inside"
    return f"within tolerance {-margin:.2f} of 1.00 mm" if margin >= -TOLERANCE_MM else "outside"


@pytest.fixture(scope="module")
def actor(tmp_path_factory):
    folder = tmp_path_factory.mktemp("actor")
    frames, d = example_motion()
    bake_rig(folder, RIG, example_meshes(), name="someone", fps=FPS, frames=frames, d=d, table_size=17)
    return folder / "actor.usda"


def run(*arguments, codes=(0,)):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code in codes, result.output
    return result.stdout


def test_the_sample_is_on_both_sides_and_near():
    assert 0.2 < INSIDE.mean() < 0.8 and DECIDED.all()
    assert ((MARGIN < 0) & (MARGIN > -TOLERANCE_MM)).sum() > 500 and (np.abs(MARGIN) < 1e-3).sum() > 300


def test_functions():
    assert disagreements(RIG.is_inside(D)) == 0
    assert disagreements(RIG.margin(D) >= 0) == 0
    assert disagreements([RIG.is_inside(d) for d in D]) == 0  # one at a time: another code path
    authored = RIG.validate_parameters(D)
    assert disagreements(authored.valid) == 0
    assert disagreements([words == "inside" for words in authored.words()]) == 0
    assert disagreements((RIG.project(D) == D).all(axis=1)) == 0
    moved = RIG.project(D)
    assert RIG.is_inside(moved).all()


def test_verdicts_on_measured_poses_name_the_tolerance():
    measured = RIG.validate_parameters(D, tolerance_mm=RIG.tolerance_mm)
    assert disagreements(measured.inside()) == 0
    assert measured.words() == [words_of_measured(margin) for margin in MARGIN]
    np.testing.assert_array_equal(measured.valid, MARGIN >= -TOLERANCE_MM)
    d = D[::5]
    verdicts, strict = RIG.validate(RIG.pose(d)), RIG.validate(RIG.pose(d), tolerance_mm=0.0)
    nearest = oracle_margin(verdicts.d)  # far outside, another d may have nearly the same pose
    on_model = verdicts.residual_mm < 1e-6
    sure = on_model & (np.abs(nearest) > UNDECIDED_MM) & (np.abs(nearest + TOLERANCE_MM) > UNDECIDED_MM)
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(verdicts.inside()[sure], nearest[sure] > 0)
    np.testing.assert_array_equal(strict.valid[sure], nearest[sure] > 0)
    said = np.array(verdicts.words())[sure]
    assert said.tolist() == [words_of_measured(margin) for margin in nearest[sure]]


def test_authoring_never_leaves_the_bound():
    rng = np.random.default_rng(1)
    target = RIG.landmarks[0] + rng.uniform(-25, 25, (200, 3))
    assert RIG.is_inside(RIG.ik(RIG.landmarks[0], target).d).all()
    assert RIG.is_inside(RIG.encode(RIG.pose(D[:300]), inside=True).d).all()
    slower = JawRig(ARRAYS | {"slice_support": ARRAYS["slice_support"] * 0.7}, example_meta())
    frames = np.arange(300.0)
    source = RIG.project(np.stack([18 + 17 * np.sin(frames / 9), 8 * np.sin(frames / 5), 4 * np.cos(frames / 7)], 1))
    carried = retarget(RIG, slower, frames, source)
    assert slower.is_inside(carried.d).all()
    np.testing.assert_array_equal(carried.outside, ~slower.is_inside(slower.denormalized(RIG.normalized(source))))


def test_commands(actor, tmp_path):
    write_parameters(tmp_path / "d.csv", np.arange(COUNT), D)
    strict = json.loads(run("validate", actor, tmp_path / "d.csv", "--tolerance-mm", 0, "--json", codes=(1,)))
    near = MARGIN > -3  # farther out, another d may have the same pose
    said = np.array([row["reason"] == "inside" for row in strict["verdicts"]])
    np.testing.assert_array_equal(said[near], INSIDE[near])
    measured = json.loads(run("validate", actor, tmp_path / "d.csv", "--json", codes=(1,)))
    assert measured["tolerance_mm"] == TOLERANCE_MM
    said = [row["reason"] for row in measured["verdicts"]]
    assert [said[i] for i in np.flatnonzero(near)] == [words_of_measured(margin) for margin in MARGIN[near]]
    assert measured["inside"] == sum(words == "inside" for words in said)
    assert measured["within_tolerance"] == sum(words.startswith("within tolerance") for words in said)
    edge = np.argsort(np.abs(MARGIN))[:4]
    for d, inside in zip(D[edge], INSIDE[edge]):
        told = json.loads(run("pose", actor, "--json", "--d", *d))
        assert told["valid"] == inside
        assert ("inside the bound" if inside else "OUTSIDE the bound") in run("pose", actor, "--d", *d)
    assert "tolerance 1.00 mm outside the bound" in run("info", actor)


def test_collisions_are_told_apart_from_the_bound(tmp_path):
    deep = {**touching_arrays(), "contact_values": np.full(7 * 9 * 6, -25.0)}  # 0.25 mm, measured poses may by 0.3 mm
    rig = JawRig({**ARRAYS, **deep}, example_meta())
    bake_rig(tmp_path, rig, example_meshes(), name="someone", fps=FPS, table_size=17)
    actor, table = tmp_path / "actor.usda", tmp_path / "d.csv"
    told = json.loads(run("pose", actor, "--json", "--d", 5, 0, 0.5))
    assert not told["valid"] and told["margin_mm"] > 0 and told["clearance_mm"] == pytest.approx(-0.25)
    said = run("pose", actor, "--d", 5, 0, 0.5)
    assert "clearance -0.250 mm: teeth COLLIDE" in said and "inside the bound" in said
    write_parameters(table, np.arange(1), np.array([[5.0, 0.0, 0.5]]))
    assert "1 inside" in run("validate", actor, table)
    assert "teeth collide" in run("validate", actor, table, "--tolerance-mm", 0, codes=(1,))


def test_command_with_numpy_alone(tmp_path, capsys):
    none = np.zeros(0)
    captured = (none.astype(np.int64), np.zeros((0, 3)), none, none.astype(bool))
    save_model(tmp_path / "model.npz", JawModel(dict(ARRAYS), *captured, example_meta()))
    near = np.flatnonzero(MARGIN > -3)[:1000]
    write_poses(tmp_path / "poses.csv", np.arange(len(near)), RIG.pose(D[near]))
    assert evaluator_main(["validate", str(tmp_path / "model.npz"), str(tmp_path / "poses.csv"), "--json"]) == 1
    rows = json.loads(capsys.readouterr().out)
    decided = np.abs(MARGIN[near]) > 1e-4  # poses in CSV are rounded
    assert [row["reason"] for row, sure in zip(rows, decided) if sure] == [
        words_of_measured(margin) for margin, sure in zip(MARGIN[near], decided) if sure
    ]
    assert evaluator_main(["info", str(tmp_path / "model.npz")]) == 0
    assert "tolerance_mm: 1.0" in capsys.readouterr().out


def test_viewer():
    readouts = [measure_pose(RIG, d) for d in D]
    assert disagreements([readout.inside for readout in readouts]) == 0
    pages = [verdict_html(readout) for readout in readouts]
    assert disagreements(["inside the bound" in page and "OUTSIDE" not in page for page in pages]) == 0
    session = Session(RIG, FPS)
    session.set_keep_valid(False)
    kept = []
    for d in D[:1000]:
        session.set_pose(d)
        session.set_keep_valid(True)  # moves only parameters outside
        kept.append(session.work.d == tuple(d))
        session.set_keep_valid(False)
    np.testing.assert_array_equal(kept, INSIDE[:1000])


def test_solved_takes_in_viewer_and_report():
    count = 400
    margin = MARGIN[:count]
    tracks = make_tracks(count)
    valid = RIG.validate_parameters(D[:count], tolerance_mm=TOLERANCE_MM).valid
    state = np.full(count, SolveState.SOLVED, np.int8)
    tracks.solved = SolvedJaw(D[:count], np.ones((count, 3)), margin, state, valid)
    tracks.meta["tolerance_mm"] = TOLERANCE_MM
    for row, frame in enumerate(tracks.frames):
        text = solve_html(tracks, tracks.solved, int(frame))
        assert f"bound: {words_of_measured(margin[row])}, margin {margin[row]:.2f} mm" in text
        assert ("invalid for the rig" in text) == (margin[row] < -TOLERANCE_MM)

    bar = StatusBar(tracks, FPS, 1600)
    said = [" ".join(text for text, *_ in bar._said(row)) for row in range(count)]
    assert all(f"bound: {words_of_measured(m)}, margin" in text for m, text in zip(margin, said))
    names = [label.get_text() for label in observation_figure(tracks, tracks.solved, FPS).axes[0].get_yticklabels()]
    outside = int((margin < -TOLERANCE_MM).sum())
    assert names[-2:] == [f"within tolerance  {(margin < 0).sum() - outside}", f"outside  {outside}"]


def test_report_of_a_build():
    data = report_data(COUNT)
    data.model.d, data.model.arrays["tolerance_mm"] = D, np.array(TOLERANCE_MM)
    (check,) = (c for verdict in judge(data) for c in verdict.checks if "inside the bound" in c.name)
    assert f"inside the bound ({100 * INSIDE.mean():.1f} %) or within its tolerance of 1.00 mm" in check.name
    assert check.found == f"{100 * (MARGIN >= -TOLERANCE_MM).mean():.1f} %"


@pytest.mark.slow
def test_usd_rule(actor, tmp_path):
    write_animation(tmp_path / "anim.usda", actor, np.arange(COUNT), D, FPS)
    stage = Usd.Stage.Open(str(tmp_path / "anim.usda"))
    (finding,) = RULES["Bounds"](stage.GetPrimAtPath("/Actor"))
    assert finding.message.startswith(f"{(~INSIDE).sum()} of {COUNT} samples are outside")


@pytest.mark.slow
def test_plain_reader_and_add_on(actor, tmp_path, monkeypatch):
    """The packed reader and the panel of the Blender add-on, with its own evaluator, as shipped."""
    extension.copy_scripts(tmp_path / "scripts")
    monkeypatch.syspath_prepend(tmp_path / "scripts")
    reader = importlib.import_module("jawusd_reader")
    rig = reader.load(str(actor))
    assert disagreements([rig.is_inside(*d) for d in D.tolist()]) == 0
    assert disagreements([rig.margin(*d) >= 0 for d in D.tolist()]) == 0
    built = extension.build_extension(tmp_path / "jaw.zip")
    package = tmp_path / "shipped"
    zipfile.ZipFile(built).extractall(package)
    (package / "__init__.py").write_text("")  # the add-on's own module registers with Blender
    labels = _stand_in_for_blender(monkeypatch)
    monkeypatch.syspath_prepend(tmp_path)
    panel = importlib.import_module("shipped.panel")
    vendored = panel.vendored.JawRig(RIG.arrays, RIG.meta)

    class Actor(dict):
        name = "someone"

    shown = Actor()
    monkeypatch.setattr(panel.jaw, "actors", lambda: [shown])
    monkeypatch.setattr(panel.jaw, "rig_of", lambda _: vendored)
    monkeypatch.setattr(panel.jaw, "mandible_of", lambda _: None)
    monkeypatch.setattr(panel.jaw, "is_driven", lambda _: True)
    monkeypatch.setattr(panel.jaw, "without_sliders", list)
    drawn = panel.JAWUSD_PT_sliders()
    drawn.layout = _Layout(labels)
    render = types.SimpleNamespace(fps=FPS, fps_base=1.0)
    context = types.SimpleNamespace(scene=types.SimpleNamespace(render=render))
    said, some = [], slice(None, None, 5)  # both random and near parameters; the panel draws slowly
    for d in D[some].tolist():
        labels.clear()
        shown.update(dict(zip(("d1", "d2", "d3"), d)))
        drawn.draw(context)
        (place,) = [label for label in labels if "the bound" in label]
        said.append(place.startswith("inside"))
    np.testing.assert_array_equal(said, INSIDE[some])


class _Layout:
    """The parts of a Blender layout that the panel uses."""

    def __init__(self, labels):
        self._labels = labels

    def box(self):
        return self

    def row(self):
        return self

    def label(self, text, icon=None):
        self._labels.append(text)

    def prop(self, *_, **__):
        pass

    def operator(self, _, text=None):
        return types.SimpleNamespace()


def _stand_in_for_blender(monkeypatch):
    bpy = types.ModuleType("bpy")
    names = ("ID", "Object", "FCurve", "Context", "Operator", "Panel")
    bpy.types = types.SimpleNamespace(**{name: type(name, (), {}) for name in names})
    bpy.props = types.SimpleNamespace(StringProperty=lambda **_: None, EnumProperty=lambda items: None)
    bpy.app = types.SimpleNamespace(handlers=types.SimpleNamespace(persistent=lambda function: function))
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    helpers = types.ModuleType("bpy_extras.io_utils")
    helpers.ExportHelper = type("ExportHelper", (), {})
    monkeypatch.setitem(sys.modules, "bpy_extras", types.ModuleType("bpy_extras"))
    monkeypatch.setitem(sys.modules, "bpy_extras.io_utils", helpers)
    return []


def test_torch_layer():
    layer = JawLayer(RIG).double()
    d = torch.tensor(D)
    assert disagreements((layer.margin(d) >= 0).numpy()) == 0
    assert disagreements((layer.penalty(d) == 0).numpy()) == 0


def test_onnx_margin(actor):
    double = onnxruntime.InferenceSession(decode_model(RIG, np.float64).SerializeToString())
    (margin,) = double.run(["margin"], {"d": D})
    assert disagreements(margin >= 0) == 0
    delivered = onnxruntime.InferenceSession(str(actor.with_name("actor.onnx")))
    (single,) = delivered.run(["margin"], {"d": D.astype(np.float32)})
    decided = np.abs(MARGIN) > 2e-5  # of single precision
    np.testing.assert_array_equal(single[decided] >= 0, INSIDE[decided])


def test_files_of_version_1_keep_their_tolerance(tmp_path):
    old = {name: value for name, value in ARRAYS.items() if name != "tolerance_mm"} | {
        "margin_limit_mm": np.array(-0.83)
    }
    header = example_meta() | {"format": "jawusd-model/1"}
    np.savez(tmp_path / "model.npz", **old, meta=np.array(json.dumps(header)))
    rig = jawusd.evaluator.load(tmp_path / "model.npz")
    assert rig.tolerance_mm == 0.83 and "margin_limit_mm" not in rig.arrays
    edge = np.array([[15.0, 9.0, 1.0]])
    assert re.fullmatch(r"within tolerance 0\.\d\d of 0\.83 mm|outside", rig.validate(rig.pose(edge)).words()[0])
    assert not rig.validate_parameters(edge).valid.any()


def test_stages_of_version_1_keep_their_tolerance(actor):
    text = actor.read_text()
    old = text.replace("jaw:thresholds:tolerance = 1", "jaw:thresholds:margin = -1").replace(
        "jaw:formatVersion = 2", "jaw:formatVersion = 1"
    )
    assert old != text
    path = actor.with_name("version_1.usda")
    path.write_text(old)
    assert load_rig(path).tolerance_mm == 1.0
