"""The commands calibrate and sync on small clips written by the tests."""

import csv
import json

import numpy as np
import pytest
from boards import board, chessboard, photograph, poses, studio
from typer.testing import CliRunner

from jawusd.base.errors import CaptureError, SyncError
from jawusd.cameras.calibration import load_calibration
from jawusd.cli.main import app
from jawusd.media.writers import VideoWriter


def film(path, start, fps=24.0):
    """Write a clip with two flashes of different length."""
    path.parent.mkdir(exist_ok=True)
    with VideoWriter(path, (64, 48), fps) as writer:
        for frame in range(start, start + 120):
            dark = 20 <= frame < 26 or 90 <= frame < 98
            writer.write(np.full((48, 64), 15 if dark else 120, np.uint8))
    return str(path)


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_sync_aligns_any_clips(tmp_path):
    clips = [film(tmp_path / f"{name}.mp4", start) for name, start in {"A": 0, "B": 5, "C": -3}.items()]
    result = json.loads(run("sync", *clips, "--json").stdout)
    assert result["offsets"] == {"A": 0, "B": 5, "C": -3} and result["method"] == "light flash"
    result = json.loads(run("sync", *clips, "--reference", "B", "--json", "--curves", tmp_path / "c.csv").stdout)
    assert result["offsets"] == {"A": -5, "B": 0, "C": -8} and result["reference"] == "B"
    rows = list(csv.DictReader((tmp_path / "c.csv").read_text().splitlines()))
    assert len(rows) == 360 and set(rows[0]) == {"camera", "picture", "time_s", "brightness"}
    assert float(rows[22]["brightness"]) < 30 < float(rows[0]["brightness"])
    lines = run("sync", *clips).stdout.splitlines()
    assert lines[0] == "by light flash:" and lines[2].startswith("  B: +5 frames (exactly +5.0")
    assert run("sync", *clips, "--curves", tmp_path / "c.csv").exit_code != 0


def test_sync_draws_the_clips_before_and_after(tmp_path):
    clips = [film(tmp_path / f"{name}.mp4", start) for name, start in {"A": 0, "B": 5}.items()]
    assert run("sync", *clips, "--plot", tmp_path / "sync.svg").exit_code == 0
    drawn = (tmp_path / "sync.svg").read_text()
    for words in ("A +0, B +5 frames", "as recorded, first flash", "aligned, last flash", "light off"):
        assert words in drawn
    assert run("sync", *clips, "--plot", tmp_path / "sync.svg").exit_code != 0  # the output exists
    assert run("sync", *clips, "--plot", tmp_path / "sync.pdf").exit_code == 2
    # The plot is drawn even if a clip cannot be aligned.
    dim = [film(tmp_path / "dim" / name, start=200) for name in ("C.mp4", "D.mp4")]
    result = run("sync", *dim, "--plot", tmp_path / "dim.png")
    assert isinstance(result.exception, SyncError) and "shows no light flash" in str(result.exception)
    assert "no clip has sound" in str(result.exception)
    assert (tmp_path / "dim.png").read_bytes()[:4] == b"\x89PNG"


def test_clips_of_one_name_are_told_apart_by_their_folders(tmp_path):
    clips = [film(tmp_path / name / "take.mp4", start) for name, start in {"A": 0, "B": 2}.items()]
    assert json.loads(run("sync", *clips, "--json").stdout)["offsets"] == {clips[0]: 0, clips[1]: 2}
    assert run("sync", clips[0], clips[0]).exit_code == 2
    assert run("sync", *clips, "--reference", "C").exit_code == 2


def test_rates_that_differ_are_refused(tmp_path):
    result = run("sync", film(tmp_path / "a.mp4", 0), film(tmp_path / "b.mp4", 0, fps=30.0))
    assert isinstance(result.exception, CaptureError)
    assert "camera b has 30 frames per second, but camera a has 24" in str(result.exception)


CAPTURE = """
format = "jawusd-capture/1"
name = "x"
units = "mm"
fps = 24.0
[scans]
upper_teeth = "u.ply"
lower_teeth = "l.ply"
[[camera]]
name = "c0"
video = "c0.mp4"
[[camera]]
name = "c1"
video = "c1.mp4"
[boards]
cols = 9
rows = 6
square_mm = 5.0
videos = ["c0.mp4", "c1.mp4"]
"""


@pytest.fixture
def capture(tmp_path):
    import trimesh

    cameras, T_world_board = studio(lens=(0.0, 0.0))[:2], poses(12, np.random.default_rng(0), tilt=0.4)
    texture, to_texture = chessboard(board())
    for camera in cameras:
        with VideoWriter(tmp_path / f"{camera.name}.mp4", (640, 480), 24.0, quality_crf=8) as writer:
            for T in np.repeat(T_world_board, 2, axis=0):
                writer.write(photograph(camera, T, texture, to_texture))
    for name in ("u", "l"):
        trimesh.creation.box((60, 10, 50)).subdivide().subdivide().export(tmp_path / f"{name}.ply")
    (tmp_path / "capture.toml").write_text(CAPTURE)
    return tmp_path, cameras


@pytest.mark.slow
def test_calibrate_writes_cameras_and_report(capture, tmp_path):
    folder, truth = capture
    result = run("calibrate", folder, "-o", tmp_path / "out.toml", "--report", tmp_path / "report.json", "--json")
    assert result.exit_code == 0, result.exception
    found = load_calibration(tmp_path / "out.toml")
    assert [camera.name for camera in found] == ["c0", "c1"]
    for a, b in zip(found, truth, strict=True):
        assert a.K[0, 0] == pytest.approx(b.K[0, 0], rel=0.02)
        assert np.linalg.norm(a.centre_world() - b.centre_world()) < 3.0
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["views"] == 12 and report["cameras"]["c1"]["rms_px"] < 0.2 and report["file"].endswith("out.toml")
    assert any("square_mm alone" in note for note in report["notes"])
    assert run("calibrate", folder, "-o", tmp_path / "out.toml").exit_code != 0
