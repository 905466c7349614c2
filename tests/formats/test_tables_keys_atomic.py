"""CSV and JSON tables, keys.json, and writers that never leave half a file."""

import json
import os

import numpy as np
import pytest

from jawusd.base.errors import FormatError, OutputError
from jawusd.base.npz import check_format
from jawusd.formats.atomic import atomic_path, write_bytes_atomic
from jawusd.formats.keys import Key, Keys, load_keys, save_keys
from jawusd.formats.poses import read_parameters, read_poses, write_parameters, write_poses
from jawusd.geometry import se3_exp, wxyz_from_matrix

T = se3_exp(np.random.default_rng(0).normal(size=(4, 6)) * [0.2, 0.2, 0.2, 5, 5, 5])
FRAMES = np.array([3, 4, 7, 9])


def test_poses_round_trip_in_all_their_forms(tmp_path):
    write_poses(tmp_path / "p.csv", FRAMES, T)
    frames, again = read_poses(tmp_path / "p.csv")
    np.testing.assert_array_equal(frames, FRAMES)
    np.testing.assert_array_equal(again, T)
    records = [
        {"frame": int(f), **dict(zip(("tx", "ty", "tz"), t, strict=True)), **dict(zip(("qw", "qx", "qy", "qz"), q))}
        for f, t, q in zip(FRAMES, T[:, :3, 3].tolist(), (2 * wxyz_from_matrix(T[:, :3, :3])).tolist(), strict=True)
    ]
    (tmp_path / "p.json").write_text(json.dumps(records))
    np.testing.assert_allclose(read_poses(tmp_path / "p.json")[1], T, atol=1e-12)


def test_parameters_round_trip(tmp_path):
    d = np.random.default_rng(1).normal(size=(4, 3))
    write_parameters(tmp_path / "d.csv", FRAMES, d)
    np.testing.assert_array_equal(read_parameters(tmp_path / "d.csv")[1], d)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("frame,d1,d2,d3\n1,2,3\n", "line 2 has 3 values"),
        ("frame,d1,d2,d3\n1,2,nan,4\n", 'line 2, column "d2" is nan'),
        ("frame,d1,d2,d3\n1,2,inf,4\n", "finite"),
        ("frame,d1,d2,d3\n1,2,x,4\n", '"x" is not a number'),
        ("frame,d1,d2\n1,2,3\n", 'no column "d3"'),
        ("time,d1,d2,d3\n1,2,3,4\n", 'no column "frame"'),
        ("frame,d1,d1,d3\n1,2,3,4\n", "duplicate"),
        ("frame,d1,d2,d3\n1.5,2,3,4\n", "whole numbers"),
    ],
)
def test_each_fault_in_a_parameter_table_is_named(tmp_path, text, words):
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(FormatError, match=words):
        read_parameters(tmp_path / "d.csv")


def test_poses_that_are_not_rigid_are_refused_with_their_row(tmp_path):
    scaled = T.copy()
    scaled[2, :3, :3] *= 1.1
    write_poses(tmp_path / "p.csv", FRAMES, scaled)
    with pytest.raises(FormatError, match="line 4"):
        read_poses(tmp_path / "p.csv")
    (tmp_path / "q.csv").write_text("frame,tx,ty,tz,qw,qx,qy,qz\n1,0,0,0,0,0,0,0\n")
    with pytest.raises(FormatError, match="quaternion is zero"):
        read_poses(tmp_path / "q.csv")
    (tmp_path / "n.csv").write_text("frame,a\n1,0\n")
    with pytest.raises(FormatError, match="neither"):
        read_poses(tmp_path / "n.csv")


def test_keys_round_trip_and_faults(tmp_path):
    keys = Keys(fps=24, interpolation="smooth", keys=(Key(frame=0, d=(0, 0, 0)), Key(frame=12, d=(20, 1, 2))))
    save_keys(tmp_path / "k.json", keys)
    assert load_keys(tmp_path / "k.json") == keys
    frames, d = keys.arrays()
    assert frames.tolist() == [0, 12] and d.shape == (2, 3)
    assert "tangents" not in (tmp_path / "k.json").read_text() and np.isnan(keys.tangents()).all()
    bent = keys.model_copy(update={"keys": (keys.keys[0], Key(frame=12, d=(20, 1, 2), tangents=(0.5, None, -1)))})
    save_keys(tmp_path / "k.json", bent)
    assert load_keys(tmp_path / "k.json") == bent
    np.testing.assert_array_equal(bent.tangents(), [[np.nan] * 3, [0.5, np.nan, -1]])
    for text, words in [
        ('{"fps": 24, "keys": []}', "keys"),
        ('{"fps": 24, "keys": [{"frame": 1, "d": [0,0,0]}, {"frame": 1, "d": [0,0,0]}]}', "must increase"),
        ('{"fps": 0, "keys": [{"frame": 1, "d": [0,0,0]}]}', "fps"),
        (
            '{"fps": 24, "keys": [{"frame": 1, "d": [0,0]}]}',
            r"keys, entry 1: d needs three numbers: d1, d2, d3 .*, "
            r"found \[0, 0\]",
        ),
        ('{"fps": 24, "keys": [{"frame": 1, "d": [1e300,0,0]}]}', r"entry 1: d needs three.*found 1e\+300"),
        ('{"fps": 24, "keys": [{"frame": 1}]}', "keys, entry 1: d needs three numbers"),
        ('{"fps": 24, "keys": [{"frame": 1, "d": [0,0,0]}, {"frame": 2, "d": [0,"x",0]}]}', 'entry 2: d needs .*"x"'),
        ('{"fps": 24, "keys": [{"d": [0,0,0]}]}', "keys, entry 1: frame needs a number"),
        ('{"fps": 24, "keys": [{"frame": 1, "d": [0,0,0], "D": 1}]}', 'unknown key "D"; allowed keys: frame, d, tan'),
        ('{"fps": 24, "keys": [{"frame": 1, "d": [0,0,0], "tangents": [1, 2]}]}', "1: tangents needs three numbers"),
        ('{"fps": 24, "keys": [{"frame": 1, "d": [0,0,0], "tangents": [1, null, "x"]}]}', "tangents needs three"),
        ('{"fps": 24, "keys": [7]}', "keys: entry 1 needs a JSON object, found 7"),
        ('{"fps": "fast", "keys": []}', 'fps needs a number above 0, at most 10000 .1/s., found "fast"'),
        ("[]", "the file needs a JSON object"),
        ('{"fps": 24, "interpolation": "cubic", "keys": [{"frame": 1, "d": [0,0,0]}]}', "interpolation"),
        ("{", "k2.json"),
    ]:
        (tmp_path / "k2.json").write_text(text)
        with pytest.raises(FormatError, match=words):
            load_keys(tmp_path / "k2.json")


def test_a_file_without_a_format_is_told_which_one_it_needs(tmp_path):
    with pytest.raises(FormatError, match='states no format; its format must be "jawusd-landmarks/1"'):
        check_format(None, "jawusd-landmarks", 1, tmp_path)


def test_a_failed_write_leaves_the_old_file_and_no_scraps(tmp_path):
    target = tmp_path / "file.txt"
    write_bytes_atomic(target, b"old")
    with pytest.raises(RuntimeError), atomic_path(target) as temporary:
        temporary.write_bytes(b"half")
        raise RuntimeError
    assert target.read_bytes() == b"old" and os.listdir(tmp_path) == ["file.txt"]


def test_a_folder_in_the_way_is_an_output_error(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="cannot write here"):
        write_bytes_atomic(tmp_path / "file" / "inside.txt", b"x")
