"""Tables of markers and rigid bodies: made-up samples of each format, and each mistake."""

import numpy as np
import pytest

from jawusd.base.errors import FormatError
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
    np.testing.assert_array_equal(read_markers(tmp_path / "speech.asc").points, expected)


def test_a_probe_of_artisynth_and_one_in_a_file_per_marker(tmp_path):
    (tmp_path / "probe.txt").write_text(PROBE)
    expected = [[[395.9, 355.5, -6.02], [401.0, 362.6, 32.4]], [[395.8, 355.4, -6.01], [401.1, 362.7, 32.5]]]
    np.testing.assert_array_equal(read_markers(tmp_path / "probe.txt").points, expected)
    (tmp_path / "zero.txt").write_text(PROBE.replace("395.9 355.5 -6.02", "0 0 0"))
    np.testing.assert_array_equal(read_markers(tmp_path / "zero.txt").points[0, 0], [0, 0, 0])  # a simulation's
    for marker in (0, 1):
        rows = "\n".join(" ".join(map(str, frame[marker])) for frame in expected)
        (tmp_path / f"Marker{marker + 1}_Traj.txt").write_text(f"0 0.04 1\nLinear 3 0.02\n{rows}\n")
    np.testing.assert_array_equal(read_markers(tmp_path / "Marker%d_Traj.txt").points, expected)


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
        ("", "has no frames"),
        ("1 2 3\n1 2\n", "line 2 has 2 numbers; expected 3"),
        ("1 2 3 4\n", "has 4 numbers per frame"),
        ("frame,m00\n1,2\n", "is not a table of marker positions"),
        ("a b c\n1 2 3\n", "is not a table of marker positions"),
        ("0 8 1\nLinear x 0.02\n1 2 3\n", "line 2 must be like"),
        ("0 8 1\nLinear 6 0.02\n1 2 3\n", "line 3 has 3 numbers; expected 6"),
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
        (" 3       ;Number of markers\n", "", 'there is no line "number of markers"'),
        (" 3 ", " 4 ", "declares 4 markers but lists 3"),
        ("8                 -66.5", "8                 nan", "not a finite number"),
        ("8                 -66.5", "x                 -66.5", 'not written as "number x y z views"'),
        ("8                 -66.5", "6                 -66.5", "each must be listed once"),
    ],
)
def test_each_mistake_of_a_description_is_named(tmp_path, old, new, words):
    (tmp_path / "jaw.rig").write_text(RIG.replace(old, new))
    with pytest.raises(FormatError, match=words):
        read_body(tmp_path / "jaw.rig")


@pytest.mark.parametrize(
    ("description", "words"), [("1,2", "at least three"), ("0,1,2", "numbered from 1"), ("head.rig", "no such")]
)
def test_each_mistake_of_numbers_is_named(description, words):
    with pytest.raises(FormatError, match=words):
        read_body(description)


NAMES = ("HL", "Head Right", "HF", "J1")
POINTS = np.random.default_rng(0).uniform(-900, 900, (6, 4, 3)).round(4)
SEEN = np.ones((6, 4), dtype=bool)
SEEN[1, 0] = SEEN[2, 3] = SEEN[4, 1] = SEEN[4, 3] = False


def cells(hidden=("", "", ""), digits=4, scale=1.0):
    """Return rows of numbers as text, a marker out of sight as told."""
    shown = [[f"{x:.{digits}f}" for x in point] for point in (POINTS * scale).reshape(-1, 3)]
    rows = [point if seen else list(hidden) for point, seen in zip(shown, SEEN.ravel(), strict=True)]
    return [sum(rows[4 * k : 4 * k + 4], []) for k in range(6)]


def joined(rows, sign="\t"):
    return "\n".join(sign.join(row) for row in rows) + "\n"


def german(text, old="\t"):
    return text.replace(".", ",").replace(old, ";") if old != "," else text.replace(",", ";").replace(".", ",")


def qtm(rows, sign="\t", extra=(), columns=()):
    head = [["NO_OF_FRAMES", "6"], ["NO_OF_CAMERAS", "8"], ["NO_OF_MARKERS", "4"], ["FREQUENCY", "120"]]
    head += [["DESCRIPTION", "--"], *extra, ["DATA_INCLUDED", "3D"], ["MARKER_NAMES", *NAMES], *columns]
    return joined([*head, *rows], sign)


