"""Reports of takes with little or no data: no errors, and no good grades for unknown values."""

from dataclasses import replace

import numpy as np
import pytest
from report_data import document, experiments, report_data, solve_data

from jawusd.paper.figures import condyle_figure, inline_figures, parameter_figure
from jawusd.report import document as report_document
from jawusd.report.solve_page import solve_page
from jawusd.report.verdicts import GOOD, OPEN, judge

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")  # division by zero, mean of an empty array


def rows_of(tracks, rows):
    """Return the tracks restricted to some frames."""
    count = len(tracks.frames)
    values = {name: getattr(tracks, name) for name in tracks.__dataclass_fields__}
    cut = {n: v[rows] for n, v in values.items() if isinstance(v, np.ndarray) and len(v) == count}
    return replace(tracks, **cut)


def cut_data(rows):
    """Return report data restricted to some frames."""
    data = report_data(experiments=None)
    model = data.model
    cut = {name: getattr(model, name)[rows] for name in ("frames", "d", "residual_mm", "trained")}
    return replace(data, tracks=rows_of(data.tracks, rows), model=replace(model, **cut))


@pytest.mark.parametrize("rows", [slice(0, 0), slice(7, 8)], ids=["no frame", "one frame"])
def test_a_take_of_no_frame_or_one(rows):
    data = cut_data(rows)
    assert "nan" not in document(data).lower().split()
    verdicts = {verdict.stage: verdict for verdict in judge(data)}
    if rows.stop == 0:
        assert verdicts["track"].grade == OPEN
        assert [check.grade for check in verdicts["bounds"].checks] == [OPEN, OPEN]
        assert all(check.grade != GOOD for check in verdicts["fit"].checks if "frames" in check.name)


def test_a_take_in_which_everything_is_lost():
    data = report_data(lost=range(60), experiments=None)
    data.model.d[:] = np.nan
    data.tracks.sigma_mm[:] = data.tracks.residual_px[:] = data.tracks.coverage_error[:] = np.nan
    data.tracks.masks_used[:] = False
    assert "nan" not in document(data).lower().split()


def test_error_tables_of_nothing_show_dashes():
    data = report_data()
    unknown = dict.fromkeys(("mean", "median", "p95", "max"), np.nan)
    data.model.meta["errors"]["holdout"]["incisor"] = {**unknown, "frames": 0}
    text = document(data)
    assert text.count('<td class="number">\u2013</td>') == 4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reconstruction", "synthesis"])
def test_experiments_that_found_no_poses(name):
    found = experiments()
    empty = tuple(replace(one, values_mm=np.empty(0)) if one.experiment == name else one for one in found.distances)
    for distances in (empty, tuple(one for one in found.distances if one.experiment != name)):
        few = replace(found, distances=distances)
        assert report_document.document(report_data(experiments=few), inline_figures(few))


def test_experiments_without_paths_or_captured_poses():
    found = experiments()
    coverage = replace(found.coverage, d=np.empty((0, 3)))
    few = replace(found, condyle_paths=(), parameter_paths=(), captured_condyles=np.empty((2, 0, 3)), coverage=coverage)
    for figure in (condyle_figure(few), parameter_figure(few)):
        assert "no model" in figure.axes[0].texts[0].get_text()
    assert document(report_data(experiments=few))


@pytest.mark.parametrize("alone", range(3))
def test_experiments_of_one_parameter(alone):
    found = experiments()
    paths = tuple(path for path in found.parameter_paths if path.parameter == alone)
    figure = parameter_figure(replace(found, parameter_paths=paths))
    assert paths and ["mm" in axis.get_title() for axis in figure.axes[:3]] == [k == alone for k in range(3)]


@pytest.mark.parametrize("rows", [slice(0, 0), slice(7, 8)], ids=["no frame", "one frame"])
def test_a_performance_of_no_frame_or_one(rows):
    data = solve_data()
    solved = data.tracks.solved
    cut = {name: getattr(solved, name)[rows] for name in solved.__dataclass_fields__}
    tracks = rows_of(data.tracks, rows)
    tracks.solved = replace(solved, **cut)
    assert "nan" not in solve_page(replace(data, tracks=tracks)).lower().split()
