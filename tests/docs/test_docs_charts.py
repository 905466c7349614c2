"""The charts of the benchmarks: drawn from the tables of the page, one with each claim."""

import re
import sys

import pytest
from package_copy import ROOT

sys.path.insert(0, str(ROOT / "docs" / "hooks"))

import charts

PAGE = (ROOT / "docs" / "benchmarks.md").read_text()
COMMAND = re.compile(r"`(?:python|pytest|jawusd)\s[^`]*`|^(?:python|jawusd) ", re.M)
TABLE = re.compile(r"^\|(?:-+\|)+$", re.M)


def incomplete(page):
    """Return the titles of sections without a command, a table or a chart."""
    sections = re.split(r"^## ", page, flags=re.M)[1:]
    kinds = (COMMAND, TABLE, charts.MARK)
    return [section.split("\n")[0] for section in sections if not all(kind.search(section) for kind in kinds)]


def test_each_claim_has_a_command_a_table_and_a_chart():
    assert len(PAGE.split("\n## ")) > 20 and incomplete(PAGE) == []
    for part in (r"<!-- chart: .* -->", r"\|-+\|", r"`pytest -m"):
        assert incomplete(re.sub(part, "", PAGE)) != []


def test_charts_draw_the_numbers_of_their_tables():
    drawn = 0
    for found in charts.MARK.finditer(PAGE):
        _, _, names, rows = charts.chosen(PAGE, found)
        assert len(names) <= len(charts.FILLS)
        values = [f"{x:g}" for _, cells in rows for cell in cells for x in cell]
        dots = re.findall(r"<title>([^<]*)</title>", charts.chart(PAGE, found))
        assert dots == values != []
        drawn += len(dots)
    assert drawn > 200
    assert "<!-- chart" not in charts.on_page_markdown(PAGE) and charts.on_page_markdown(PAGE).count("<svg") >= 22


def page_of(mark, *rows):
    return "\n".join(["| a | b | c |", "|---|---|---|", *rows, "", f"<!-- chart: {mark} -->", ""])


def test_the_place_of_a_dot_is_its_number():
    page = page_of("size [mm]", "| x | 0 | 2 |", "| y | 4 / 8 | - |")
    picture = charts.chart(page, charts.MARK.search(page))
    span = charts.RIGHT - charts.LEFT
    places = [float(x) for x in re.findall(r'<circle cx="([\d.]+)"[^>]*><title>', picture)]
    assert places == pytest.approx([charts.LEFT + share * span for share in (0, 0.25, 0.5, 1)], abs=0.01)
    assert picture.count("ring") == 1  # the second number of a cell
    page = page_of("size [mm] | log | rows 2-3 | columns 3-3", "| x | 1 | 5 |", "| y | 1 | 0.1 |", "| z | 1 | 10 |")
    picture = charts.chart(page, charts.MARK.search(page))
    places = [float(x) for x in re.findall(r'<circle cx="([\d.]+)"[^>]*><title>', picture)]
    assert places == pytest.approx([charts.LEFT, charts.RIGHT])


@pytest.mark.parametrize(
    ("cell", "numbers"),
    [
        ("0.09 to 0.14", [0.09, 0.14]),
        ("58 of 64", [90.625]),
        ("1 of 1,200", [100 / 1200]),
        ("2, 3, 4", [2, 3, 4]),
        ("20,000 (on a busy machine)", [20000]),
        ("0.00003 mm", [3e-5]),
        ("rejected", []),
    ],
)
def test_numbers_in_cells(cell, numbers):
    assert charts.numbers(cell) == pytest.approx(numbers)


@pytest.mark.parametrize("mark", ["size [mm] | lines 1-2", "size [mm] | rows"])
def test_options_that_do_not_exist_are_errors(mark):
    page = page_of(mark, "| x | 1 | 5 |")
    with pytest.raises(ValueError, match="has no option"):
        charts.chart(page, charts.MARK.search(page))
    with pytest.raises(ValueError, match="no table before"):
        charts.chart("Words.\n\n<!-- chart: x -->", charts.MARK.search("Words.\n\n<!-- chart: x -->"))
