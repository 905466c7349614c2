"""FBX and glTF without Blender, or with another program in its place: one clear message each."""

import math
import sys

import numpy as np
import pytest

from jawusd.base.errors import FormatError, MissingDependencyError
from jawusd.formats.gltf import Node, frame_rate, save_glb
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
    with pytest.raises(FormatError, match="no output"):
        converted(take, tmp_path, 24)
    with pytest.raises(FormatError, match="no such file"):
        converted(tmp_path / "none.glb", tmp_path, 24)


def test_blender_is_given_the_files_and_the_rate(take, tmp_path, program, monkeypatch):
    monkeypatch.setenv("PXR_PLUGINPATH_NAME", "/schemas")
    program(f'echo "$2 $3 $5 [$PXR_PLUGINPATH_NAME]" > {tmp_path}/given; echo stage > "$4"')
    assert converted(take, tmp_path, 29.97).read_text() == "stage\n"
    assert (tmp_path / "given").read_text() == f"-- {take} 29.97 []\n"


def test_a_glb_of_jawusd_is_read_at_its_own_rate(tmp_path, program):
    poses = np.stack([np.eye(4), np.eye(4)])
    node = Node("Mandible", np.eye(4), [], np.array([0.0, 0.1]), poses)
    for fps, wanted in ((30.0, 30.0), (0.0, None), (math.nan, None), ("fast", None), (None, None)):
        save_glb(tmp_path / "take.glb", "x", {}, [node], "jawusd", {"fps": fps})
        assert frame_rate(tmp_path / "take.glb") == wanted
        program(f'echo "$5" > {tmp_path}/given; echo stage > "$4"')
        converted(tmp_path / "take.glb", tmp_path, 24.0)
        assert (tmp_path / "given").read_text() == f"{wanted or 24.0}\n"
    whole = (tmp_path / "take.glb").read_bytes()
    for damaged in (b"", b"glTF", whole[:40], b"x" + whole[1:]):
        (tmp_path / "other.glb").write_bytes(damaged)
        assert frame_rate(tmp_path / "other.glb") is None
