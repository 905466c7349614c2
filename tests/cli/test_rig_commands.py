"""The commands on a finished rig, run as a user runs them: output, JSON and exit codes."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from example_rig import FPS, example_meshes, example_motion, example_rig, mandible_vertices, moved
from example_tracks import make_tracks
from key_sets import own_curve
from package_copy import ROOT
from pxr import Usd, UsdGeom
from scipy.signal import find_peaks

import jawusd
from jawusd.formats.poses import read_parameters, write_parameters, write_poses
from jawusd.formats.tracks import LostReason, TrackStatus, save_tracks
from jawusd.geometry import se3_exp, se3_log
from jawusd.rig.bake import bake_rig
from jawusd.rig.validate import validate_stage


@pytest.fixture(scope="module")
def actor(tmp_path_factory):
    folder = tmp_path_factory.mktemp("actor")
    frames, d = example_motion()
    bake_rig(folder, example_rig(), example_meshes(), name="someone", fps=FPS, frames=frames, d=d, table_size=17)
    return folder / "actor.usda"


def run(*arguments, code=0):
    """Run the program in a process of its own and return its standard output."""
    command = [sys.executable, "-m", "jawusd", *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == code, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    return result.stdout if code in (0, 1) else result.stderr


def test_pose_prints_what_the_evaluator_says(actor):
    found = json.loads(run("pose", actor, "--d", 12, -3, 1.5, "--json"))
    rig = jawusd.load(actor)
    np.testing.assert_allclose(found["T_skull_mandible"], rig.pose([12, -3, 1.5]), atol=1e-12)
    np.testing.assert_allclose(se3_exp(found["twist"]) @ rig.T_rest, rig.pose([12, -3, 1.5]), atol=1e-9)
    assert found["valid"] is True and found["margin_mm"] == pytest.approx(float(rig.margin([12, -3, 1.5])))
    assert set(found["landmarks_mm"]) == {"incisor", "molar_left", "molar_right", "condyle_left", "condyle_right"}
    assert "OUTSIDE" in run("pose", actor, "--d", 12, 30, 0)


def test_encode_writes_parameters_that_pose_back(actor, tmp_path):
    rig = jawusd.load(actor)
    frames, d = example_motion()
    write_poses(tmp_path / "poses.csv", frames, rig.pose(d))
    summary = json.loads(run("encode", actor, tmp_path / "poses.csv", "-o", tmp_path / "d.csv", "--json"))
    assert summary["encoded"] == len(frames) and summary["residual_mm"]["max"] < 1e-6
    found_frames, found = read_parameters(tmp_path / "d.csv")
    np.testing.assert_array_equal(found_frames, frames)
    np.testing.assert_allclose(found, d, atol=1e-6)
    assert "--force" in run("encode", actor, tmp_path / "poses.csv", "-o", tmp_path / "d.csv", code=10)


def test_validate_judges_poses_and_leaves_with_a_no(actor, tmp_path):
    rig = jawusd.load(actor)
    frames, d = example_motion(6)
    T = rig.pose(d)
    write_poses(tmp_path / "good.csv", frames, T)
    assert "6 poses: 6 inside, 0 within tolerance, 0 invalid" in run("validate", actor, tmp_path / "good.csv")
    T[2] = se3_exp([0, 0.3, 0.2, 0, 5, 0]) @ T[2]
    write_poses(tmp_path / "bad.csv", frames, T)
    found = json.loads(run("validate", actor, tmp_path / "bad.csv", "--json", code=1))
    assert found["invalid"] == 1 and found["verdicts"][2]["valid"] is False
    assert found["verdicts"][2]["reason"] == "off the model, outside" and found["verdicts"][1]["reason"] == "inside"
    write_parameters(tmp_path / "d.csv", frames, d + [0, 40, 0])
    assert "outside (" in run("validate", actor, tmp_path / "d.csv", code=1)


def test_validate_without_poses_checks_the_rig(actor):
    assert json.loads(run("validate", actor, "--json"))["errors"] == 0


def test_info_names_actor_ranges_and_meshes(actor):
    found = json.loads(run("info", actor, "--json"))
    assert found["actor"] == "someone" and found["model"]["kind"] == "anchored"
    text = run("info", actor.parent / "anim_capture.usdc")
    assert "someone" in text and "animation: 40 samples" in text


def test_info_says_how_a_frame_was_tracked(tmp_path):
    tracks = make_tracks(4)
    tracks.status[1, 1], tracks.lost_reason[1, 1] = TrackStatus.LOST, LostReason.LOW_SCORE
    tracks.lost_value[1, 1], tracks.lost_limit[1, 1] = 0.31, 0.6
    tracks.masks_used[1, 0, 1] = False
    save_tracks(tmp_path / "tracks.npz", tracks)
    text = run("info", tmp_path / "tracks.npz", "--frame", 31).splitlines()
    assert text == [
        "frame 31, upper arch: tracked; mask left out: b",
        "frame 31, lower arch: lost: matched contour 31% of the usual, at least 60% is needed",
    ]
    found = json.loads(run("info", tmp_path / "tracks.npz", "--frame", 31, "--json"))["arches"]["lower"]
    assert (found["lost_reason"], found["lost_value"], found["lost_limit"]) == ("low score", 0.31, 0.6)
    assert json.loads(run("info", tmp_path / "tracks.npz", "--json"))["frames"] == 4
    run("info", tmp_path / "tracks.npz", "--frame", 99, code=6)
    assert "lower arch lost by: low score 1" in run("info", tmp_path / "tracks.npz")


def test_ik_reaches_a_reachable_target(actor):
    rig = jawusd.load(actor)
    point = rig.landmarks[0]
    target = (rig.pose([10.0, 2.0, 1.0]) @ np.append(point, 1))[:3]
    found = json.loads(run("ik", actor, "--point", *point, "--target", *target, "--json"))
    assert found["distance_mm"] < 1e-3 and found["margin_mm"] >= 0


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
    """Return the d (n, 3) that a reader of a layer finds at times."""
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
    """As readers see it, ten times a frame: inside, never beyond the keys, no step longer than the keys' own."""
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
    if inside:  # the spline is the keys themselves
        stage = Usd.Stage.Open(str(splines))
        knots = stage.GetPrimAtPath("/Actor").GetAttribute("jaw:d1").GetSpline().GetKnots()
        assert sorted(knots.keys()) == frames.tolist()
        np.testing.assert_allclose(samples(splines, times), own, atol=1e-6)
    assert validate_stage(out) == [] and validate_stage(splines) == []


