"""The report of a finished build: written again, with missing parts named, and reused by --resume."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from example_rig import FPS, example_meshes
from report_data import report_data
from typer.testing import CliRunner

from jawusd.base.errors import FormatError
from jawusd.cli.main import app
from jawusd.cli.text_build import build_lines
from jawusd.evaluator import JawRig
from jawusd.formats.model import load_model, save_model
from jawusd.formats.tracks import load_tracks, save_tracks
from jawusd.pipeline.pictures import chosen_frames
from jawusd.pipeline.report import missing_packages, report_build
from jawusd.pipeline.state import BuildState
from jawusd.rig.bake import bake_rig


def quiet(stage, done, total):
    """Ignore progress."""


def baked(folder, model, meshes):
    rig = JawRig(model.arrays, model.meta)
    return bake_rig(folder, rig, meshes, name="someone", fps=FPS, frames=model.frames, d=model.d, table_size=17)


@pytest.fixture
def built(tmp_path):
    """Return a folder as written by a build, whose capture is missing."""
    data = report_data(count=90)
    model = data.model
    files = baked(tmp_path, model, example_meshes())
    save_model(tmp_path / "model.npz", model)
    save_tracks(tmp_path / "tracks.npz", data.tracks)
    state = BuildState(tmp_path)
    state.finish("sync", "", [], 1.0, dict(data.sync))
    state.finish("bake", "", files, 1.0, {})
    state.finish("report", "as built", [], 1.0, {"capture": "../gone"})
    return tmp_path


def test_a_report_without_its_capture_says_what_it_lacks(built):
    path = report_build(built, None, quiet)
    text = (built / "report.html").read_text()
    assert path.stat().st_size == len(text.encode()) < 6e6
    assert "example: jaw rig report" in text and "the capture cannot be read" in text
    assert "report DIR --experiments" in text and "replay-data" in text
    record = BuildState(built).valid("report", "as built")  # as --resume tests it
    assert record is not None and list(record.outputs) == ["report.html"]
    verdict = {"grade": "good", "todo": [], "because": []}
    assert record.result == {"capture": "../gone", "file": "report.html", "verdict": verdict}


def test_a_report_written_again_tells_of_the_build_as_it_was_made(built):
    state = BuildState(built)
    made = {"finished": "2031-02-03 04:05:06 UTC", "command": "jawusd build there", "versions": {"numpy": "9.8.7"}}
    state.finish("report", "as built", [], 1.0, {"capture": "../gone", "origin": made})
    report_build(built, None, quiet)
    text = (built / "report.html").read_text()
    assert made["finished"] in text and made["command"] in text and "numpy 9.8.7" in text
    assert BuildState(built).stages["report"].result["origin"] == made


@pytest.mark.slow
def test_a_placeholder_is_not_shown_as_a_mandible(built):
    report_build(built, None, quiet)
    assert "placeholder is not anatomical" not in (built / "report.html").read_text()
    scans = {name: mesh for name, mesh in example_meshes().items() if name != "mandible"}
    files = baked(built, load_model(built / "model.npz"), scans)
    BuildState(built).finish("bake", "", files, 1.0, {})
    report_build(built, None, quiet)
    assert "the rig&#39;s placeholder is not anatomical" in (built / "report.html").read_text()


@pytest.mark.slow
def test_the_experiments_of_a_build_go_into_its_report(built, monkeypatch):
    """With the paper's networks, which a build omits; a report does not depend on the length of training."""
    monkeypatch.setattr("jawusd.paper.nlpca._STAGES", (60, 100))
    tracks = load_tracks(built / "tracks.npz")
    sure = {name: 1e-6 * getattr(tracks, f"covariance_{name}") for name in ("upper", "lower", "relative")}
    save_tracks(built / "tracks.npz", replace(tracks, **{f"covariance_{name}": value for name, value in sure.items()}))
    report_build(built, None, quiet)
    without = (built / "report.html").read_text()
    result = CliRunner().invoke(app, ["report", str(built), "--experiments", "--starts", "1", "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    names = {Path(file).name for file in found["files"]}
    assert {"fig5_condyle_path.png", "fig12_reconstruction.svg", "fig13_synthesis.png", "experiments.csv"} < names
    assert {Path(file).parent for file in found["files"]} == {built / "experiments", built}
    text = (built / "report.html").read_text()
    networks = {row["model"] for row in found["table"] if "nlpca" in row["model"].lower()}
    assert networks and all(name in text and name not in without for name in networks)
    assert "adds them to the" in without and "adds them to the" not in text
    assert len(text.encode()) < 6e6


def test_a_folder_that_is_no_build_is_one_clear_error(tmp_path):
    with pytest.raises(FormatError, match="not the folder of a build"):
        report_build(tmp_path, None, quiet)


def test_missing_packages_are_named_with_the_cure(monkeypatch):
    assert missing_packages() is None

    for name in [name for name in sys.modules if name.startswith("jawusd.report")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    missing = missing_packages()
    assert "matplotlib" in missing and "jawusd[build]" in missing
    track = {
        "tracked": 1,
        "frames": 1,
        "lost": [],
        "recovered": 0,
        "without_a_camera": 0,
        "calibration_rescaled_px": {},
    }
    summary = {
        "sync": {"method": "given", "offsets": {}},
        "track": {
            **track,
            "calibration_rescaled_px": {},
            "prior_aided": 0,
            "sigma_mm": {},
            "coverage_error_percent": None,
        },
        "fit": {},
        "seconds": {},
        "reused": [],
        "calibrate": None,
        "folder": "out",
        "report": {"capture": "..", "missing": missing},
    }
    verdict, *_, report, _ = build_lines(summary)
    assert report.startswith("report: none: ") and verdict.startswith("No verdict") and json.dumps(summary)


def test_the_worst_frames_are_chosen_apart_and_one_usual_one():
    tracks = report_data(count=90, lost=(40,)).tracks
    tracks.coverage_error[:] = 0.005 + 1e-5 * np.arange(90)[::-1, None, None]
    tracks.coverage_error[[10, 11, 60]] = np.array([0.05, 0.06, 0.04])[:, None, None]
    tracks.coverage_error[40] = 0.5  # lost: nothing to draw there
    tracks.sigma_mm[75, 4] = 3.0
    rows = [row for row, _ in chosen_frames(tracks, fps=24.0)]
    assert rows[:2] == [11, 60] and 75 in rows and 40 not in rows and 10 not in rows
    assert all(abs(a - b) >= 12 for k, a in enumerate(rows[:-1]) for b in rows[:k])
    assert len(rows) == 6
