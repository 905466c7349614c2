"""The page of a made-up solved performance: counts, names and drawings."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from report_data import FPS, report_data, solve_data

from jawusd.base.errors import FormatError
from jawusd.report.solve_page import jaw_figure, observation_figure, solve_page, unobserved_runs


def text_of(page):
    """Return the visible text, without tags."""
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
    assert "1.0200 ± 0.0030" in text and "not used" in text and "Limited by having one camera" in text
    runs = unobserved_runs(data, data.tracks.solved)
    assert [(run.first - first, run.last - first, run.arches, run.sigma) for run in runs] == [
        (10, 14, "lower", "1.00, 0.50, 0.25"),
        (30, 30, "upper and lower", "3.00, 3.00, 3.00"),
    ]
    assert runs[1].seconds == f"{(first + 30) / FPS:.2f} to {(first + 31) / FPS:.2f}"


def test_runs_end_where_frames_are_missing():
    data = solve_data()
    data.tracks.frames[12:] += 5
    runs = unobserved_runs(data, data.tracks.solved)
    assert [run.last - run.first for run in runs] == [1, 2, 0]


def test_a_good_take_says_so():
    data = solve_data()
    good = replace(data.tracks.solved, state=np.ones(60, np.int8), valid=np.ones(60, bool))
    data.tracks.solved, data.tracks.meta["findings"] = good, []
    text = text_of(solve_page(data))
    assert "Both arches were found in every frame, and every pose is valid for the rig." in text
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
    figure = observation_figure(data.tracks, data.tracks.solved, FPS)
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert names == ["solved  54", "skin  0", "carried  5", "lost  1", "within tolerance  1", "outside  2"]


def test_tracks_that_no_solve_made_are_refused():
    with pytest.raises(FormatError, match="has no solved performance"):
        solve_page(solve_data(tracks=report_data().tracks))
