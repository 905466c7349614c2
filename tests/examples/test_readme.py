"""The README's commands exist, its tour prints what it says, and the scripts it names are there."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib

import pytest
import typer
from package_copy import ROOT

from jawusd import __version__
from jawusd.cli.main import app
from jawusd.pipeline.build import build_lines

README = (ROOT / "README.md").read_text()
COMMANDS = typer.main.get_command(app).commands
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
ELLIPSIS = "…"


def command_lines(text):
    """Return every command line of jawusd in blocks of shell and between backticks, without comments."""
    blocks = "\n".join(re.findall(r"^```(?:sh|console)\n(.*?)^```", text, flags=re.M | re.S)).replace("\\\n", " ")
    quoted = re.findall(r"`(jawusd [^`]+)`", text)
    return [line for line in [*blocks.splitlines(), *quoted] if re.search(r"(^|[ /])jawusd [a-z]", line)]


def unknown(line):
    """Return what a command line uses that the program does not know, None if all is known."""
    for part in re.split(r"&&|;", line.split("  #")[0].removeprefix("$ ")):
        words = shlex.split(part)
        places = [k for k, word in enumerate(words) if word.split("/")[-1] == "jawusd"]
        if not places:
            continue
        name, *rest = words[places[0] + 1 :]
        if name not in COMMANDS:
            return f"{line}: no command {name}"
        known = {option for parameter in COMMANDS[name].params for option in parameter.opts + parameter.secondary_opts}
        for word in rest:
            if re.match(r"--?[a-z]", word) and word.split("=")[0] not in known | {"--help"}:
                return f"{line}: no option {word}"
    return None


def test_every_command_in_the_readme_exists():
    lines = command_lines(README)
    assert len(lines) > 20
    assert [fault for fault in map(unknown, lines) if fault] == []


@pytest.mark.parametrize(
    "text",
    [
        "```sh\n.venv/bin/jawusd bild x -o out\n```\n",
        "```console\n$ jawusd build x --nope 3\n```\n",
        "`jawusd poze RIG`",
    ],
)
def test_a_command_that_does_not_exist_is_found(text):
    assert [unknown(line) for line in command_lines(text)] != [None]


def test_scripts_and_pictures_in_the_readme_exist():
    named = re.findall(r"(?:tests|examples)/[\w/]+\.(?:py|png)", README)
    assert named
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_package_and_program_have_one_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == __version__


def tour():
    """Return the tour as (command, lines expected)."""
    text = README[README.index("## A five-minute tour") :]
    text = text[: text.index("\n## ", 5)]
    steps = []
    for block in re.findall(r"^```console\n(.*?)^```", text, flags=re.M | re.S):
        for line in block.splitlines():
            if line.startswith("$ "):
                steps.append((line[2:], []))
            else:
                steps[-1][1].append(line)
    return steps


def alike(expected, printed):
    """Tell whether two lines have the same words, and numbers that differ by no more than machines do."""
    if NUMBER.sub("#", expected).split() != NUMBER.sub("#", printed).split():
        return False
    pairs = zip(NUMBER.findall(expected), NUMBER.findall(printed), strict=True)
    return all(abs(float(a) - float(b)) <= 0.3 + 0.05 * abs(float(a)) for a, b in pairs)


def missing(expected, printed):
    """Return the first line expected that does not come in its order, None if all do."""
    rest = iter(printed)
    return next((line for line in expected if line != ELLIPSIS and not any(alike(line, p) for p in rest)), None)


def test_the_tour_prints_what_the_readme_says(example_build, tmp_path):
    built, summary = example_build
    shutil.copytree(built, tmp_path / "out")
    program = tmp_path / "bin" / "jawusd"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m jawusd "$@"\n')
    program.chmod(0o755)
    env = {**os.environ, "PATH": f"{program.parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    (first, expected), *others = tour()
    assert first == "jawusd build examples/capture -o out"  # built once for all tests
    printed = "\n".join(build_lines(summary)).replace(str(summary["folder"]), "out").splitlines()
    assert missing(expected, printed) is None, printed
    for command, expected in others:
        done = subprocess.run(
            ["sh", "-c", command], cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120, check=False
        )
        assert done.returncode == 0, command + done.stderr
        assert missing(expected, done.stdout.splitlines()) is None, command + "\n" + done.stdout


def test_a_tour_that_prints_something_else_is_found():
    assert missing(["2 of 3 poses are valid"], ["3 of 3 poses are valid", "done"])
    assert missing(["margin 2.955 mm: inside the bound"], ["margin 2.955 mm: OUTSIDE the bound"])
    assert missing([ELLIPSIS, "b 1.0", ELLIPSIS], ["a", "b 1.1", "c"]) is None
