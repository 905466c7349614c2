"""tracks.npz and model.npz: round trips, and refusal of what they must not hold."""

import json
import pickle
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from example_tracks import make_tracks

from jawusd.base.errors import FormatError, UnitsError, VersionError
from jawusd.formats.atomic import write_npz_atomic
from jawusd.formats.model import JawModel, load_model, save_model
from jawusd.formats.performance import SolvedJaw
from jawusd.formats.tracks import LostReason, TrackStatus, load_tracks, save_tracks


def test_tracks_round_trip_bit_for_bit(tmp_path):
    tracks = make_tracks()
    save_tracks(tmp_path / "t.npz", tracks)
    again = load_tracks(tmp_path / "t.npz")
    for name in ("frames", "T_world_upper", "raw_T_upper_lower", "status", "covariance_relative", "coverage_error"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tracks, name))
    assert again.camera_names == ("a", "b") and again.meta["config"] == {"gate_px": 2.5}
    assert again.meta["units"] == {"length": "mm", "angle": "rad"} and again.meta["twist_order"] == ["omega", "v"]
    np.testing.assert_array_equal(again.tracked(), [True, True, False, True, True])
    first = (tmp_path / "t.npz").read_bytes()
    save_tracks(tmp_path / "t.npz", tracks)
    assert (tmp_path / "t.npz").read_bytes() == first


def test_trackers_that_do_not_say_which_masks_they_used_used_all(tmp_path):
    tracks = make_tracks()
    tracks.coverage_error[3, 1, 0] = np.nan
    save_tracks(tmp_path / "t.npz", tracks)
    rewrite(tmp_path / "t.npz", lambda arrays: arrays.pop("masks_used"))
    used = load_tracks(tmp_path / "t.npz").masks_used
    assert not used[3, 1, 0] and used.sum() == used.size - 1


def test_reasons_of_losses_are_kept_and_may_be_missing(tmp_path):
    tracks = make_tracks()
    tracks.status[2, 1], tracks.lost_reason[2, 1] = TrackStatus.LOST, LostReason.LOW_SCORE
    tracks.lost_value[2, 1], tracks.lost_limit[2, 1] = 0.31, 0.6
    save_tracks(tmp_path / "t.npz", tracks)
    again = load_tracks(tmp_path / "t.npz")
    assert again.explain_loss(2, 1) == "matched contour 31% of the usual; at least 60% is needed"
    assert again.explain_loss(2, 0) == "no reason is recorded"
    rewrite(tmp_path / "t.npz", lambda arrays: [arrays.pop(f"lost_{name}") for name in ("reason", "value", "limit")])
    assert load_tracks(tmp_path / "t.npz").explain_loss(2, 1) == "no reason is recorded"
    save_tracks(tmp_path / "t.npz", tracks)
    rewrite(tmp_path / "t.npz", lambda arrays: arrays["lost_reason"].fill(77))
    with pytest.raises(FormatError, match="lost_reason"):
        load_tracks(tmp_path / "t.npz")


def test_a_solve_is_kept_and_checked(tmp_path):
    tracks, path = make_tracks(), tmp_path / "t.npz"
    count = len(tracks.frames)
    save_tracks(path, tracks)
    assert load_tracks(path).solved is None
    rng = np.random.default_rng(0)
    d, sigma, margin = rng.normal(size=(count, 3)), rng.random((count, 3)), rng.normal(size=count)
    state, valid = np.arange(count, dtype=np.int8) % 3, np.arange(count) > 1
    tracks.solved = SolvedJaw(d, sigma, margin, state, valid)
    save_tracks(path, tracks)
    again = load_tracks(path).solved
    for name in ("d", "sigma_mm", "margin_mm", "state", "valid"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tracks.solved, name))
        assert getattr(again, name).dtype == getattr(tracks.solved, name).dtype
    faults = {
        "solved_state": lambda arrays: arrays["solved_state"].fill(9),
        "solved_sigma_mm": lambda arrays: arrays.pop("solved_sigma_mm"),
        "solved_margin_mm": lambda arrays: arrays["solved_margin_mm"].fill(np.nan),
        "solved_d": lambda arrays: arrays.update(solved_d=arrays["solved_d"][:-1]),
    }
    for name, fault in faults.items():
        save_tracks(path, tracks)
        rewrite(path, fault)
        with pytest.raises(FormatError, match=name):
            load_tracks(path)
    tracks.solved = replace(tracks.solved, margin_mm=margin[:-1])
    with pytest.raises(ValueError, match="margin_mm"):
        save_tracks(path, tracks)


