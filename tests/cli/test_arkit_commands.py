"""Face captures: `jawusd animate --arkit`, `arkit-fit` and `arkit-table`, run as programs."""

import json

import numpy as np
import pytest
from pxr import Usd
from run_jawusd import face_csv, run
from scipy.signal import find_peaks

import jawusd
from jawusd.evaluator.skin import Skin
from jawusd.formats.poses import write_parameters
from jawusd.rig.validate import validate_stage


def test_animate_refuses_arkit_weights_in_percent(actor, tmp_path):
    csv = face_csv(tmp_path / "face.csv", [(30, 0, 0, 0), (85, 2, 0, 1)] * 40)
    text = run("animate", actor, "--arkit", csv, "-o", tmp_path / "x.usdc", code=3)
    assert "divide all weights by 100" in text and not (tmp_path / "x.usdc").exists()


def test_animate_takes_arkit_weights_as_shares_of_the_persons_ranges(actor, tmp_path):
    """A weight of 1 reaches the end of `ranges`: half opening, then each side at that opening."""
    rig = jawusd.load(actor)
    d1 = 0.5 * rig.d_range[0, 1]
    d2_min, d2_max, _, d3_max = rig.ranges(d1)
    weights = [(0, 0, 0, 0), (0.5, 0, 0, 0), (0.5, 0.5, 0, 0), (0.5, 0.1, 0.6, 0), (0.5, 0, 0, 0.5), None] * 20
    csv = face_csv(tmp_path / "face.csv", weights)
    out = actor.parent / "anim_face.usdc"
    summary = json.loads(run("animate", actor, "--arkit", csv, "-o", out, "--json"))
    assert summary["fps"] == 30 and summary["frames"] == [0, 119]
    assert (summary["clamped"], summary["lost"]) == (0, 20)
    stage = Usd.Stage.Open(str(out))
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (30, 119)
    prim = stage.GetPrimAtPath("/Actor")
    found = np.array([[prim.GetAttribute(f"jaw:d{i}").Get(frame) for i in (1, 2, 3)] for frame in range(5)])
    expected = [[0, 0, 0], [d1, 0, 0], [d1, 0.5 * d2_max, 0], [d1, 0.5 * d2_min, 0], [d1, 0, 0.5 * d3_max]]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert [f.rule for f in validate_stage(out)] == []


def test_animate_says_how_far_arkit_weights_were_clamped(actor, tmp_path):
    csv = face_csv(tmp_path / "face.csv", [(0.3, 0, 0, 0)] * 60 + [(1.2, 0, 0, 0), (0.4, 1, 0, 1)] * 15)
    out = actor.parent / "anim_wide.usdc"
    summary = json.loads(run("animate", actor, "--arkit", csv, "-o", out, "--json"))
    assert summary["clamped"] == 30 and summary["largest_clamp_mm"] > 1
    assert 0 < summary["mean_clamp_mm"] < summary["largest_clamp_mm"]
    assert "30 frames lay outside" in run("animate", actor, "--arkit", csv, "-o", out, "--force")


