"""Tables of markers and rigid bodies: made-up samples of each format, and each mistake."""

import numpy as np
import pytest

from jawusd.errors import FormatError
from jawusd.formats.markers import read_body, read_markers

# as opto2ascii writes: a marker out of sight is a huge number
NDI = """1.000000e+02 2.000000e+02 -2.500000e+03 1.500000e+02 2.000000e+02 -2.500000e+03
1.010000e+02 2.000000e+02 -2.500000e+03 -3.697314e+28 -3.697314e+28 -3.697314e+28
"""
PROBE = "0 0.04 1 \nLinear 6 0.02 \n395.9 355.5 -6.02 401.0 362.6 32.4 \n395.8 355.4 -6.01 401.1 362.7 32.5 \n"
RIG = """Marker Description File

Real 3D
 3       ;Number of markers
1      ;Number of different views
Front
Marker       X          Y         Z      Views
5                 -69.5      -15.75       99.9    1
6                 -20.25     -23.5      109.25    1
8                 -66.5      23.75      105.0    1
"""


def test_a_table_of_numbers_alone(tmp_path):
    (tmp_path / "speech.asc").write_text(NDI)
    expected = [[[100, 200, -2500], [150, 200, -2500]], [[101, 200, -2500], [np.nan] * 3]]
    np.testing.assert_array_equal(read_markers(tmp_path / "speech.asc"), expected)


def test_a_probe_of_artisynth_and_one_in_a_file_per_marker(tmp_path):
    (tmp_path / "probe.txt").write_text(PROBE)
    expected = [[[395.9, 355.5, -6.02], [401.0, 362.6, 32.4]], [[395.8, 355.4, -6.01], [401.1, 362.7, 32.5]]]
    np.testing.assert_array_equal(read_markers(tmp_path / "probe.txt"), expected)
    for marker in (0, 1):
        rows = "\n".join(" ".join(map(str, frame[marker])) for frame in expected)
        (tmp_path / f"Marker{marker + 1}_Traj.txt").write_text(f"0 0.04 1\nLinear 3 0.02\n{rows}\n")
    np.testing.assert_array_equal(read_markers(tmp_path / "Marker%d_Traj.txt"), expected)


def test_a_marker_description_and_numbers(tmp_path):
    (tmp_path / "jaw.rig").write_text(RIG)
    body = read_body(tmp_path / "jaw.rig")
    assert body.markers == (5, 6, 8)
    np.testing.assert_array_equal(body.points, [[-69.5, -15.75, 99.9], [-20.25, -23.5, 109.25], [-66.5, 23.75, 105.0]])
    body = read_body("5, 6,8")
    assert body.markers == (5, 6, 8) and body.points is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no frames"),
        ("1 2 3\n1 2\n", "line 2 has 2 numbers, 3 are expected"),
        ("1 2 3 4\n", "has 4 numbers per frame"),
        ("frame,m00\n1,2\n", "per frame"),
        ("a b c\n1 2 3\n", "is not a table of marker positions"),
        ("0 8 1\nLinear x 0.02\n1 2 3\n", "line 2 is not that of an ArtiSynth probe"),
        ("0 8 1\nLinear 6 0.02\n1 2 3\n", "line 3 has 3 numbers, 6 are expected"),
    ],
)
def test_each_mistake_of_a_table_is_named(tmp_path, text, words):
    (tmp_path / "markers.txt").write_text(text)
    with pytest.raises(FormatError, match=words):
        read_markers(tmp_path / "markers.txt")


def test_tables_of_different_lengths_are_told(tmp_path):
    (tmp_path / "m1.txt").write_text("1 2 3\n")
    (tmp_path / "m2.txt").write_text("1 2 3\n1 2 3\n")
    with pytest.raises(FormatError, match="m1.txt has 1, m2.txt has 2"):
        read_markers(tmp_path / "m%d.txt")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (" 3       ;Number of markers\n", "", 'no line tells the "number of markers"'),
        (" 3 ", " 4 ", "says that it has 4 markers and lists 3"),
        ("8                 -66.5", "8                 nan", "not a finite number"),
        ("8                 -66.5", "x                 -66.5", 'not written as "number x y z views"'),
        ("8                 -66.5", "6                 -66.5", "each must be named once"),
    ],
)
def test_each_mistake_of_a_description_is_named(tmp_path, old, new, words):
    (tmp_path / "jaw.rig").write_text(RIG.replace(old, new))
    with pytest.raises(FormatError, match=words):
        read_body(tmp_path / "jaw.rig")


@pytest.mark.parametrize(
    ("description", "words"), [("1,2", "three or more"), ("0,1,2", "counted from 1"), ("head.rig", "no such")]
)
def test_each_mistake_of_numbers_is_named(description, words):
    with pytest.raises(FormatError, match=words):
        read_body(description)
