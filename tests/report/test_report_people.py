"""The bars of several actors match their ranges, each in the row of its name."""

import pytest

from jawusd.report.figures import ranges_figure


def test_bars_lie_where_the_ranges_do():
    people = [
        ("Anna", {"opening": [0.0, 42.0], "laterotrusion": [-9.0, 8.0], "protrusion": [-1.0, 6.0]}),
        ("Bert", {"opening": [0.0, 37.0], "laterotrusion": [-5.0, 7.0], "protrusion": [-0.5, 4.0]}),
    ]
    figure = ranges_figure(people)
    for axis, key in zip(figure.axes, people[0][1], strict=True):
        for row, (_, ranges) in enumerate(people):
            bar = axis.patches[row]
            assert [bar.get_x(), bar.get_x() + bar.get_width()] == pytest.approx(ranges[key])
            assert bar.get_y() < row < bar.get_y() + bar.get_height()
    first = figure.axes[0]
    named = dict(zip(first.get_yticks(), [label.get_text() for label in first.get_yticklabels()], strict=True))
    assert named == {0: "Anna", 1: "Bert"}