def qtm_with_frames(rows):
    columns = ["Frame", "Time", *(f"{name} {axis}" for name in NAMES for axis in "XYZ")]
    kinds = ["TRAJECTORY_TYPES", *("Measured" for _ in NAMES)]
    rows = [[str(k + 1), f"{k / 120:.5f}", *row] for k, row in enumerate(rows)]
    return qtm(rows, extra=[["EVENT", "bite", "3", "0.02"]], columns=[kinds, columns])


def trc(rows, unit="mm", sign="\t", frames=None, said=6):
    keys = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate"]
    head = [["PathFileType", "4", "(X/Y/Z)", "take.trc"], keys, ["120", "120", str(said), "4", unit, "120"]]
    head += [["Frame#", "Time", *sum(([name, "", ""] for name in NAMES), [])]]
    head += [["", "", *(f"{axis}{k}" for k in range(1, 5) for axis in "XYZ")], [""]]
    frames = frames or range(1, len(rows) + 1)
    return joined(head + [[str(k), f"{(k - 1) / 120:.5f}", *row] for k, row in zip(frames, rows, strict=True)], sign)


def vicon(rows, unit="mm", outputs=False, speeds=False):
    names = sum(([f"Anna:{name}", "", ""] for name in NAMES), [])
    axes = ["X", "Y", "Z"] * 4
    units = [unit] * 12
    if speeds:
        names += ["Anna:HL", "", ""]
        axes, units, rows = axes + ["X'", "Y'", "Z'"], units + ["mm/s"] * 3, [[*row, "1", "2", "3"] for row in rows]
    head = [["Trajectories"], ["120"], ["", "", *names], ["Frame", "Sub Frame", *axes], ["", "", *units]]
    table = head + [[str(k), "0", *row] for k, row in enumerate(rows, start=11)]
    other = [["120"], ["", "", "Anna:JawAngles", "", ""], ["Frame", "Sub Frame", "X", "Y", "Z"], ["", "", *3 * ["deg"]]]
    other += [[str(k), "0", "1.5", "2.5", "3.5"] for k in range(11, 17)] + [[""]]
    if outputs:
        table = [["Model Outputs"], *other, *table, [""], ["Devices"], *other]
    return joined(table, ",")


ZEROS, NANS = ("0.000", "0.000", "0.000"), ("nan", "nan", "nan")
# name: text, encoding, whether markers have names, unit, rate
TABLES = {
    "QTM, hidden blank": (qtm(cells()), "utf-8", True, "mm", 120),
    "QTM, hidden 0": (qtm(cells(ZEROS)), "utf-8", True, "mm", 120),
    "QTM, frame, time, events": (qtm_with_frames(cells(NANS)), "utf-8", True, "mm", 120),
    "QTM as UTF-16": (qtm(cells()), "utf-16", True, "mm", 120),
    "QTM with a byte order mark, CRLF": (qtm(cells()).replace("\n", "\r\n"), "utf-8-sig", True, "mm", 120),
    "QTM through a German spreadsheet": (german(qtm(cells())), "utf-8", True, "mm", 120),
    "QTM with commas": (qtm(cells(), ","), "utf-8", True, "mm", 120),
    "TRC, hidden blank": (trc(cells()), "utf-8", True, "mm", 120),
    "TRC in metres, hidden 0": (trc(cells(ZEROS, 7, 1e-3), "m"), "utf-8", True, "m", 120),
    "TRC, blank columns at the end cut": (trc(cells()).replace("\t\t\t\n", "\n"), "utf-8-sig", True, "mm", 120),
    "TRC, old Mac": (trc(cells(NANS)).replace("\n", "\r"), "utf-8", True, "mm", 120),
    "TRC through a German spreadsheet": (german(trc(cells())).replace("take,trc", "t"), "utf-8", True, "mm", 120),
    "Vicon": (vicon(cells()), "utf-8", True, "mm", 120),
    "Vicon with model outputs and devices": (vicon(cells(), outputs=True), "utf-8-sig", True, "mm", 120),
    "Vicon with speeds": (vicon(cells(), speeds=True), "utf-8", True, "mm", 120),
    "Vicon in metres": (vicon(cells(digits=7, scale=1e-3), "m"), "utf-8", True, "m", 120),
    "Vicon through a German spreadsheet": (german(vicon(cells()), ","), "utf-8", True, "mm", 120),
    "numbers, blanks": (joined(cells(NANS), " "), "utf-8", False, None, None),
    "numbers, blanks, byte order mark": (joined(cells(NANS), " "), "utf-8-sig", False, None, None),
    "numbers, commas": (joined(cells(), ","), "utf-8", False, None, None),
    "numbers, commas and blanks": (joined(cells(NANS), ", "), "utf-8", False, None, None),
    "numbers, tabs, 0": (joined(cells(ZEROS)), "utf-8", False, None, None),
    "numbers, tabs at the end": (joined([[*row, ""] for row in cells()]), "utf-8", False, None, None),
    "numbers, semicolons, decimal commas": (german(joined(cells())), "utf-8", False, None, None),
    "numbers, blanks, decimal commas": (joined(cells(NANS), " ").replace(".", ","), "utf-8", False, None, None),
    "numbers, tabs, UTF-16": (joined(cells()), "utf-16-le", False, None, None),
}