def test_animate_refuses_arkit_weights_in_percent(actor, tmp_path):
    csv = face_csv(tmp_path / "face.csv", [(30, 0, 0, 0), (85, 2, 0, 1)] * 40)
    text = run("animate", actor, "--arkit", csv, "-o", tmp_path / "x.usdc", code=3)
    assert "divide all weights by 100" in text and not (tmp_path / "x.usdc").exists()


def test_animate_reports_what_it_clamps(actor, tmp_path):
    frames, d = example_motion(5)
    d[2, 1] = 30
    write_parameters(tmp_path / "d.csv", frames, d)
    summary = json.loads(run("animate", actor, tmp_path / "d.csv", "-o", actor.parent / "anim_c.usdc", "--json"))
    assert summary["clamped"] == 1 and summary["largest_clamp_mm"] > 15 and summary["fps"] == FPS


def face_csv(path, weights, fps=30):
    """Write a face capture of rows (open, left, right, forward); None is a moment without a face."""
    rows = ["Timecode,BlendShapeCount,JawForward,JawRight,JawLeft,JawOpen"]
    for k, row in enumerate(weights):
        code = f"10:00:{k // fps:02d}:{k % fps:02d}.000"
        rows.append(f"{code},0" if row is None else f"{code},52,{row[3]},{row[2]},{row[1]},{row[0]}")
    path.write_text("\n".join(rows))
    return path


def test_animate_takes_arkit_weights_as_shares_of_the_persons_ranges(actor, tmp_path):
    """The ends are measured with `ranges`: 1 is the edge of the bound, so opening halfway and then to either side."""
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


def test_animate_writes_glb(actor, tmp_path):
    keys, glb = tmp_path / "keys.json", tmp_path / "take.glb"
    keys.write_text('{"fps": 24, "keys": [{"frame": 1, "d": [0, 0, 0]}, {"frame": 9, "d": [12, 0, 0]}]}')
    assert "frames 1 .. 9 at 24 fps" in run("animate", actor, keys, "-o", glb)
    assert glb.read_bytes()[:4] == b"glTF" and b'"animations"' in glb.read_bytes()
    run("animate", actor, keys, "-o", glb, code=10)  # it exists
    for option, value in (("--splines", tmp_path / "s.usda"), ("--prim", "/Actor")):
        assert option in run("animate", actor, keys, "-o", tmp_path / "b.glb", option, value, code=2)


