"""The commands on a finished rig: output, JSON and exit codes."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from example_rig import example_motion
from example_tracks import make_tracks
from package_copy import ROOT
from pxr import Usd
from run_jawusd import face_csv, program, run

import jawusd
from jawusd.cli.rig_commands import _info_lines
from jawusd.formats.poses import read_parameters, write_parameters, write_poses
from jawusd.formats.tracks import LostReason, TrackStatus, save_tracks
from jawusd.geometry import se3_exp, se3_log
from jawusd.pipeline.state import BuildState
from jawusd.rig import describe


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
    said = run("encode", actor, tmp_path / "poses.csv", "-o", tmp_path / "d.csv", "--force")
    assert f"{len(frames)} of {len(frames)} poses, 0.000 mm from the model on average, 0.000 mm at most" in said


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


def test_info_states_how_many_held_out_frames_the_tolerance_covers(actor):
    found = describe(actor)
    assert not any("held-out" in line for line in _info_lines(found))
    found["held_out"] = {"share": 0.76, "p95_mm": 4.2, "tolerance_mm": 1.0}
    words = "  76 % of held-out frames lie within the tolerance of 1.0 mm; 95 % within 4.2 mm"
    assert words in _info_lines(found)


def test_info_starts_with_the_verdict_on_the_build(actor, tmp_path):
    folder = shutil.copytree(actor.parent, tmp_path / "out")
    assert json.loads(run("info", folder, "--json"))["verdict"] is None
    verdict = {"grade": "look", "todo": ["Re-record: a protrusion.", "Check the masks."], "because": []}
    BuildState(folder).finish("report", "", [], 0.0, {"file": "report.html", "verdict": verdict})
    for given in (folder, folder / "actor.usda"):
        assert run("info", given).splitlines()[0] == "Usable for animation. Re-record: a protrusion."
    (folder / "build.json").write_text("{}")
    assert "build.json" in run("info", folder).splitlines()[-1] and run("info", folder).startswith("actor someone")


@pytest.mark.slow
def test_info_says_how_a_frame_was_tracked(tmp_path):
    tracks = make_tracks(4)
    tracks.status[1, 1], tracks.lost_reason[1, 1] = TrackStatus.LOST, LostReason.LOW_SCORE
    tracks.lost_value[1, 1], tracks.lost_limit[1, 1] = 0.31, 0.6
    tracks.masks_used[1, 0, 1] = False
    save_tracks(tmp_path / "tracks.npz", tracks)
    text = run("info", tmp_path / "tracks.npz", "--frame", 31).splitlines()
    assert text == [
        "frame 31, upper arch: tracked; mask not used: b",
        "frame 31, lower arch: lost: matched contour 31% of the usual; at least 60% is needed",
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


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("pose", "{actor}", "--d", "1", "2"), 2, "needs three numbers"),
        (("pose", "{actor}", "--d", "1", "2", "nan"), 2, "finite"),
        (("pose", "{tmp}/none.usda", "--d", "1", "2", "3"), 8, "none.usda"),
        (("encode", "{actor}", "{tmp}/nan.csv"), 3, 'column "tx" is nan'),
        (("validate", "{actor}", "{tmp}/empty.csv"), 3, "empty"),
        (("animate", "{actor}", "{tmp}/bad.json"), 3, "must increase"),
        (("animate", "{actor}", "{tmp}/falling.csv"), 3, "frame 2 follows 3"),
        (("animate", "{actor}", "{tmp}/far.csv"), 3, "the limit is +-1e+06 mm"),
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
    (tmp_path / "far.csv").write_text("frame,d1,d2,d3\n1,1e308,0,0\n2,0,0,0\n")
    (tmp_path / "falling.csv").write_text("frame,d1,d2,d3\n3,1,0,0\n2,1,0,0\n")
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
    done = program(command, *given, "-o", tmp_path / out)
    assert "Traceback" not in done.stderr
    if command != "encode" or "\n" not in out:  # a table may be in any folder
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
