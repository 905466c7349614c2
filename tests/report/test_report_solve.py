"""The page of a solved performance: what it counts, names and draws, from a performance made up here."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from report_data import report_data

from jawusd.errors import FormatError
from jawusd.formats.performance import SolveState
from jawusd.formats.report import CameraFacts, Overlay, SolveReportData
from jawusd.formats.solved import SolvedJaw
from jawusd.formats.tracks import LOST
from jawusd.report.solve_figures import jaw_figure, seen_figure
from jawusd.report.solve_page import solve_page, unseen_runs

FPS = 24.0


def solve_data(**change):
    """Return a performance of 60 frames: 10-14 out of sight (lower arch), 30 lost (both), 40 and 41 outside."""
    tracks = report_data().tracks
    count = len(tracks.frames)
    state, valid, margin = np.ones(count, np.int8), np.ones(count, bool), np.full(count, 2.0)
    sigma = np.full((count, 3), 0.05)
    state[10:15], state[30] = SolveState.CARRIED, SolveState.LOST
    tracks.status[10:15, 1] = tracks.status[30] = LOST
    sigma[10:15], sigma[30] = [1.0, 0.5, 0.25], 3.0
    valid[40:42], margin[40:42] = False, -0.7
    margin[45] = -0.2
    d = np.stack([np.linspace(0, 30, count), np.linspace(-4, 4, count), np.zeros(count)], axis=1)
    tracks.solved = SolvedJaw(d, sigma, margin, state, valid)
    tracks.meta["tolerance_mm"], tracks.meta["focal"] = 0.3, {"cam1": [1.02, 0.003]}
    tracks.meta["findings"] = [{"kind": "x", "severity": "warning", "message": "masks <are> wide", "camera": "cam1"}]
    values = {
        "shot": "take & one",
        "tracks": tracks,
        "fps": FPS,
        "limits": "having one camera",
        "cameras": (CameraFacts("cam0", "cam0.mp4", "", (640, 360)), CameraFacts("cam2", "", "", (640, 360))),
        "overlays": (Overlay(int(tracks.frames[30]), "lost <here>", b"\xff\xd8\xff\xd9"),),
        "versions": {"jawusd": "1.2.3"},
        "left_out": (),
    }
    return replace(SolveReportData(**values), **change)


def text_of(page):
    """Return what a reader sees, without tags."""
    parts = []
    reader = HTMLParser()
    reader.handle_data = parts.append
    reader.feed(re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL))
    return " ".join(" ".join(parts).split())


def test_the_page_counts_and_names_what_was_not_seen():
    data = solve_data()
    first = int(data.tracks.frames[0])
    text = text_of(solve_page(data))
    assert "take & one: solved performance" in text
    for words in ("solved 54 frames (90.0 %)", "carried 5 frames (8.3 %)", "lost 1 frame (1.7 %)"):
        assert words in text
    assert "within tolerance 1 frame (1.7 %)" in text
    assert "outside 2 frames (3.3 %)" in text
    assert f"{first + 10}–{first + 14}" in text and "masks <are> wide" in text and "lost <here>" in text
    assert "1.0200 ± 0.0030" in text and "not solved with" in text and "Limited by having one camera" in text
    runs = unseen_runs(data, data.tracks.solved)
    assert [(run.first - first, run.last - first, run.arches, run.sigma) for run in runs] == [
        (10, 14, "lower", "1.00, 0.50, 0.25"),
        (30, 30, "upper and lower", "3.00, 3.00, 3.00"),
    ]
    assert runs[1].seconds == f"{(first + 30) / FPS:.2f} to {(first + 31) / FPS:.2f}"


def test_runs_end_where_frames_are_missing():
    data = solve_data()
    data.tracks.frames[12:] += 5
    runs = unseen_runs(data, data.tracks.solved)
    assert [run.last - run.first for run in runs] == [1, 2, 0]


def test_a_good_take_says_so():
    data = solve_data()
    good = replace(data.tracks.solved, state=np.ones(60, np.int8), valid=np.ones(60, bool))
    data.tracks.solved, data.tracks.meta["findings"] = good, []
    text = text_of(solve_page(data))
    assert "Every frame was seen, and every pose is one that the rig allows." in text
    assert "Both arches were found in every frame." in text


def test_the_page_asks_for_nothing_and_draws_the_values():
    data = solve_data()
    page = solve_page(data)
    assert not re.search(r"(?:src|href)=\"(?!data:|#)", page)
    figure = jaw_figure(data.tracks, data.tracks.solved, FPS)
    for k, axis in enumerate(figure.axes[:3]):
        np.testing.assert_allclose(axis.lines[0].get_ydata(), data.tracks.solved.d[:, k])
        band = axis.collections[0].get_paths()[0].vertices
        widest = 2 * 2 * data.tracks.solved.sigma_mm[30, k]
        at = band[np.abs(band[:, 0] - data.tracks.frames[30]) < 1e-9, 1]
        assert np.ptp(at) == pytest.approx(widest)
        assert "[mm]" in axis.get_ylabel()
    names = [label.get_text() for label in seen_figure(data.tracks, data.tracks.solved, FPS).axes[0].get_yticklabels()]
    assert names == ["solved  54", "carried  5", "lost  1", "within tolerance  1", "outside  2"]


def test_tracks_that_no_solve_made_are_refused():
    with pytest.raises(FormatError, match="holds no solved performance"):
        solve_page(solve_data(tracks=report_data().tracks))
