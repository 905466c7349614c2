"""A capture with boards and no calibration: the build makes one, reports it, and reuses it."""

import json
import shutil

import numpy as np
import pytest
from package_copy import ROOT
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from jawusd.base.errors import CalibrationError
from jawusd.cameras.calibration import load_calibration
from jawusd.capture.boards import find_boards
from jawusd.cli.main import app
from jawusd.cli.text_build import build_lines
from jawusd.cli.text_capture import calibration_lines
from jawusd.geometry import triangulate
from jawusd.pipeline.build import BuildOptions, build
from jawusd.pipeline.calibrate import calibrate_boards
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.workspace import input_files, open_capture

EXAMPLE = ROOT / "examples" / "capture"


class Reached(Exception):
    """Raised to stop a build at a stage."""


def stop_at(stage_name, told):
    """Return a progress callback that ends the build when a stage reports progress."""

    def progress(stage, done, total):
        told.append((stage, done, total))
        if stage == stage_name:
            raise Reached

    return progress


def track_is_reached(*arguments):
    """Replace `first_pass`, which searches the teeth before it reports progress."""
    raise Reached


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("example") / "capture"
    shutil.copytree(EXAMPLE, folder)
    text = (folder / "capture.toml").read_text()
    assert 'calibration = "calibration.toml"\n' in text
    (folder / "capture.toml").write_text(text.replace('calibration = "calibration.toml"\n', ""))
    (folder / "calibration.toml").unlink()
    return folder


@pytest.fixture(scope="module")
def calibrated(capture, tmp_path_factory):
    """The folder of a build that ended before tracking, its findings, and the detected corners of the boards.

    The corners do not depend on the size of the squares.
    """
    out = tmp_path_factory.mktemp("build") / "actor"
    told, corners = [], []

    def kept(*arguments):
        corners.append(find_boards(*arguments))
        return corners[-1]

    with pytest.MonkeyPatch.context() as patched, pytest.raises(Reached):
        patched.setattr("jawusd.capture.calibrate.find_boards", kept)
        patched.setattr("jawusd.pipeline.build.first_pass", track_is_reached)
        build(capture, out, BuildOptions(), stop_at(None, told))
    return out, told, *corners


@pytest.mark.slow
def test_the_build_calibrates_from_the_boards(calibrated):
    out, told, _ = calibrated
    assert ("calibrate", 72, 72) in told
    record = json.loads((out / "build.json").read_text())["stages"]
    assert set(record) == {"check", "calibrate", "sync"}
    assert list(record["calibrate"]["outputs"]) == ["calibration.toml"]
    report = record["calibrate"]["result"]
    assert all(camera["rms_px"] < 0.3 for camera in report["cameras"].values())
    assert report["board_shape"]["mean"] < 0.03 and report["scale"]["ratio"] == pytest.approx(1.0, abs=0.015)
    lines = "\n".join(calibration_lines(report))
    assert "24 views" in lines and "the teeth confirm" in lines and "advice: camera cam0 uses 24 views" in lines


@pytest.mark.slow
def test_lengths_in_the_mouth_are_those_of_the_true_cameras(calibrated):
    out, *_ = calibrated
    found, truth = load_calibration(out / "calibration.toml"), load_calibration(EXAMPLE / "calibration.toml")
    with np.load(EXAMPLE / "truth" / "truth.npz", allow_pickle=False) as archive:
        centre = archive["T_world_upper"][0][:3, 3]
    points = centre + np.random.default_rng(0).uniform(-1, 1, (80, 3)) * [28, 14, 20]
    pixels = np.stack([f.undistort_pixels(t.project(points)) for f, t in zip(found, truth, strict=True)], axis=1)
    seen = np.array([triangulate([c.projection_matrix() for c in found], views) for views in pixels])
    i, j = np.triu_indices(len(points), 1)
    error = np.linalg.norm(seen[i] - seen[j], axis=1) - np.linalg.norm(points[i] - points[j], axis=1)
    assert np.abs(error).mean() < 0.03


@pytest.mark.slow
def test_a_resumed_build_keeps_the_calibration_until_the_boards_change(capture, calibrated, tmp_path, monkeypatch):
    monkeypatch.setattr("jawusd.pipeline.build.first_pass", track_is_reached)
    out = tmp_path / "actor"
    shutil.copytree(calibrated[0], out)
    told = []
    with pytest.raises(Reached):
        build(capture, out, BuildOptions(resume=True), stop_at(None, told))
    assert [entry for entry in told if entry[0] == "calibrate"] == [("calibrate", 1, 1)]
    changed = tmp_path / "changed"
    shutil.copytree(capture, changed)
    text = (changed / "capture.toml").read_text()
    (changed / "capture.toml").write_text(text.replace("square_mm = 8.0", "square_mm = 8.1"))
    with pytest.raises(Reached):
        build(changed, out, BuildOptions(resume=True), stop_at("calibrate", []))


@pytest.mark.slow
def test_a_fresh_build_deletes_the_masks_an_earlier_one_made(capture, tmp_path):
    made = tmp_path / "actor" / "masks" / "cam0" / "upper" / "000031.png"
    made.parent.mkdir(parents=True)
    made.touch()
    (tmp_path / "actor" / "masks" / "segment.jsonl").write_text("{}\n")
    with pytest.raises(Reached):
        build(capture, tmp_path / "actor", BuildOptions(fresh=True), stop_at("check", []))
    assert not (tmp_path / "actor" / "masks").exists()


