"""Control characters in names and texts of files are printed as escapes: terminal, pipe, log, report, CSV."""

import csv
import io
import re
from dataclasses import replace

import pytest
from example_rig import FPS, example_meshes, example_rig
from package_copy import ROOT
from report_data import report_data
from typer.testing import CliRunner

from jawusd.base.errors import FormatError, shown
from jawusd.cli.main import app
from jawusd.cli.output import complain, emit, logged, say
from jawusd.formats.atomic import write_csv_atomic
from jawusd.formats.finding import Finding
from jawusd.report.document import document, draw_figures
from jawusd.report.style import figure_bytes, new_figure
from jawusd.rig.bake import bake_rig

#: Each with the part that must not be printed.
HOSTILE = {
    "clears the screen": "Anna\x1b[2J\x1b[31m",
    "C1 control": "Anna\x9b31m",
    "title": "Anna\x1b]0;root\x07",
    "turns the direction": "Anna\u202egnp.exe\u2066",
    "another line": "Anna\njawusd: all files deleted",
    "overwrites": "Anna\rBert\b\b",
    "invisible": "An\u200bna\ufeff\U000e0041",
    "lines of Unicode": "Anna\u2028x\u2029y\x85z",
    "bytes": "Anna\udcff",
    "formula": "Anna$\\frac{$\x1b",
}
_CONTROLS = re.compile(
    "[\x00-\x09\x0b-\x1f\x7f-\x9f\u200b\u202a-\u202e\u2028\u2029\u2066\ufeff\U000e0041\ud800-\udfff]"
)
every_text = pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)


def is_harmless(printed, lines=1):
    return not _CONTROLS.search(printed) and printed.rstrip("\n").count("\n") == lines - 1


@every_text
def test_lines_errors_and_findings_are_harmless(text, capsys, tmp_path):
    say(text)
    emit({}, False, [text])
    said = capsys.readouterr().out
    assert is_harmless(said, 2) and said.startswith("An")
    complain(FormatError(f'holds "{text}".', path=tmp_path / text, camera=text, hint=text))
    assert is_harmless(capsys.readouterr().err)
    assert is_harmless(Finding("kind", "warning", text, path=text, camera=text, hint=text).line())
    listed = FormatError(f"has errors:\n  {Finding('kind', 'error', text).line()}\n  error: other.")
    complain(listed)
    assert is_harmless(capsys.readouterr().err, 3)


def test_ordinary_names_are_printed_as_they_are():
    persian = "\u0645\u06cc\u200c\u062e\u0648\u0627\u0647\u0645"
    family = "\U0001f468\u200d\U0001f469\u200d\U0001f467 \u2764\ufe0f"
    for text in ("Zoë Müller", persian, family, "a\\b $5"):
        assert shown(text) == text
    assert shown(b"a\xff".decode(errors="surrogateescape")) == r"a\xff" and shown("a\x1b") == r"a\x1b"


@every_text
def test_logs_are_harmless(text, tmp_path):
    with logged(tmp_path / "run.log", ["info", text]) as log:
        say(text)
        log.error(FormatError(text, path=text))
    assert not _CONTROLS.search((tmp_path / "run.log").read_text(encoding="utf-8").replace("\t", ""))
    assert "all files deleted" not in re.findall(r"(?m)^ *[\d.]+  jawusd: (.*)$", (tmp_path / "run.log").read_text())


@every_text
def test_tables_are_harmless(text, tmp_path):
    write_csv_atomic(tmp_path / "t.csv", ["name", "mm"], [{"name": text, "mm": 1.5}])
    written = (tmp_path / "t.csv").read_text()
    assert is_harmless(written, 2)
    assert next(csv.DictReader(io.StringIO(written))) == {"name": shown(text), "mm": "1.5"}


@every_text
def test_figures_are_harmless(text):
    figure, (axis,) = new_figure(3, 2, 1, 1)
    axis.plot([0, 1], [0, 1], label=text)
    axis.set_title(text)
    axis.legend()
    drawn = figure_bytes(figure, "svg", 50).decode()
    assert not _CONTROLS.search(drawn)
    assert figure_bytes(figure, "png", 50)[:4] == b"\x89PNG"


@pytest.fixture(scope="module")
def report():
    """Return the data of a report, and its plots, in which no text stands."""
    data = report_data(count=40)
    return data, draw_figures(data)


@every_text
def test_reports_are_harmless(report, text):
    data, figures = report
    found = Finding("x", "warning", text, camera=text)
    hostile = replace(data, actor=text, left_out=(text,), inferred=(text,), findings=(found,), hashes={text: text})
    page = document(hostile, figures)
    assert not _CONTROLS.search(page)
    assert text.encode(errors="replace") not in page.encode() and "Anna" in page or "An" in page


@pytest.mark.parametrize("command", [["info"], ["validate"], ["pose", "--d", "5", "0", "0"]])
def test_commands_on_a_rig_of_a_hostile_name_are_harmless(tmp_path, command):
    rig = example_rig()
    rig.meta["actor"] = HOSTILE["clears the screen"]
    bake_rig(tmp_path, rig, example_meshes(), name=HOSTILE["clears the screen"], fps=FPS, table_size=17)
    name, *options = command
    done = CliRunner().invoke(app, [name, str(tmp_path), *options])
    assert done.output and not _CONTROLS.search(done.output), done.output
    assert name != "info" or r"\x1b[2J" in done.output


def test_one_place_prints():
    """All printing of the command line goes through `output`, which escapes control characters."""
    for path in (ROOT / "jawusd" / "cli").glob("*.py"):
        text = path.read_text()
        assert path.name == "output.py" or not re.search(r"typer\.(echo|secho)\(|\bprint\(", text), path
