"""`jawusd animate` of keys and tables."""

import json
import subprocess
import sys

import numpy as np
import pytest
from example_rig import FPS, example_motion, mandible_vertices, moved
from key_sets import own_curve
from pxr import Usd, UsdGeom
from run_jawusd import run
from scipy.interpolate import CubicHermiteSpline

import jawusd
from jawusd.formats.poses import write_parameters
from jawusd.rig.validate import validate_stage


def test_animate_interpolates_keys_linearly_as_in_the_paper(actor, tmp_path):
    keys = {"fps": 30, "keys": [{"frame": 0, "d": [0, 0, 0]}, {"frame": 10, "d": [20, 2, 1]}]}
    (tmp_path / "keys.json").write_text(json.dumps(keys))
    out = actor.parent / "anim_keys.usdc"
    summary = json.loads(run("animate", actor, tmp_path / "keys.json", "-o", out, "--json"))
    assert summary["clamped"] == 0 and summary["fps"] == 30
    assert validate_stage(out) == []
    stage = Usd.Stage.Open(str(out))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 10, 30)
    prim = stage.GetPrimAtPath("/Actor")
    assert [prim.GetAttribute(f"jaw:d{i}").Get(4) for i in (1, 2, 3)] == pytest.approx([8, 0.8, 0.4])
    mandible = UsdGeom.Xformable(stage.GetPrimAtPath("/Actor/geo/Mandible"))
    T = np.array(mandible.GetLocalTransformation(4)).T
    expected = moved(jawusd.load(actor).pose([[8, 0.8, 0.4]]), mandible_vertices())
    np.testing.assert_allclose(moved(T[None], mandible_vertices()), expected, atol=0.01)


def test_animate_writes_keys_as_splines_when_asked(actor, tmp_path):
    keys = {"fps": 30, "keys": [{"frame": 0, "d": [0, 0, 0]}, {"frame": 10, "d": [20, 2, 1]}]}
    (tmp_path / "keys.json").write_text(json.dumps(keys))
    out, splines = (actor.parent / f"anim_spline_test{name}.usdc" for name in ("", "_keys"))
    run("animate", actor, tmp_path / "keys.json", "-o", out, "--splines", splines)
    assert validate_stage(splines) == []
    stage = Usd.Stage.Open(str(splines))
    attribute = stage.GetPrimAtPath("/Actor").GetAttribute("jaw:d1")
    assert attribute.HasSpline() and attribute.Get(4) == pytest.approx(8)
    other = actor.parent / "anim_spline_other.usdc"
    refused = run("animate", actor, tmp_path / "keys.json", "-o", other, "--splines", splines, code=10)
    assert splines.name in refused and not other.exists()


def samples(path, times):
    """Return d (n, 3) as OpenUSD evaluates it in a layer at these times."""
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/Actor")
    return np.array([[prim.GetAttribute(f"jaw:d{i}").Get(time) for i in (1, 2, 3)] for time in times.tolist()])


@pytest.mark.parametrize("interpolation", ["linear", "smooth"])
@pytest.mark.parametrize(
    "keys",
    [
        {0: (20, 6, 0), 100: (20, 11, 0)},
        {0: (0, 0, 0), 20: (20, 0, 0), 50: (20, 0, 0), 70: (5, 0, 0), 80: (0, 0, 0), 95: (0, 0, 0)},
        {3: (5, 3, 0), 20.5: (38, -8, 4), 33: (12, 9, -3), 60: (12, 9, -3)},
    ],
)
def test_animate_pops_nowhere_and_stays_inside(actor, tmp_path, keys, interpolation):
    """Ten samples per frame: inside the bound, between the keys, with no larger step than the keys."""
    file = {"fps": 24, "interpolation": interpolation, "keys": [{"frame": f, "d": d} for f, d in keys.items()]}
    (tmp_path / "keys.json").write_text(json.dumps(file))
    name = f"anim_pops_{max(keys)}_{interpolation}"
    out, splines = (actor.parent / f"{name}{end}.usdc" for end in ("", "_keys"))
    run("animate", actor, tmp_path / "keys.json", "-o", out, "--splines", splines)
    rig, frames, d = jawusd.load(actor), np.array(list(keys), dtype=float), np.array(list(keys.values()), dtype=float)
    times = np.arange(frames[0], frames[-1] + 0.05, 0.1)
    for path in (out, splines):
        found = samples(path, times)
        assert rig.margin(found).min() > -1e-6
        assert (found >= d.min(0) - 1e-3).all() and (found <= d.max(0) + 1e-3).all()
        own = own_curve(frames, d, times, interpolation)
        steps, own_steps = (np.linalg.norm(np.diff(x[::10], axis=0), axis=1) for x in (found, own))
        assert steps.max() <= 1.05 * own_steps.max()
        inside = rig.margin(own).min() > 0
        if inside:
            np.testing.assert_allclose(found[::10], own[::10], atol=1e-6)
    if inside:  # the spline consists of the keys alone
        stage = Usd.Stage.Open(str(splines))
        knots = stage.GetPrimAtPath("/Actor").GetAttribute("jaw:d1").GetSpline().GetKnots()
        assert sorted(knots.keys()) == frames.tolist()
        np.testing.assert_allclose(samples(splines, times), own, atol=1e-6)
    assert validate_stage(out) == [] and validate_stage(splines) == []