@pytest.mark.slow
def test_the_summary_of_a_build_says_what_was_made(calibrated):
    out, *_ = calibrated
    record = json.loads((out / "build.json").read_text())["stages"]
    summary = {
        "calibrate": record["calibrate"]["result"], "sync": record["sync"]["result"], "fit": {}, "reused": [],
        "seconds": {}, "folder": str(out), "report": {"file": "report.html"},
        "track": {"tracked": 1, "frames": 1, "lost": [], "recovered": 0, "without_a_camera": 0, "prior_aided": 0,
                  "calibration_rescaled_px": {}, "sigma_mm": {}, "coverage_error_percent": 0.1},
    }  # fmt: skip
    made = "the capture names no calibration: one was made from its boards"
    assert build_lines(summary)[1] == build_lines(summary, verbose=True)[1] == made
    assert len(build_lines(summary, verbose=True)) > len(build_lines(summary))
    assert not any("calibration" in line for line in build_lines(summary | {"calibrate": None}))
    summary["sync"]["notes"] = ["camera b has a variable rate"]
    assert "  note: camera b has a variable rate" in build_lines(summary, verbose=True)


def test_a_calibration_of_colmap_is_read_where_the_capture_names_it(capture, tmp_path):
    folder = tmp_path / "capture"
    shutil.copytree(capture, folder)
    truth = load_calibration(EXAMPLE / "calibration.toml")
    (folder / "model").mkdir()
    lenses, images = [], []
    for k, camera in enumerate(truth):
        K, T = camera.K, camera.T_cam_world
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        lens = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *camera.distortion[:4]]
        lenses.append(f"{k} OPENCV 1280 720 {' '.join(map(repr, map(float, lens)))}")
        place = [w, x, y, z, *(T[:3, 3] / 1000)]
        images += [f"{k} {' '.join(map(repr, map(float, place)))} {k} {camera.name}.png", ""]
    (folder / "model" / "cameras.txt").write_text("\n".join(lenses))
    (folder / "model" / "images.txt").write_text("\n".join(images))
    text = (folder / "capture.toml").read_text()
    named = 'fps = 24.0\ncalibration = "model"\ncalibration_unit_mm = 1000.0\n'
    (folder / "capture.toml").write_text(text.replace("fps = 24.0\n", named))
    opened = open_capture(folder)
    for found, wanted in zip(load_cameras(opened), truth, strict=True):
        np.testing.assert_allclose(found.K, wanted.K, atol=1e-9)
        np.testing.assert_allclose(found.T_cam_world, wanted.T_cam_world, atol=1e-7)
    assert [path.name for path in input_files(opened, ["calibration"])["calibration"]] == ["cameras.txt", "images.txt"]


def unpicked(capture, tmp_path, offsets=None, **boards):
    """Return the capture without picks, with given offsets and another description of the boards."""
    opened = open_capture(capture)
    update = {
        "bootstrap": None,
        "boards": opened.boards.model_copy(update=boards),
        "sync": opened.sync.model_copy(update={"offsets": offsets}),
    }
    return opened.model_copy(update=update), tmp_path / "calibration.toml"


@pytest.mark.slow
def test_without_picks_masks_tell_the_size_of_the_squares(capture, calibrated, tmp_path, monkeypatch):
    out, _, corners = calibrated
    monkeypatch.setattr("jawusd.capture.calibrate.find_boards", lambda *arguments: corners)
    offsets = json.loads((out / "build.json").read_text())["stages"]["sync"]["result"]["offsets"]
    report = calibrate_boards(*unpicked(capture, tmp_path, offsets), lambda *told: None)
    assert report["scale"]["ratio"] == pytest.approx(1.0, abs=0.01)
    assert any("the teeth confirm the board's size" in line for line in calibration_lines(report))
    with pytest.raises(CalibrationError, match=r"squares of 9 mm would have to be (7\.9|8\.0)\d mm"):
        calibrate_boards(*unpicked(capture, tmp_path, offsets, square_mm=9.0), lambda *told: None)


@pytest.mark.slow
def test_without_picks_and_masks_the_size_is_said_to_be_unknown(capture, calibrated, tmp_path, monkeypatch):
    monkeypatch.setattr("jawusd.capture.calibrate.find_boards", lambda *arguments: calibrated[2])
    opened, out = unpicked(capture, tmp_path, square_mm=9.0)
    bare = tuple(camera.model_copy(update={"masks": None}) for camera in opened.cameras)
    report = calibrate_boards(opened.model_copy(update={"cameras": bare}), out, lambda *told: None)
    assert report["scale"]["ratio"] is None
    note = "the scale relies on [boards] square_mm alone: no picks are seen by two cameras"
    assert any(note in line for line in calibration_lines(report))
    # Clips that cannot be aligned are no error: the boards are already aligned.
    unaligned = opened.model_copy(update={"sync": opened.sync.model_copy(update={"method": "audio"})})
    report = calibrate_boards(unaligned, out, lambda *told: None)
    assert report["scale"]["ratio"] is None and "sound" in report["scale"]["reason"]


def test_the_command_refuses_to_overwrite_and_asks_for_boards(capture, tmp_path):
    (tmp_path / "c.toml").write_text("precious")
    result = CliRunner().invoke(app, ["calibrate", str(capture), "-o", str(tmp_path / "c.toml")])
    assert result.exit_code != 0 and (tmp_path / "c.toml").read_text() == "precious"
    folder = tmp_path / "capture"
    shutil.copytree(capture, folder)
    text = (folder / "capture.toml").read_text()
    first, last = text.index("[boards]"), text.index("[sync]")
    (folder / "capture.toml").write_text(text[:first] + text[last:])
    result = CliRunner().invoke(app, ["calibrate", str(folder), "-o", str(tmp_path / "new.toml")])
    assert isinstance(result.exception, CalibrationError) and "has no [boards]" in str(result.exception)
    assert not (tmp_path / "new.toml").exists()