def rewrite(path, change):
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    change(arrays)
    write_npz_atomic(path, arrays)


def set_meta(**changes):
    def change(arrays):
        meta = json.loads(str(arrays["meta"]))
        meta.update(changes)
        arrays["meta"] = np.array(json.dumps(meta))

    return change


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (set_meta(format="jawusd-tracks/2"), VersionError, "Update jawusd"),
        (set_meta(format="jawusd-model/1"), FormatError, "jawusd-tracks/1"),
        (set_meta(units={"length": "m", "angle": "rad"}), UnitsError, "units"),
        (set_meta(twist_order=["v", "omega"]), UnitsError, "twist order"),
        (set_meta(camera_names="ab"), FormatError, "camera_names"),
        (lambda a: a.pop("sigma_mm"), FormatError, "sigma_mm"),
        (lambda a: a.pop("meta"), FormatError, "meta"),
        (lambda a: a.update(meta=np.array("{")), FormatError, "not JSON"),
        (lambda a: a.update(status=a["status"][:, :1]), FormatError, "shape"),
        (lambda a: a["T_world_upper"].__setitem__((0, 0, 0), 1.5), FormatError, "frame 30 is not rigid"),
    ],
)
def test_each_fault_in_tracks_is_named(tmp_path, change, error, words):
    path = tmp_path / "t.npz"
    save_tracks(path, make_tracks())
    rewrite(path, change)
    with pytest.raises(error, match=words):
        load_tracks(path)


def test_pickles_are_neither_written_nor_read(tmp_path):
    with pytest.raises(ValueError, match="Python objects"):
        write_npz_atomic(tmp_path / "x.npz", {"a": np.array([{}], dtype=object)})
    path = tmp_path / "evil.npz"
    np.savez(path, meta=np.array([pickle.loads], dtype=object))
    with pytest.raises(FormatError, match="not a readable npz"):
        load_tracks(path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04rubbish", b"not a zip at all"])
def test_rubbish_is_one_clear_error(tmp_path, content):
    path = tmp_path / "t.npz"
    path.write_bytes(content)
    with pytest.raises(FormatError, match="t.npz"):
        load_tracks(path)


@pytest.mark.parametrize("header", ["{'descr': '<f8'", "if a:\n    b\n  c", "{'descr': '<f8', 'shape': 'x'}"])
def test_damaged_headers_of_arrays_are_one_clear_error(tmp_path, header):
    path = tmp_path / "t.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("frames.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode())
    with pytest.raises(FormatError, match="t.npz.*not a readable npz"):
        load_tracks(path)


def test_wrong_shapes_are_not_written(tmp_path):
    tracks = make_tracks()
    tracks.sigma_mm = tracks.sigma_mm[:, :2]
    with pytest.raises(ValueError, match="sigma_mm"):
        save_tracks(tmp_path / "t.npz", tracks)
    assert not list(tmp_path.iterdir())


def test_model_round_trip(tmp_path):
    model = JawModel(
        {"incisor": np.zeros(3)}, np.arange(4), np.full((4, 3), np.nan), np.zeros(4), np.ones(4, bool), {"kind": "x"}
    )
    save_model(tmp_path / "m.npz", model)
    again = load_model(tmp_path / "m.npz")
    assert set(again.arrays) == {"incisor"} and again.meta["kind"] == "x" and again.trained.all()
    with pytest.raises(FormatError, match="jawusd-tracks"):
        load_tracks(tmp_path / "m.npz")


def test_arrays_are_written_row_by_row(tmp_path):
    """Factors of a singular value decomposition come column by column; simple readers take rows alone."""
    columns = np.asfortranarray(np.arange(12.0).reshape(4, 3))
    write_npz_atomic(tmp_path / "a.npz", {"columns": columns, "turned": columns[::-1].T, "single": np.float64(2.0)})
    with np.load(tmp_path / "a.npz") as archive:
        np.testing.assert_array_equal(archive["columns"], columns)
        assert all(archive[name].flags.c_contiguous for name in archive.files) and archive["single"].shape == ()
