"""Conventions of a command-line program: help, versions, completion, logs, Ctrl+C, plans, exit codes."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time

import pytest
import typer
from package_copy import ROOT
from short_example import write_short
from typer.testing import CliRunner

from jawusd import __version__
from jawusd.base import errors
from jawusd.cli.commands import EXAMPLES, EXIT_CODES, GROUPS, SUMMARIES, help_row, with_vectors_split
from jawusd.cli.main import app
from jawusd.cli.text_build import build_lines, rounded_duration

COMMANDS = typer.main.get_command(app).commands
WIDTH = {"COLUMNS": "80", "TERMINAL_WIDTH": "80"}


def run(*words):
    return CliRunner(env=WIDTH).invoke(app, [str(word) for word in words])


def test_help_fits_80_columns_and_every_summary_is_whole():
    for flag in ("-h", "--help"):
        printed = run(flag).stdout
        assert max(map(len, printed.splitlines())) <= 80 and "..." not in printed.split("Start:")[1]
        for name, command in COMMANDS.items():
            assert f"{name} " in printed and SUMMARIES[name] in printed and command.short_help == SUMMARIES[name]
    assert set(COMMANDS) == set(SUMMARIES)


def test_every_command_is_in_one_group_of_the_help():
    printed = run("--help").stdout
    assert sum(map(len, GROUPS.values())) == len(SUMMARIES) == len(COMMANDS)
    for group, names in GROUPS.items():
        part = printed.split(f"\n{group}:\n")[1].split("\n\n")[0]
        assert [line.split()[0] for line in part.splitlines()] == list(names)


def parsed(line):
    """Parse a command line as the program does, but without reading the files that it names."""
    _, name, *words = shlex.split(line)
    command = COMMANDS[name]
    callbacks = {one: one.callback for one in command.params}
    try:
        for one in command.params:
            one.callback = None
        return command.make_context(name, words)
    finally:
        for one, callback in callbacks.items():
            one.callback = callback


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_ends_with_examples_that_the_program_accepts(name):
    assert 1 <= len(EXAMPLES[name]) <= 2
    ending = run(name, "--help").stdout.partition("\nExample")[2].splitlines()[1:]
    assert [line.strip() for line in ending] == list(EXAMPLES[name])
    assert all(parsed(line).info_name == name for line in EXAMPLES[name])


@pytest.mark.parametrize(
    "line", ["jawusd pose out", "jawusd pose out --d 20 2", "jawusd check a --nope", "jawusd fit a --length-unit ft"]
)
def test_an_example_that_the_program_rejects_is_found(line):
    with pytest.raises(Exception, match=r"(?i)missing|three numbers|no such option|not one of"):
        parsed(line)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_help_has_no_types_of_python(name):
    context = typer.Context(COMMANDS[name], info_name=name, help_option_names=["-h", "--help"])
    rows = [help_row(one, context) for one in COMMANDS[name].get_params(context)]
    assert rows and not [names for names, _ in rows if re.search(r"[<>\[\]]|\b(str|int|float|path)\b", names)]


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_explains_itself(name):
    for flag in ("-h", "--help"):
        done = run(name, flag)
        assert done.exit_code == 0 and max(map(len, done.stdout.splitlines())) <= 80
    assert COMMANDS[name].help.strip().endswith(".")
    assert SUMMARIES[name].endswith(".") and len(SUMMARIES[name]) <= 62


def test_versions_and_completion():
    assert run("--version").stdout == f"jawusd {__version__}\n"
    env = {**os.environ, "_JAWUSD_COMPLETE": "complete_bash", "COMP_WORDS": "jawusd che", "COMP_CWORD": "1"}
    words = [sys.executable, "-c", "import sys; sys.argv[0] = 'jawusd'; from jawusd.cli.main import app; app()"]
    done = subprocess.run(words, env=env, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert "check" in done.stdout.split()


def test_exit_codes_are_those_of_the_errors():
    told = {int(number) for number in re.findall(r"\b(\d+)\b", EXIT_CODES)}
    kinds = [value for value in vars(errors).values() if isinstance(value, type) and issubclass(value, Exception)]
    assert {kind.exit_code for kind in kinds} <= told and {0, 1, 2, 130} <= told
    assert EXIT_CODES.split(":")[0] in run("-h").stdout


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        (["--d", "20,2,1"], ["--d", "20", "2", "1"]),
        (["--d", "20, -2, 1"], ["--d", "20", "-2", "1"]),
        (["--d=20 2 1"], ["--d", "20", "2", "1"]),
        (["--d=20,-2,1.5"], ["--d", "20", "-2", "1.5"]),
        (["--d", "-1,2e-1,.5", "x"], ["--d", "-1", "2e-1", ".5", "x"]),
        (["--d", "20", "2", "1"], ["--d", "20", "2", "1"]),
        (["--point", "1,2,3", "--target=4,5,6"], ["--point", "1", "2", "3", "--target", "4", "5", "6"]),
        (["--columns", "1,2,3"], ["--columns", "1,2,3"]),
        (["--d", "20,2"], ["--d", "20,2"]),
    ],
)
def test_vectors_may_have_commas(given, wanted):
    assert with_vectors_split(given) == wanted


def program(*words, **options):
    words = [sys.executable, "-m", "jawusd", *map(str, words)]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False, **options)


def test_a_log_holds_what_was_printed_and_where_an_error_arose(tmp_path):
    log = tmp_path / "run.log"
    done = program("--log", log, "check", tmp_path)
    text = log.read_text()
    assert done.returncode == 5 and f"check {tmp_path}" in text and __version__ in text
    assert all(line.strip() in text for line in done.stdout.splitlines() if line.strip())
    done = program("--log", log, "info", tmp_path / "none.usda")
    assert done.returncode > 2 and "Traceback" not in done.stderr and "Traceback" in log.read_text()
    assert "Traceback" in program("--verbose", "info", tmp_path / "none.usda").stderr
    refused = program("--log", tmp_path / "none" / "run.log", "info", tmp_path / "none.usda")
    assert refused.returncode == errors.OutputError.exit_code and "the log cannot be written" in refused.stderr


@pytest.mark.slow
def test_ctrl_c_says_what_is_kept_and_how_to_go_on(tmp_path):
    capture = write_short(tmp_path / "capture", 40)
    words = [sys.executable, "-m", "jawusd", "build", str(capture), "-o", str(tmp_path / "out"), "--jobs", "1"]
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # as in a child process of a shell
    try:
        process = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, handler)
    try:
        until = time.monotonic() + 300
        while not (tmp_path / "out" / "build.json").exists() and time.monotonic() < until:
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 130
    assert told.splitlines()[-1].startswith("jawusd build: stopped; finished stages are kept") and "--resume" in told
    assert "Traceback" not in told
    # The message is true: a plan reuses the finished stages and runs the others.
    plan = json.loads(run("build", capture, "-o", tmp_path / "out", "--resume", "--dry-run", "--json").stdout)
    kept = {stage["name"]: stage["keeps"] for stage in plan["stages"]}
    assert kept["check"] and not kept["report"]


def test_a_dry_run_writes_nothing(tmp_path):
    capture = write_short(tmp_path / "capture", 4)
    done = run("build", capture, "-o", tmp_path / "out", "--dry-run")
    assert done.exit_code == 0 and not (tmp_path / "out").exists()
    *stages, total = done.stdout.splitlines()
    names = [line.split()[0] for line in stages]
    assert [name for name in names if name != "scans"] == ["check", "sync", "track", "fit", "refine", "bake", "report"]
    assert all("runs, about" in line for line in stages) and "nothing was written" in total


@pytest.mark.parametrize(
    ("seconds", "words"), [(1, "5 seconds"), (61, "60 seconds"), (600, "10 minutes"), (9000, "2.5 hours")]
)
def test_times_in_words(seconds, words):
    assert rounded_duration(seconds) == words


def test_a_build_is_told_its_command_line_for_the_report(monkeypatch):
    asked = []
    monkeypatch.setattr("jawusd.pipeline.build.build", lambda *given: asked.append(given[2].command) or sys.exit(0))
    run("build", "some where", "-o", "out", "--jobs=1")
    assert asked == ["jawusd build 'some where' -o out --jobs=1"]


def built(todo=(), because=(), grade="look", findings=(), warnings=()):
    """Return the summary of a build."""
    errors = {"mandible": {"mean": 0.286, "median": 0.25, "p95": 0.6, "max": 1.03, "frames": 200}}
    return {
        "folder": "out",
        "seconds": {"check": 8.0, "track": 120.0, "fit": 9.0},
        "reused": ["check"],
        "findings": list(findings),
        "calibrate": None,
        "sync": {"method": "sound", "offsets": {"a": 0, "b": -3}, "notes": ["clicks"]},
        "track": {
            "tracked": 299, "frames": 300, "lost": [7], "recovered": 0, "without_a_camera": 0, "prior_aided": 0,
            "calibration_rescaled_px": {}, "sigma_mm": {"incisor": 0.046, "condyle_left": None},
            "coverage_error_percent": 0.5, "findings": list(findings),
        },
        "fit": {"method": "anchored", "errors": {"train": errors, "holdout": errors}, "warnings": list(warnings)},
        "report": {"file": "report.html", "verdict": {"grade": grade, "todo": list(todo), "because": list(because)}},
    }  # fmt: skip


def test_a_build_starts_with_its_verdict_and_says_the_rest_if_asked():
    odd = {"kind": "odd", "severity": "warning", "message": "odd."}
    told = built(["Re-record: chewing.", "Bake again."], ["rig: coarse"], findings=[odd], warnings=[{"message": "x"}])
    assert build_lines(told) == [
        "Usable for animation. Re-record: chewing.",
        "  also: Bake again.",
        "sync (sound): a +0, b -3 frames",
        "tracked 299 of 300 frames, expected error at the incisor 0.05 mm",
        "model: anchored, 0.29 mm from held-out poses on average, 1.03 mm at most",
        "2 warnings: see the report, or add -v",
        "time: 2 minutes",
        "rig: out/actor.usda",
        "report: out/report.html",
        "next: jawusd view out",
    ]
    whole = build_lines(told, verbose=True)
    for line in ("  because rig: coarse", "  lost: 7", "  note: clicks", "time: check kept, track 120.0 s, fit 9.0 s"):
        assert line in whole and line not in build_lines(told)
    assert sum("odd." in line for line in whole) == 1 and len(whole) > 12


def test_a_build_with_much_to_do_lists_some_of_it():
    told = built([f"Do {k}." for k in range(7)], grade="bad")
    assert build_lines(told)[:5] == ["Not usable. Do 0.", *(f"  also: Do {k}." for k in (1, 2, 3)),
                                     "  and 3 more in the report"]  # fmt: skip
    assert "  also: Do 6." in build_lines(told, verbose=True)
    assert build_lines(built(grade="good"))[0] == "Usable for animation."
    del told["report"]["verdict"]
    assert build_lines(told)[0].startswith("No verdict")
    told["reused"] = list(told["seconds"])
    assert "time: all stages were kept" in build_lines(told)


def test_the_demo_says_first_how_long_it_takes_and_last_what_comes_next(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr("jawusd.synthetic.capture_writer.write_demo", lambda *given, **_: made.append(given))
    done = run("demo", "-o", tmp_path / "a b")
    assert done.stderr.splitlines()[0] == "renders 900 images: about 14 minutes without a GPU" and len(made) == 1
    rig = tmp_path / "a b_rig"
    assert done.stdout.splitlines() == [
        str(tmp_path / "a b" / "capture.toml"),
        f"next: jawusd build '{tmp_path / 'a b'}' -o '{rig}'",
    ]
    assert "about 56 minutes" in run("demo", "-o", tmp_path, "--frames", 1140).stderr
    assert "about 14 minutes" in run("demo", "--help").stdout


def test_the_doctor_looks_at_what_a_build_needs():
    done = run("doctor", "--json")
    found = json.loads(done.stdout)
    assert found["jawusd"] == __version__ and found["cores"] >= 1 and found["versions"]["numpy"]
    assert found["codecs"]["h264"] and found["codecs"]["prores"] and {"build", "view"} <= set(found["extras"])
    assert done.exit_code == (1 if found["problems"] else 0)
    assert "OpenGL:" in run("doctor").stdout


def test_linear_algebra_has_one_thread_unless_told_otherwise():
    """With two threads, a fit differed by 5 micrometres; the setting has effect only before numpy is loaded."""
    shown = "print(os.environ['OPENBLAS_NUM_THREADS'], 'numpy' in sys.modules)"
    code = f"import os, sys, jawusd.cli.main as m\nm.app = lambda: {shown}\nm.main()"
    rest = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    for given, expected in (({}, "1 False"), ({"OPENBLAS_NUM_THREADS": "2"}, "2 False")):
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=rest | given, capture_output=True, text=True, check=True)
        assert done.stdout.strip() == expected