def test_arkit_fit_learns_the_actors_own_mapping(actor, tmp_path):
    """Weights that mean d by gains of this actor, 0.5 s apart; `animate --mapping` gives d back."""
    rig, phase = jawusd.load(actor), 2 * np.pi * np.arange(720) / 24
    wanted = np.stack([9 - 9 * np.cos(0.31 * phase), 4 * np.sin(0.47 * phase), 2 - 2 * np.cos(0.23 * phase)], axis=1)
    d = rig.project(wanted)
    write_parameters(tmp_path / "d.csv", np.arange(720), d)
    weights = np.stack([d[:, 0] / 60, np.maximum(d[:, 1], 0) / 9, np.maximum(-d[:, 1], 0) / 7, d[:, 2] / 12], axis=1)
    csv = face_csv(tmp_path / "face.csv", weights[12:] + [0.02, 0.03, 0.01, 0.05], fps=24)
    mapping, out = tmp_path / "arkit.json", actor.parent / "anim_own.usdc"
    found = json.loads(run("arkit-fit", actor, csv, tmp_path / "d.csv", "-o", mapping, "--jaw-fps", 24, "--json"))
    assert found["offset_s"] == pytest.approx(0.5, abs=0.005)
    assert found["error_mm"] < 0.2 < found["shares_error_mm"]
    run("arkit-fit", actor, csv, tmp_path / "d.csv", "-o", mapping, "--jaw-fps", 24, code=10)  # it exists
    run("animate", actor, "--arkit", csv, "--mapping", mapping, "-o", out)
    stage = Usd.Stage.Open(str(out))
    prim = stage.GetPrimAtPath("/Actor")
    got = np.array([[prim.GetAttribute(f"jaw:d{i}").Get(float(frame)) for i in (1, 2, 3)] for frame in range(700)])
    assert np.abs(got - d[12:712]).max() < 0.5
    run("animate", actor, tmp_path / "d.csv", "--mapping", mapping, "-o", tmp_path / "x.usdc", code=2)  # no --arkit
    other = mapping.read_text().replace(json.loads(mapping.read_text())["actor"], "somebody")
    animate = ("animate", actor, "--arkit", csv, "--mapping", tmp_path / "other.json", "-o", tmp_path / "x.usdc")
    (tmp_path / "other.json").write_text(other)
    assert 'mapping of "somebody"' in run(*animate, code=3)
    (tmp_path / "other.json").write_text(other.replace("jawusd-arkit/1", "jawusd-arkit/2"))
    text = run(*animate, code=3)
    assert "format" in text and "arkit-fit" in text


def test_arkit_table_lists_shapes(actor, tmp_path):
    out = tmp_path / "joint.csv"
    assert json.loads(run("arkit-table", actor, "-o", out, "--json"))["rows"] == 8
    lines = out.read_text().splitlines()
    assert lines[0].startswith("shape,weight,d1") and lines[2].startswith("JawOpen,1,")
    run("arkit-table", actor, "-o", out, code=10)  # it exists
    (tmp_path / "bad.json").write_text("{}")
    assert "arkit-fit" in run("arkit-table", actor, "-o", out, "--mapping", tmp_path / "bad.json", "--force", code=3)


@pytest.mark.parametrize("lost", [False, True])
def test_face_takes_come_to_the_rate_of_the_scene(actor, tmp_path, lost):
    """60 to 24 frames per second: on the motion at the new frames, peaks where they were."""
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
    """60 to 24 frames per second: a chewed sentence, looked at between the frames for where it peaks."""
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


