"""Every numbered example runs as a user runs it, on the rig of examples/capture, and what it prints is true."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from foreign import environment
from load_script import load_script
from package_copy import ROOT
from pxr import Usd

import jawusd
from jawusd.formats.keys import load_keys
from jawusd.formats.poses import read_poses

EXAMPLES = ROOT / "examples"


def run(folder, name, *arguments, python=sys.executable, code=0):
    """Run an example in a folder and return what it prints."""
    command = [str(python), str(EXAMPLES / name), *map(str, arguments)]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == code, done.stdout[-2000:] + done.stderr[-3000:]
    return done.stdout


def number(pattern, text):
    """Return the number that a pattern finds in a text."""
    return float(re.search(pattern, text)[1])


def test_examples_are_numbered_without_gaps_and_described_in_the_documentation():
    names = sorted(path.name for path in EXAMPLES.glob("*.py"))
    assert [name[:3] for name in names] == [f"{k:02d}_" for k in range(1, len(names) + 1)]
    index = (ROOT / "docs" / "index.md").read_text()
    assert [name for name in names if name not in index] == []


def test_01_build(example_build, tmp_path):
    out, summary = example_build
    text = run(tmp_path, "01_build.py", "-o", out, "--resume")
    assert "tracked 300 of 300 frames, lost none" in text
    error_mm = number(r"farthest mandible vertex: ([\d.]+) mm on average, good enough", text)
    assert abs(error_mm - summary["fit"]["errors"]["holdout"]["mandible"]["mean"]) < 0.01


def test_02_pose_and_validate(example_build, tmp_path):
    actor = example_build[0] / "actor.usda"
    text = run(tmp_path, "02_pose_and_validate.py", actor)
    impossible, count = map(int, re.search(r"(\d+) of (\d+) frames are impossible", text).groups())
    assert 0 < impossible < count and "off the model" in text
    assert f"valid after the repair: {count} of {count}" in text
    rig = jawusd.load(actor)
    frames, poses = read_poses(tmp_path / "poses_valid.csv")
    assert len(frames) == count and rig.validate(poses).valid.all()
    again = run(tmp_path, "02_pose_and_validate.py", actor, "--poses", "poses_valid.csv", "-o", "again.csv")
    assert f"0 of {count} frames are impossible" in again


def test_04_keys_to_usd(example_build, tmp_path):
    actor = example_build[0] / "actor.usda"
    text = run(tmp_path, "04_keys_to_usd.py", actor)
    assert number(r"at whole frames: .* at most ([\d.]+) mm", text) < 1e-3
    assert number(r"half way between: .* at most ([\d.]+) mm", text) < 0.05
    stage = Usd.Stage.Open(str(tmp_path / "anim_shot.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1, 37)
    assert len(load_keys(tmp_path / "anim_shot.keys.json").keys) == 4


def test_05_blender_says_what_it_needs(tmp_path):
    without = [sys.executable, "-I", "-S", str(EXAMPLES / "05_blender.py")]
    done = subprocess.run(without, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 1 and "bpy is not installed here" in done.stdout


def test_05_blender(example_build, tmp_path):
    python = environment("blender45") / "bin" / "python"
    text = run(tmp_path, "05_blender.py", example_build[0] / "anim_capture.usdc", python=python)
    assert "frames 20 .. 319" in text and "Mandible" in text
    assert number(r"travels up to ([\d.]+) mm", text) > 30
    assert (tmp_path / "jaw.blend").stat().st_size > 100_000


@pytest.mark.slow
def test_06_import_csv(tmp_path, monkeypatch, capsys):
    """In this process, so that it can be given the example's capture without a skull, of which it says nothing."""
    example, capture = EXAMPLES / "capture", tmp_path / "capture"
    for file in (file for file in example.rglob("*") if file.is_file()):
        (capture / file.relative_to(example)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, capture / file.relative_to(example))
    text = (capture / "capture.toml").read_text()
    assert 'skull = "scans/skull.ply"\n' in text
    (capture / "capture.toml").write_text(text.replace('skull = "scans/skull.ply"\n', ""))
    script = load_script(EXAMPLES / "06_import_csv.py")
    monkeypatch.setattr(script, "CAPTURE", capture)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["06_import_csv.py"])
    script.main()
    text = capsys.readouterr().out
    assert "300 poses" in text
    assert number(r"rig against the truth: ([\d.]+) mm", text) < 0.3
    assert jawusd.load(tmp_path / "rig_mocap" / "actor.usda").arrays["d_range"][0, 1] > 40


@pytest.mark.slow
def test_07_library_and_retarget(example_build, tmp_path):
    actor = example_build[0] / "actor.usda"
    text = run(tmp_path, "07_library_and_retarget.py", actor)
    assert "500 of 500 frames valid; 100.0% of the steps go the same way" in text
    expected_mm = number(r"expected error ([\d.]+) mm", text)
    assert number(r"would get from a capture: ([\d.]+) mm", text) < 2 * expected_mm < 4
    assert (tmp_path / "people" / "ranges.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "people" / "anim_dee.usdc").exists()
