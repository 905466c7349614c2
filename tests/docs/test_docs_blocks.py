"""What README and documentation tell people to type is known to the program, and does and prints what they say."""

import ast
import importlib
import os
import re
import shutil
import subprocess
import sys
import tomllib

import pytest
from doc_blocks import ELLIPSIS, blocks, command_lines, missing, pages, steps, unknown
from package_copy import ROOT

from jawusd.cli.text_build import build_lines

PAGES = pages()
BLOCKS = [block for page in PAGES for block in blocks(page)]
BUILD = "jawusd build examples/capture -o out"


def of(language):
    """Return the blocks of a language."""
    return [block for block in BLOCKS if block.language == language]


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_every_command_line_is_one_of_the_program():
    lines = [line for page in PAGES for line in command_lines((ROOT / page).read_text())]
    assert len(lines) > 80
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


def test_blocks_are_of_languages_that_are_checked():
    assert {block.language for block in BLOCKS} <= {"sh", "console", "python", "toml", "text"}


def test_programs_and_pictures_that_pages_name_exist():
    text = "".join((ROOT / page).read_text() for page in PAGES)
    named = re.findall(r"(?:tests|examples)/[\w/]+\.(?:py|png)", text)
    assert named
    assert [name for name in named if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("block", of("toml"), ids=str)
def test_toml_can_be_read(block):
    assert tomllib.loads(block.text)


@pytest.fixture(scope="module")
def desk(example_build, tmp_path_factory):
    """Return a folder with a copy of the example's rig in out/, and the environment in which jawusd is a command."""
    folder = tmp_path_factory.mktemp("desk")
    shutil.copytree(example_build[0], folder / "out")
    program = folder / "bin" / "jawusd"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m jawusd "$@"\n')
    program.chmod(0o755)
    path = f"{program.parent}:{os.environ['PATH']}"
    return folder, {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)}


@pytest.mark.slow
def test_console_blocks_print_what_they_say(desk, example_build):
    folder, env = desk
    built = "\n".join(build_lines(example_build[1])).replace(str(example_build[1]["folder"]), "out")
    printed = {BUILD: built}  # built once for all tests; later pages repeat what an earlier one did
    for block in of("console"):
        for command, expected in steps(block):
            # A rig's folder and its file are the same to these commands: what was run is not run again.
            command = re.sub(r"^(jawusd (?:info|pose|animate|validate)) out/actor\.usda", r"\1 out", command)
            if command not in printed:
                done = subprocess.run(
                    ["sh", "-c", command], cwd=folder, env=env, capture_output=True, text=True, timeout=120, check=False
                )
                assert done.returncode == 0, f"{block}: {command}\n{done.stderr}"
                printed[command] = done.stdout
            lost = missing(expected, printed[command].splitlines())
            assert lost is None, f"{block}: {command} does not print: {lost}\n{printed[command]}"


def test_an_output_that_differs_is_found():
    assert missing(["2 of 3 poses are valid"], ["3 of 3 poses are valid", "done"])
    assert missing(["margin 2.955 mm: inside the bound"], ["margin 2.955 mm: OUTSIDE the bound"])
    assert missing([ELLIPSIS, "b 1.0", ELLIPSIS], ["a", "b 1.1", "c"]) is None


def test_python_blocks_run(desk, monkeypatch):
    monkeypatch.chdir(desk[0])
    names = {}  # of every page: a later block may use what an earlier one made
    for block in of("python"):
        if not block.parsed:
            code = compile("\n" * block.line + block.text, str(ROOT / block.page), "exec")
            exec(code, names.setdefault(block.page, {}))


COPIED = ("jawusd_reader", "jawusd_recipes")


def names_without(text):
    """Return what a block uses of the modules for other programs that these do not have."""
    tree = ast.parse(text)
    alias = {
        name.asname or name.name: importlib.import_module(f"jawusd.plugins.{name.name}")
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for name in node.names
        if name.name in COPIED
    }
    used = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)]
    return [n.attr for n in used if n.value.id in alias and not hasattr(alias[n.value.id], n.attr)]


PARSED = [block for block in of("python") if block.parsed]
IN_PROGRAMS = [block for block in PARSED if "jawusd_reader" in block.text]
IN_BLENDER = [block for block in PARSED if "import bpy" in block.text and block not in IN_PROGRAMS]


@pytest.mark.parametrize("block", [block for block in PARSED if block not in (*IN_PROGRAMS, *IN_BLENDER)], ids=str)
def test_blocks_for_clusters_run_commands_that_there_are(block):
    lists = [node.elts for node in ast.walk(ast.parse(block.text)) if isinstance(node, ast.List)]
    words = [[getattr(element, "value", "PLACE") for element in elements] for elements in lists]
    commands = [" ".join(map(str, line)) for line in words if line[:1] == ["jawusd"]]
    assert commands and [fault for fault in map(unknown, commands) if fault] == []
    assert unknown(commands[0].replace("build-many", "build-all"))


@pytest.mark.parametrize("block", IN_BLENDER, ids=str)
def test_blocks_for_blender_call_operators_of_the_add_on(block):
    called = re.findall(r"bpy\.ops\.(jaw(?:usd)?\.\w+)\(", block.text)
    sources = "".join(path.read_text() for path in (ROOT / "jawusd" / "plugins" / "blender").glob("*.py"))
    assert called and [name for name in called if f'bl_idname = "{name}"' not in sources] == []


@pytest.mark.parametrize("block", IN_PROGRAMS, ids=str)
def test_blocks_for_other_programs_use_what_there_is(block, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "jawusd" / "plugins"))
    assert names_without(block.text) == []
    assert names_without(block.text + "\nrecipes.maya_bakes(rig)\n") == ["maya_bakes"]
