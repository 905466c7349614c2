"""Figures are drawn from results alone: every file exists, is reproducible, and has no clipped text."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from matplotlib.patches import Rectangle
from PIL import Image
from report_data import experiments

from jawusd.base.errors import OutputError
from jawusd.paper.figures import (
    FIGURES,
    coverage_figure,
    draw_experiments,
    parameter_figure,
    reconstruction_figure,
    synthesis_figure,
)


@pytest.mark.parametrize(("bones", "gaps"), [(True, True), (False, False)])
def test_every_figure_is_a_picture_and_a_drawing(tmp_path, bones, gaps):
    files = draw_experiments(experiments(bones, gaps), tmp_path / "figures")
    assert {path.name for path in files} == {f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")}
    for path in files:
        if path.suffix == ".png":
            with Image.open(path) as picture:
                shown = np.asarray(picture.convert("RGB"))
            assert min(shown.shape[:2]) > 300 and shown.std() > 5
            edge = np.concatenate([shown[0], shown[-1], shown[:, 0], shown[:, -1]])
            assert (edge == 255).all()  # nothing is clipped
        else:
            assert ElementTree.parse(path).getroot().tag.endswith("svg")


def test_equal_results_give_equal_files(tmp_path):
    first, second = (draw_experiments(experiments(), tmp_path / name) for name in ("a", "b"))
    for a, b in zip(first, second, strict=True):
        assert a.read_bytes() == b.read_bytes(), a.name


def test_histograms_count_every_pose_and_say_what_lies_beyond():
    found = experiments()
    for figure, samples in (
        (reconstruction_figure(found), found.of("reconstruction")),
        (synthesis_figure(found), found.of("synthesis")[1:]),
    ):
        for axis, one in zip(figure.axes, samples, strict=False):
            end = axis.get_xlim()[1]
            inside = (one.values_mm <= end).mean()
            bars = sum(patch.get_height() for patch in axis.patches if isinstance(patch, Rectangle))
            assert bars == pytest.approx(100 * inside, abs=1e-9)
            beyond = int((one.values_mm > end).sum())
            assert f"{beyond} of {len(one.values_mm)} beyond" in axis.texts[0].get_text()
        assert "[mm]" in figure.get_supxlabel() and "[%]" in figure.get_supylabel()


def test_coverage_shows_every_pose_and_the_advice():
    found = experiments(sentences=("Record protrusion.",))
    figure = coverage_figure(found.coverage, "someone")
    for index, axis in enumerate(figure.axes):
        captured = axis.lines[0].get_xydata()
        np.testing.assert_array_equal(captured, found.coverage.d[:, [0, index + 1]])
        assert "[mm]" in axis.get_xlabel() and "[mm]" in axis.get_ylabel()
    assert "Record protrusion." in figure.get_suptitle()


def test_a_folder_that_is_a_file_is_one_clear_error(tmp_path):
    (tmp_path / "figures").write_text("")
    with pytest.raises(OutputError, match="figures"):
        draw_experiments(experiments(), tmp_path / "figures")


def test_every_parameter_is_drawn_for_both_models_from_both_sides():
    found = experiments()
    axes = parameter_figure(found).axes
    for k, axis in enumerate(axes[:6]):
        drawn = {tuple(map(tuple, line.get_xydata().round(9))) for line in axis.lines}
        h, v = ((2, 1), (0, 2))[k // 3]
        for path in found.parameter_paths:
            expected = tuple(map(tuple, path.points[:, [h, v]].round(9)))
            assert (expected in drawn) == (path.parameter == k % 3)
