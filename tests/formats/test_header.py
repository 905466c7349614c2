"""Headers of tracks and models: values of other types are refused by name, missing ones are read."""

import json

import numpy as np
import pytest
from example_model import example_arrays, example_meta
from example_tracks import make_tracks

from jawusd.base.errors import FormatError
from jawusd.formats.atomic import write_npz_atomic
from jawusd.formats.model import JawModel, load_model, save_model
from jawusd.formats.tracks import load_tracks, save_tracks


@pytest.fixture
def files(tmp_path):
    """Return a function that writes both files with changed headers."""

    def write(name, **changes):
        path = tmp_path / name
        if name == "tracks.npz":
            save_tracks(path, make_tracks())
        else:
            captured = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.ones(3, bool)
            save_model(path, JawModel(example_arrays(), *captured, example_meta()))
        with np.load(path) as archive:
            arrays = dict(archive)
        arrays["meta"] = np.array(json.dumps({**json.loads(str(arrays["meta"])), **changes}))
        write_npz_atomic(path, arrays)
        return path

    return write


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("warnings", ["x"]),
        ("warnings", [{"code": 3, "message": "x"}]),
        ("warnings", {"code": "x"}),
        ("errors", {"train": {"incisor": "x"}}),
        ("errors", []),
        ("excluded_frames", [1]),
        ("trimmed_frames", "12"),
        ("trimmed_frames", [None]),
        ("fps", "24"),
        ("uncertainty", 5),
        ("inferred", "x"),
        ("registration", {"T": 1}),
    ],
)
def test_models_with_values_of_other_types_are_refused(key, value, files):
    with pytest.raises(FormatError, match=f'an invalid "{key}'):
        load_model(files("model.npz", **{key: value}))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("findings", ["x"]),
        ("findings", 3),
        ("delays_frames", {"a": "x"}),
        ("calibration_rescaled_px", {"a": 3}),
        ("gum_line_mm", {}),
        ("tolerance_mm", "x"),
        ("start", []),
    ],
)
def test_tracks_with_values_of_other_types_are_refused(key, value, files):
    with pytest.raises(FormatError, match=f'an invalid "{key}'):
        load_tracks(files("tracks.npz", **{key: value}))


def test_unknown_and_missing_values_are_read(files):
    assert load_model(files("model.npz", of_a_later_version=[{"x": None}])).meta["of_a_later_version"]
    assert load_tracks(files("tracks.npz", of_a_later_version=3)).meta["of_a_later_version"] == 3
