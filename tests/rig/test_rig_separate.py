"""Hostile rigs: limits of the separate process, and sizes that are checked before use.

Commands on them are tested in tests/faults/attacks.py.
"""

import os
import shutil
import subprocess
import sys
import threading

import numpy as np
import pytest
from example_rig import forget_checksums
from hostile_rigs import HEADER, doubling, enlarge, nested
from pxr import Usd, UsdGeom

import jawusd
from jawusd.base.errors import FormatError, ResourceError, RigError
from jawusd.base.inputs import SETTING
from jawusd.rig import attributes, separate, untrusted
from jawusd.rig.geo import read_geometry, read_gum
from jawusd.rig.read import describe, load_rig, open_stage

limits = pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")


def test_a_separate_process_gives_the_same_rig(folder):
    here, there = jawusd.load(folder), jawusd.load(folder, untrusted=True)
    assert here.model_hash == there.model_hash and here.meta == there.meta
    assert np.array_equal(here.pose([20.0, 1.0, 2.0]), there.pose([20.0, 1.0, 2.0]))


@limits
def test_what_crashes_openusd_is_an_error(tmp_path):
    (tmp_path / "deep.usda").write_text(nested(40_000))
    with pytest.raises(RigError, match=r"deep.usda: crashes the process that reads it \(exit code -11\)"):
        jawusd.load(tmp_path / "deep.usda", untrusted=True)


@limits
def test_what_takes_too_long_is_an_error(tmp_path, monkeypatch):
    (tmp_path / "bomb.usda").write_text(doubling(28))
    monkeypatch.setattr(separate, "MAX_CPU_S", 2)
    with pytest.raises(RigError, match="takes more than 2 s of processor time"):
        jawusd.load(tmp_path / "bomb.usda", untrusted=True)
    monkeypatch.setattr(separate, "MAX_WAIT_S", 0.01)
    with pytest.raises(RigError, match=r"takes more than 0.01 s to read"):
        jawusd.load(tmp_path / "bomb.usda", untrusted=True)


@limits
def test_what_needs_too_much_memory_is_an_error(anchored_folder, monkeypatch):
    enlarge(anchored_folder / "rig.usdc", "/Actor.jaw:model:tRest", 150_000_000)
    forget_checksums(anchored_folder)
    monkeypatch.setattr(separate, "MAX_MEMORY_GB", 0.8)
    with pytest.raises((FormatError, ResourceError), match="Corrupt asset|needs more memory"):
        jawusd.load(anchored_folder, untrusted=True)


def test_errors_come_back_as_they_are(anchored_folder, tmp_path, monkeypatch):
    (tmp_path / "none.usda").write_text(HEADER)
    with pytest.raises(FormatError, match="has no jaw rig"):
        jawusd.load(tmp_path / "none.usda", untrusted=True)
    with pytest.raises(FormatError, match="/Nobody is not a jaw rig"):
        jawusd.load(anchored_folder, prim="/Nobody", untrusted=True)
    shutil.move(anchored_folder / "rig.usdc", tmp_path / "rig.usdc")
    (anchored_folder / "rig.usdc").symlink_to(tmp_path / "rig.usdc")
    with pytest.raises(RigError, match="outside the folder of this file") as found:
        jawusd.load(anchored_folder, untrusted=True)
    assert "--allow" in found.value.hint
    monkeypatch.setenv(SETTING, str(tmp_path))
    assert jawusd.load(anchored_folder, untrusted=True)


def test_programs_that_python_is_part_of_start_the_python_beside_them(anchored_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "maya.bin"))
    (tmp_path / "mayapy").symlink_to(os.path.realpath(sys.prefix + "/bin/python3"))
    assert separate._python() == str(tmp_path / "mayapy")
    (tmp_path / "mayapy").unlink()
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    with pytest.raises(RigError, match="needs a Python interpreter"):
        jawusd.load(anchored_folder, untrusted=True)


def test_a_rig_is_loaded_in_this_process_from_any_thread(anchored_folder, monkeypatch):
    monkeypatch.setattr(os, "fork", None)
    monkeypatch.setattr(subprocess, "Popen", None)
    found = []
    thread = threading.Thread(target=lambda: found.append(jawusd.load(anchored_folder)))
    thread.start()
    thread.join()
    assert len(found) == 1


@pytest.mark.parametrize("read", [load_rig, describe, read_geometry, read_gum])
def test_arrays_are_counted_before_they_are_used(read, anchored_folder, monkeypatch):
    monkeypatch.setattr(attributes, "MAX_VALUES", 20)
    with pytest.raises(FormatError, match=r"values, more than the limit of 20"):
        read(anchored_folder / "actor.usda")


def test_prims_and_samples_are_counted(anchored_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(untrusted, "MAX_SPECS", 10)
    with pytest.raises(RigError, match="has more than 10 prims and properties"):
        open_stage(anchored_folder / "actor.usda")
    monkeypatch.undo()
    stage = Usd.Stage.CreateNew(str(tmp_path / "long.usdc"))
    moved = UsdGeom.Xform.Define(stage, "/A").AddTranslateOp()
    for frame in range(9):
        moved.Set((0, 0, frame), frame)
    stage.Save()
    monkeypatch.setattr(untrusted, "MAX_SAMPLES", 8)
    with pytest.raises(RigError, match="has more than 8 samples of /A.xformOp:translate"):
        open_stage(tmp_path / "long.usdc")


@pytest.mark.parametrize("name", ["a\udcff", "a\nb"])
def test_names_that_openusd_cannot_follow_are_refused_as_such(name, anchored_folder, tmp_path):
    shutil.copytree(anchored_folder, tmp_path / name)
    with pytest.raises(RigError, match="OpenUSD cannot open it"):
        open_stage(tmp_path / name / "actor.usda")