def test_animate_reports_what_it_clamps(actor, tmp_path):
    frames, d = example_motion(5)
    d[2, 1] = 30
    write_parameters(tmp_path / "d.csv", frames, d)
    summary = json.loads(run("animate", actor, tmp_path / "d.csv", "-o", actor.parent / "anim_c.usdc", "--json"))
    assert summary["clamped"] == 1 and summary["largest_clamp_mm"] > 15 and summary["fps"] == FPS


def test_animate_writes_glb(actor, tmp_path):
    keys, glb = tmp_path / "keys.json", tmp_path / "take.glb"
    keys.write_text('{"fps": 24, "keys": [{"frame": 1, "d": [0, 0, 0]}, {"frame": 9, "d": [12, 0, 0]}]}')
    said = run("animate", actor, keys, "-o", glb)
    assert "frames 1 .. 9 at 24 fps" in said and "at 0 s" not in said
    early = keys.with_name("early.json")
    early.write_text(keys.read_text().replace('"frame": 1,', '"frame": -8,'))
    assert "frame -8 is at 0 s" in run("animate", actor, early, "-o", tmp_path / "early.glb")
    assert glb.read_bytes()[:4] == b"glTF" and b'"animations"' in glb.read_bytes()
    run("animate", actor, keys, "-o", glb, code=10)  # the output exists
    for option, value in (("--splines", tmp_path / "s.usda"), ("--prim", "/Actor")):
        assert option in run("animate", actor, keys, "-o", tmp_path / "b.glb", option, value, code=2)


def test_keys_move_to_another_rate_and_keep_their_curves(actor, tmp_path):
    keys = [{"frame": 30, "d": [0.5, 0, 0]}, {"frame": 60, "d": [15, 1, 0.5]}, {"frame": 90, "d": [4, -1, 0]}]
    (tmp_path / "keys.json").write_text(json.dumps({"fps": 60, "interpolation": "smooth", "keys": keys}))
    splines = tmp_path / "splines.usda"
    out = tmp_path / "anim.usdc"
    done = subprocess.run(
        [sys.executable, "-m", "jawusd", "animate", actor, tmp_path / "keys.json", "--resample", "24", "-o", out]
        + ["--splines", splines],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    stage = Usd.Stage.Open(str(splines))
    knots = stage.GetPrimAtPath("/Actor").GetAttribute("jaw:d1").GetSpline().GetKnots()
    assert sorted(knots.keys()) == [12, 24, 36]


def test_given_tangents_are_those_of_the_motion_at_any_rate(actor, tmp_path):
    d = [[2, 0, 0], [12, 0.5, 0], [8, 0, 0]]
    keys = [{"frame": frame, "d": row} for frame, row in zip((0, 20, 40), d)]
    keys[1]["tangents"] = [0.4, None, None]
    (tmp_path / "keys.json").write_text(json.dumps({"fps": 48, "interpolation": "smooth", "keys": keys}))
    oracle = CubicHermiteSpline([0, 20, 40], [row[0] for row in d], [0, 0.4, 0])
    for rate, step in ((48, 1), (24, 2)):
        splines, out = tmp_path / f"splines_{rate}.usda", tmp_path / f"anim_{rate}.usdc"
        run("animate", actor, tmp_path / "keys.json", "-o", out, "--splines", splines, "--resample", str(rate))
        times = np.arange(0, 40 // step + 1)
        sampled, keyed = (Usd.Stage.Open(str(path)) for path in (out, splines))
        found = [sampled.GetPrimAtPath("/Actor").GetAttribute("jaw:d1").Get(float(time)) for time in times]
        np.testing.assert_allclose(found, oracle(times * step), atol=1e-4)
        spline = keyed.GetPrimAtPath("/Actor").GetAttribute("jaw:d1").GetSpline()
        assert spline.GetKnot(20 / step).GetPostTanSlope() == pytest.approx(0.4 * step)


def test_keys_outside_come_inside_and_keep_their_tangents(actor, tmp_path):
    rig = jawusd.load(actor)
    far = [float(rig.d_range[0, 1]) + 1.5, 0.0, 0.0]
    assert rig.margin(far) < 0
    keys = [{"frame": 1, "d": [2, 0, 0]}, {"frame": 13, "d": far}, {"frame": 25, "d": [2, 0, 0]}]
    (tmp_path / "keys.json").write_text(json.dumps({"fps": 24, "interpolation": "smooth", "keys": keys}))
    splines, out = tmp_path / "splines.usda", tmp_path / "anim.usdc"
    summary = json.loads(run("animate", actor, tmp_path / "keys.json", "-o", out, "--splines", splines, "--json"))
    assert summary["clamped"] >= 1
    stage = Usd.Stage.Open(str(splines))
    knots = stage.GetPrimAtPath("/Actor").GetAttribute("jaw:d1").GetSpline().GetKnots()
    assert sorted(knots.keys()) == [1, 13, 25]
    assert validate_stage(out) == [] and validate_stage(splines) == []


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("none.csv", "frame,d1,d2,d3\n", "none.csv: the motion has no frames"),
        ("twice.csv", "frame,d1,d2,d3\n1,0,0,0\n1,5,0,0\n", "twice.csv: frames must increase: frame 1 follows 1"),
        ("tracks.npz", "PK", "tracks.npz: is an npz file; expected key frames, or a table of d values or poses."),
    ],
)
def test_a_source_that_cannot_be_animated_is_named(actor, tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    assert words in run("animate", actor, tmp_path / name, "-o", tmp_path / "anim.usdc", code=3)
