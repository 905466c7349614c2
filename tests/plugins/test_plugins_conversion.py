"""FBX and glTF without Blender, or with something else in its place: one clear message each."""

import sys

import pytest

from jawusd.base.errors import FormatError, MissingDependencyError
from jawusd.plugins.conversion import converted


@pytest.fixture
def take(tmp_path):
    (tmp_path / "take.fbx").write_bytes(b"Kaydara FBX Binary")
    return tmp_path / "take.fbx"


@pytest.fixture
def program(tmp_path, monkeypatch):
    def made(script):
        path = tmp_path / "python-with-bpy"
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o755)
        monkeypatch.setenv("JAWUSD_BLENDER", str(path))

    return made


def test_without_blender_it_says_what_to_set(take, tmp_path, monkeypatch):
    monkeypatch.delenv("JAWUSD_BLENDER", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"take\.fbx: FBX and glTF are read through Blen.*JAWUSD_BLENDER"):
        converted(take, tmp_path, 24)


@pytest.mark.parametrize("named", [sys.executable, "/nowhere/python"])
def test_what_is_no_blender_is_named(take, tmp_path, monkeypatch, named):
    monkeypatch.setenv("JAWUSD_BLENDER", named)
    with pytest.raises(MissingDependencyError, match=f"{named} (is neither|cannot be run).*JAWUSD_BLENDER"):
        converted(take, tmp_path, 24)


def test_a_file_that_blender_does_not_read_is_refused(take, tmp_path, program):
    program("echo Traceback >&2; echo 'RuntimeError: not an FBX file' >&2; exit 1")
    with pytest.raises(FormatError, match=r"take\.fbx: Blender cannot read it \(RuntimeError: not an FBX file\)"):
        converted(take, tmp_path, 24)
    program("exit 0")
    with pytest.raises(FormatError, match="said nothing"):
        converted(take, tmp_path, 24)
    with pytest.raises(FormatError, match="no such file"):
        converted(tmp_path / "none.glb", tmp_path, 24)


def test_blender_is_given_the_files_and_the_rate(take, tmp_path, program, monkeypatch):
    monkeypatch.setenv("PXR_PLUGINPATH_NAME", "/schemas")
    program(f'echo "$2 $3 $5 [$PXR_PLUGINPATH_NAME]" > {tmp_path}/given; echo stage > "$4"')
    assert converted(take, tmp_path, 29.97).read_text() == "stage\n"
    assert (tmp_path / "given").read_text() == f"-- {take} 29.97 []\n"