@pytest.mark.parametrize("case", TABLES)
def test_tables_of_markers_as_programs_write_them(tmp_path, case):
    text, encoding, named, unit, fps = TABLES[case]
    (tmp_path / "take.txt").write_bytes(text.encode(encoding))
    found = read_markers(tmp_path / "take.txt")
    assert [name.rpartition(":")[2] for name in found.names] == (list(NAMES) if named else [])
    assert (found.unit, found.fps) == (unit, fps)
    scale = 1e-3 if unit == "m" else 1.0
    np.testing.assert_allclose(found.points, np.where(SEEN[..., None], POINTS * scale, np.nan), atol=1e-9)


def test_frames_that_a_table_leaves_out_show_no_markers(tmp_path):
    (tmp_path / "take.trc").write_text(trc(cells(), frames=[3, 4, 5, 8, 9, 10]))
    points = read_markers(tmp_path / "take.trc").points
    assert points.shape == (8, 4, 3) and np.isnan(points[3:5]).all()
    np.testing.assert_allclose(points[5], np.where(SEEN[3, :, None], POINTS[3], np.nan))
    (tmp_path / "take.tsv").write_text(joined([*cells()[:2], 12 * [""], *cells()[2:]]))
    assert np.isnan(read_markers(tmp_path / "take.tsv").points[2]).all()


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.tsv", qtm(cells()[:4]), "its header declares 6 frames, but it has 4"),
        ("a.trc", trc(cells()[:5]), "its header declares 6 frames, but it has 5"),
        ("a.trc", trc(cells(ZEROS))[:-40], "numbers; expected 12"),
        ("a.trc", trc(cells(), unit="inch"), 'lengths are in "inch"; the unit must be one of mm, cm, m'),
        ("a.trc", trc(cells(), frames=[1, 2, 2, 3, 4, 5]), "must be increasing whole numbers"),
        ("a.tsv", qtm(cells()).replace("\t4\n", "\t5\n", 1), "declares 5 markers but names 4"),
        ("a.tsv", qtm(cells()).replace("DATA_INCLUDED\t3D", "DATA_INCLUDED\t6D"), "contains 6D data from Qualisys"),
        ("a.csv", vicon(cells(), outputs=True).replace("Trajectories", "Joints"), "Model Outputs, Joints, Devices"),
        ("a.csv", vicon(cells()).replace("X,Y,Z", "RX,RY,RZ"), "has no markers"),
        ("a.csv", "Format Version,1.23,Take Name,t\n\n,Type,Marker\n", "OptiTrack Motive, not a supported marker"),
        ("a.mot", "Coordinates\nversion=1\n", "is a motion file of OpenSim"),
        ("a.csv", joined(cells(NANS), ",").replace(".", ","), "commas both as decimal and as column separators"),
        ("a.csv", german(joined(cells())).replace(",", ".", 1), "commas and points cannot both be decimal separators"),
        ("a.csv", "1,234;2,345;3,456\n", '"1,234" is ambiguous: 1.234 or 1234'),
        ("a.txt", "time x y z\n0 1 2 3\n", "Supported are C3D, TSV of Qualisys"),
    ],
)
def test_what_is_not_read_is_refused_by_name(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError, match=words):
        read_markers(tmp_path / name)
