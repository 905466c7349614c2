"""The system's own record of what is opened over hostile rigs; the long series is tests/benchmarks/reach.py."""

import shutil

import pytest
from reach_driver import GOLDEN, STRACE, watch, write_rigs

from jawusd.base.inputs import SETTING

pytestmark = pytest.mark.skipif(STRACE is None, reason="strace is not installed")


def test_hostile_rigs_open_nothing_outside_their_folder(tmp_path):
    folder = tmp_path / "rigs"
    folder.mkdir()
    write_rigs(folder, 9, seed=2000)
    found, counts = watch(folder)
    assert found == [], counts


def test_what_is_opened_elsewhere_is_seen(tmp_path, monkeypatch):
    """A folder that was allowed: the record of the system shows it."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "more.usda").write_text('#usda 1.0\nover "Actor" {}\n')
    rig = shutil.copytree(GOLDEN, tmp_path / "rigs" / "000001")
    (rig / "keys.json").write_text("{}")
    (rig / "shot.usda").write_text(f"#usda 1.0\n( subLayers = [@{elsewhere}/more.usda@, @./actor.usda@] )\n")
    monkeypatch.setenv(SETTING, str(elsewhere))
    found, _ = watch(tmp_path / "rigs")
    assert {step for _, step, call in found if "more.usda" in call} == {"info", "validate", "animate", "view"}
