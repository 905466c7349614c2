"""Layers made from the grammar of USD, schemas' own files: read or refused, and never from outside the folder."""

import shutil
import tomllib
from pathlib import Path

import pytest
from example_rig import forget_checksums
from forked import in_copy
from fuzz_grammar import capture_schema, from_schema, schema_of, toml_text, usd_text, words_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from package_copy import ROOT

from jawusd.base.errors import JawusdError
from jawusd.formats.capture import read_capture
from jawusd.rig import untrusted
from jawusd.rig.read import open_stage

GOLDEN = Path(__file__).parents[1] / "golden" / "rig_v2_anchored"
SLOW = {"deadline": None, "suppress_health_check": list(HealthCheck)}


@pytest.fixture(scope="module")
def rig_folder(tmp_path_factory):
    folder = shutil.copytree(GOLDEN, tmp_path_factory.mktemp("grammar") / "actor")
    forget_checksums(folder)
    (folder / "clip.1.usda").write_text('#usda 1.0\nover "Actor" {}\n')
    (folder.parent / "outside.usda").write_text('#usda 1.0\ndef "Outside" {}\n')
    return folder


@settings(max_examples=30, **SLOW)
@given(rng=st.randoms(use_true_random=False))
def test_layers_are_read_from_their_folder_or_refused(rig_folder, rng):
    shot = rig_folder / "shot.usda"
    shot.write_bytes(usd_text(rng).encode("utf-8", "surrogatepass"))
    files = in_copy(lambda: files_of(shot))
    if isinstance(files, list):  # else what OpenUSD ended by: commands say so
        assert [file for file in files if not Path(file).resolve().is_relative_to(rig_folder)] == []


def files_of(shot):
    """Return the files of a stage, in a copy of this process: what takes long ends the copy sooner than a command."""
    untrusted.MAX_CPU_S = 2
    try:
        stage = open_stage(shot)
    except JawusdError:
        return []
    return [layer.realPath for layer in stage.GetUsedLayers() if not layer.anonymous]


@settings(max_examples=80, **SLOW)
@given(rng=st.randoms(use_true_random=False))
def test_captures_are_read_or_refused(tmp_path_factory, rng):
    path = tmp_path_factory.getbasetemp() / "capture.toml"
    valid = tomllib.loads((ROOT / "examples" / "capture" / "capture.toml").read_text())
    made = from_schema(capture_schema(), rng, valid, words_of(valid))
    path.write_bytes(toml_text(made if isinstance(made, dict) else {"": made}).encode("utf-8", "surrogatepass"))
    capture, problems = read_capture(path)
    assert capture is not None or problems


_PLAIN = st.none() | st.booleans() | st.integers() | st.text()


@settings(max_examples=50, **SLOW)
@given(
    value=st.recursive(_PLAIN, lambda part: st.lists(part) | st.dictionaries(st.text(), part), max_leaves=20),
    rng=st.randoms(use_true_random=False),
)
def test_schemas_follow_any_value(value, rng):
    from_schema(schema_of(value), rng, value)
