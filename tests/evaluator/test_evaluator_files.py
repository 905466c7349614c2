"""Reading model.npz: what the formats layer writes comes back, damaged files are refused by name."""

import json

import numpy as np
import pytest
from example_model import example_arrays, example_meta

from jawusd import evaluator
from jawusd.base.errors import FormatError, UnitsError, VersionError
from jawusd.formats.model import JawModel, save_model


def write(path, arrays=None, **meta):
    header = example_meta() | meta
    np.savez(path, **(example_arrays() if arrays is None else arrays), meta=np.array(json.dumps(header)))
    return path


@pytest.mark.parametrize("kind", ["anchored", "additive"])
def test_a_saved_model_loads_as_a_rig(tmp_path, kind):
    """What `formats.model` writes, captured frames included, is what the evaluator reads."""
    arrays = example_arrays(kind)
    model = JawModel(arrays, np.arange(4), np.zeros((4, 3)), np.zeros(4), np.ones(4, bool), example_meta(kind))
    save_model(tmp_path / "model.npz", model)
    rig = evaluator.load(tmp_path / "model.npz")
    expected = evaluator.JawRig(arrays, example_meta(kind))
    d = np.array([[10.0, 2.0, 1.0], [30.0, -1.0, 0.5]])
    np.testing.assert_array_equal(rig.pose(d), expected.pose(d))
    assert set(rig.arrays) == set(arrays)
    assert rig.meta["actor"] == "example"


def test_newer_versions_are_refused_with_advice(tmp_path):
    with pytest.raises(VersionError, match=r"jawusd-model/3.*Update jawusd"):
        evaluator.load(write(tmp_path / "m.npz", format="jawusd-model/3"))


@pytest.mark.parametrize(
    ("found", "said"),
    [
        *((name, "format is") for name in ("jawusd-tracks/1", "jawusd-model", "jawusd-model/x")),
        (None, 'states no format; its format must be "jawusd-model/2"'),
    ],
)
def test_other_formats_are_refused(tmp_path, found, said):
    with pytest.raises(FormatError, match=said):
        evaluator.load(write(tmp_path / "m.npz", format=found))


@pytest.mark.parametrize("meta", [{"units": {"length": "m", "angle": "rad"}}, {"twist_order": ["v", "omega"]}])
def test_other_units_and_orders_are_refused(tmp_path, meta):
    with pytest.raises(UnitsError, match="must be"):
        evaluator.load(write(tmp_path / "m.npz", **meta))


def test_a_bad_array_names_file_and_array(tmp_path):
    path = write(tmp_path / "m.npz", example_arrays() | {"incisor": np.zeros(4)})
    with pytest.raises(FormatError, match=r'm\.npz: "incisor" has shape \(4,\)'):
        evaluator.load(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FormatError, match="no such file"):
        evaluator.load(tmp_path / "nothing.npz")


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 broken"])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "m.npz").write_bytes(content)
    with pytest.raises(FormatError, match="not a readable npz"):
        evaluator.load(tmp_path / "m.npz")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_truncated_and_flipped_files_are_refused(tmp_path, save):
    """No damage to the bytes gets past the reader as another kind of exception."""
    save(tmp_path / "m.npz", **example_arrays(), meta=np.array(json.dumps(example_meta())))
    data = (tmp_path / "m.npz").read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(100):
        damaged = bytearray(data)
        if rng.random() < 0.5:
            del damaged[int(rng.integers(len(data))) :]
        else:
            for at in rng.integers(len(data), size=20):
                damaged[at] ^= 0xFF
        (tmp_path / "d.npz").write_bytes(bytes(damaged))
        with pytest.raises(FormatError):
            evaluator.load(tmp_path / "d.npz")


def test_pickled_objects_are_never_loaded(tmp_path):
    path = write(tmp_path / "m.npz", example_arrays() | {"codes": np.array([{"a": 1}], dtype=object)})
    with pytest.raises(FormatError, match="not a readable npz"):
        evaluator.load(path)


def test_meta_must_be_a_json_object(tmp_path):
    np.savez(tmp_path / "none.npz", **example_arrays())
    np.savez(tmp_path / "text.npz", **example_arrays(), meta=np.array("{"))
    np.savez(tmp_path / "list.npz", **example_arrays(), meta=np.array("[1]"))
    for name, message in (("none", 'no "meta"'), ("text", "not JSON"), ("list", "JSON object")):
        with pytest.raises(FormatError, match=message):
            evaluator.load(tmp_path / f"{name}.npz")