@pytest.mark.slow
def test_arkit_fit_learns_the_actors_own_mapping(actor, tmp_path):
    """Weights made from d with an actor's gains and a delay of 0.5 s; `animate --mapping` recovers d."""
    rig, phase = jawusd.load(actor), 2 * np.pi * np.arange(720) / 24
    wanted = np.stack([9 - 9 * np.cos(0.31 * phase), 4 * np.sin(0.47 * phase), 2 - 2 * np.cos(0.23 * phase)], axis=1)
    d = rig.project(wanted)
    write_parameters(tmp_path / "d.csv", np.arange(720), d)
    weights = np.stack([d[:, 0] / 60, np.maximum(d[:, 1], 0) / 9, np.maximum(-d[:, 1], 0) / 7, d[:, 2] / 12], axis=1)
    csv = face_csv(tmp_path / "face.csv", weights[12:] + [0.02, 0.03, 0.01, 0.05], fps=24)
    mapping, out = tmp_path / "arkit.npz", actor.parent / "anim_own.usdc"
    found = json.loads(run("arkit-fit", actor, csv, tmp_path / "d.csv", "-o", mapping, "--jaw-fps", 24, "--json"))
    assert found["offset_s"] == pytest.approx(0.5, abs=0.005)
    assert found["errors_mm"]["skin"] < 0.2 and found["names"] == ["jawopen", "jawleft", "jawright", "jawforward"]
    run("arkit-fit", actor, csv, tmp_path / "d.csv", "-o", mapping, "--jaw-fps", 24, code=10)  # the output exists
    run("animate", actor, "--arkit", csv, "--mapping", mapping, "-o", out)
    stage = Usd.Stage.Open(str(out))
    prim = stage.GetPrimAtPath("/Actor")
    got = np.array([[prim.GetAttribute(f"jaw:d{i}").Get(float(frame)) for i in (1, 2, 3)] for frame in range(700)])
    assert np.abs(got - d[12:712]).max() < 0.5
    run("animate", actor, tmp_path / "d.csv", "--mapping", mapping, "-o", tmp_path / "x.usdc", code=2)  # no --arkit
    learned = jawusd.load_skin(mapping)
    jawusd.save_skin(tmp_path / "other.npz", Skin(learned.arrays, learned.meta | {"actor": "somebody"}))
    animate = ("animate", actor, "--arkit", csv, "--mapping", tmp_path / "other.npz", "-o", tmp_path / "x.usdc")
    assert 'the skin of "somebody"' in run(*animate, code=3)
    (tmp_path / "other.npz").write_text("{}")
    assert "other.npz" in run(*animate, code=3)
    rows = json.loads(run("arkit-table", actor, "-o", tmp_path / "joint.csv", "--mapping", mapping, "--json"))["rows"]
    table = np.genfromtxt(tmp_path / "joint.csv", delimiter=",", skip_header=1)
    assert rows == 8 and table[0, 2] == pytest.approx(0.5 * 60, abs=4)  # the gain of JawOpen is 60 mm


@pytest.mark.slow
def test_animate_takes_what_skin_fit_learned_from_blend_shapes(actor, tmp_path):
    """Weights made from d with an actor's gains; the learned map recovers d, and other blend shapes are refused."""
    rig, phase = jawusd.load(actor), 2 * np.pi * np.arange(720) / 24
    wanted = np.stack([9 - 9 * np.cos(0.31 * phase), 4 * np.sin(0.47 * phase), 2 - 2 * np.cos(0.23 * phase)], axis=1)
    d = rig.project(wanted)
    write_parameters(tmp_path / "d.csv", np.arange(720), d)
    weights = np.stack([d[:, 0] / 60, np.maximum(d[:, 1], 0) / 9, np.maximum(-d[:, 1], 0) / 7, d[:, 2] / 12], axis=1)
    csv, skin = face_csv(tmp_path / "face.csv", weights + 0.02, fps=24), tmp_path / "skin.npz"
    run("skin-fit", actor, tmp_path / "d.csv", csv, "-o", skin, "--jaw-fps", 24, "--offset", 0)
    out = actor.parent / "anim_skin.usdc"
    run("animate", actor, "--arkit", csv, "--mapping", skin, "-o", out)
    stage = Usd.Stage.Open(str(out))
    prim = stage.GetPrimAtPath("/Actor")
    got = np.array([[prim.GetAttribute(f"jaw:d{i}").Get(float(frame)) for i in (1, 2, 3)] for frame in range(720)])
    assert np.abs(got - d).max() < 0.6 and np.abs(got - d).mean() < 0.1
    csv.write_text(csv.read_text().replace("JawLeft", "MouthLeft"))
    words = ("animate", actor, "--arkit", csv, "--mapping", skin, "-o", tmp_path / "x.usdc")
    assert "missing: JawLeft" in run(*words, code=3)