def test_keys_outside_come_inside_and_keep_their_tangents(actor, tmp_path):
    rig = jawusd.load(actor)
    far = [float(rig.d_range[0, 1]) + 1.5, 0.0, 0.0]
    assert rig.margin(far) < 0
    keys = [{"frame": 1, "d": [2, 0, 0]}, {"frame": 13, "d": far}, {"frame": 25, "d": [2, 0, 0]}]
    (tmp_path / "keys.json").write_text(json.dumps({"fps": 24, "interpolation": "smooth", "keys": keys}))
    splines, out = tmp_path / "splines.usda", tmp_path / "anim.usdc"
    summary = json.loads(
        run("animate", actor, tmp_path / "keys.json", "-o", out, "--splines", splines, "--json")
    )
    assert summary["clamped"] >= 1
    stage = Usd.Stage.Open(str(splines))
    knots = stage.GetPrimAtPath("/Actor").GetAttribute("jaw:d1").GetSpline().GetKnots()
    assert sorted(knots.keys()) == [1, 13, 25]
    assert validate_stage(out) == [] and validate_stage(splines) == []


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("pose", "{actor}", "--d", "1", "2"), 2, "requires 3 arguments"),
        (("pose", "{actor}", "--d", "1", "2", "nan"), 2, "finite"),
        (("pose", "{tmp}/none.usda", "--d", "1", "2", "3"), 8, "none.usda"),
        (("encode", "{actor}", "{tmp}/nan.csv"), 3, 'column "tx" is nan'),
        (("validate", "{actor}", "{tmp}/empty.csv"), 3, "empty"),
        (("animate", "{actor}", "{tmp}/bad.json"), 3, "must rise"),
        (("animate", "{actor}"), 2, "either a source or --arkit"),
        (("animate", "{actor}", "{tmp}/bad.json", "--arkit", "{tmp}/nan.csv"), 2, "either a source or --arkit"),
        (("animate", "{actor}", "--arkit", "{tmp}/nan.csv"), 3, "timecode"),
        (("animate", "{actor}", "--arkit", "{tmp}/faceless.csv"), 3, "no row has a face"),
        (("nonsense",), 2, "No such command"),
    ],
)
def test_bad_input_is_one_clear_error(actor, tmp_path, arguments, code, words):
    (tmp_path / "nan.csv").write_text("frame,tx,ty,tz,qw,qx,qy,qz\n1,nan,0,0,1,0,0,0\n")
    (tmp_path / "empty.csv").write_text("")
    face_csv(tmp_path / "faceless.csv", [None] * 90)
    key = {"frame": 3, "d": [0, 0, 0]}
    (tmp_path / "bad.json").write_text(json.dumps({"fps": 24, "keys": [key, key]}))
    text = run(*(a.format(actor=actor, tmp=tmp_path) for a in arguments), code=code)
    assert words in text


@pytest.mark.parametrize("command", ["encode", "publish", "animate", "build"])
@pytest.mark.parametrize("out", ["circle/x", "n" * 300, "a\nb/x"])
def test_names_that_no_file_can_have_are_one_line(command, out, actor, tmp_path):
    (tmp_path / "circle").symlink_to("circle")
    given = {"publish": [actor.parent], "build": [ROOT / "examples" / "capture"]}
    given = given.get(command, [actor, actor.parent / "anim_capture.usdc"])
    line = [sys.executable, "-m", "jawusd", command, *map(str, given), "-o", str(tmp_path / out)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)
    assert "Traceback" not in done.stderr
    if command != "encode" or "\n" not in out:  # a table may lie anywhere
        assert done.returncode >= 2 and "jawusd: " in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("arguments", [["pose", "--d", "5", "0", "0"], ["info", "--json"]])
def test_a_full_disk_behind_the_output_is_one_line(arguments, actor):
    line = [sys.executable, "-m", "jawusd", arguments[0], str(actor), *arguments[1:]]
    with open("/dev/full", "w") as full:
        done = subprocess.run(line, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120, check=False)
    assert done.returncode == 10
    assert done.stderr.splitlines() == ["jawusd: the output: No space left on device."]


def test_a_rig_of_a_newer_version_is_refused(actor, tmp_path):
    for file in actor.parent.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    text = (tmp_path / "actor.usda").read_text()
    layer = tmp_path / ("actor.usda" if "jaw:formatVersion" in text else "rig.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "actor.usda"))
    stage.SetEditTarget(Usd.EditTarget(stage.GetRootLayer()))
    stage.GetPrimAtPath("/Actor").GetAttribute("jaw:formatVersion").Set(99)
    stage.GetRootLayer().Export(str(tmp_path / "newer.usda"))
    assert layer.exists()
    assert "Update jawusd" in run("pose", tmp_path / "newer.usda", "--d", 1, 0, 0, code=3)


def test_the_twist_of_a_pose_is_its_logarithm(actor):
    rig = jawusd.load(actor)
    d = np.array([15.0, -2.0, 1.0])
    np.testing.assert_allclose(rig.twist(d), se3_log(rig.pose(d) @ np.linalg.inv(rig.T_rest)), atol=1e-10)