def test_arkit_table_lists_shapes(actor, tmp_path):
    out = tmp_path / "joint.csv"
    assert json.loads(run("arkit-table", actor, "-o", out, "--json"))["rows"] == 8
    lines = out.read_text().splitlines()
    assert lines[0].startswith("shape,weight,d1") and lines[2].startswith("JawOpen,1,")
    run("arkit-table", actor, "-o", out, code=10)  # the output exists
    (tmp_path / "bad.npz").write_text("{}")
    assert "bad.npz" in run("arkit-table", actor, "-o", out, "--mapping", tmp_path / "bad.npz", "--force", code=3)


@pytest.mark.parametrize("lost", [False, True])
def test_face_takes_come_to_the_rate_of_the_scene(actor, tmp_path, lost):
    """From 60 to 24 frames per second, samples lie on the motion, and peaks stay at their times."""
    rig = jawusd.load(actor)
    opening = 0.25 - 0.25 * np.cos(2 * np.pi * np.arange(301) / 60 * 1.3)
    weights = [(x, 0, 0, 0) for x in opening]
    if lost:
        weights[100:130] = [None] * 30
    out = actor.parent / "anim_24.usdc"
    csv = face_csv(tmp_path / "face.csv", weights, fps=60)
    found = json.loads(run("animate", actor, "--arkit", csv, "--resample", 24, "-o", out, "--force", "--json"))
    assert found["fps"] == 24 and found["frames"] == [0, 120] and found["lost"] == (12 if lost else 0)
    stage = Usd.Stage.Open(str(out))
    stage.Reload()
    assert stage.GetTimeCodesPerSecond() == 24
    at = np.setdiff1d(np.arange(121), np.arange(40, 52) if lost else [])
    d1 = np.array([stage.GetPrimAtPath("/Actor").GetAttribute("jaw:d1").Get(float(frame)) for frame in at])
    expected = rig.d_range[0, 1] * (0.25 - 0.25 * np.cos(2 * np.pi * at / 24 * 1.3))
    edges = np.abs(at - 45.5) < 8 if lost else np.zeros(len(at), bool)
    np.testing.assert_allclose(d1[~edges], expected[~edges], atol=0.02)
    assert validate_stage(out) == []


def test_peaks_of_speech_keep_their_time_and_height(actor, tmp_path):
    """From 60 to 24 frames per second, peaks of chewing stay at their times, also between frames."""
    rig = jawusd.load(actor)

    def d_at(seconds):
        opening = 0.3 + 0.1 * np.sin(2 * np.pi * 0.7 * seconds) + 0.08 * np.sin(2 * np.pi * 3.1 * seconds + 1)
        side = 0.35 * np.sin(2 * np.pi * 1.3 * seconds)
        return opening, np.maximum(side, 0.0) ** 2, np.maximum(-side, 0.0) ** 2

    opening, left, right = d_at(np.arange(0, 1201) / 60)
    csv = face_csv(tmp_path / "face.csv", np.column_stack([opening, left, right, 0 * left]), fps=60)
    out = actor.parent / "anim_peaks.usdc"
    found = json.loads(run("animate", actor, "--arkit", csv, "--resample", 24, "-o", out, "--json"))
    assert found["frames"] == [0, 480] and found["clamped"] == 0
    stage = Usd.Stage.Open(str(out))
    shown = stage.GetPrimAtPath("/Actor").GetAttribute("jaw:d1")
    d1 = np.array([shown.Get(float(frame)) for frame in range(481)])
    truth = rig.d_range[0, 1] * d_at(np.arange(481) / 24)[0]
    np.testing.assert_allclose(d1[1:-1], truth[1:-1], atol=0.02)
    fine = rig.d_range[0, 1] * d_at(np.arange(0, 20, 0.001))[0]
    for sign in (1, -1):
        peaks = find_peaks(sign * fine, prominence=1.0)[0] / 1000 * 24
        peaks = peaks[(peaks > 2) & (peaks < 478)]
        found = find_peaks(sign * d1)[0]
        assert len(peaks) > 50 and np.abs(peaks[:, None] - found).min(axis=1).max() <= 1.0
