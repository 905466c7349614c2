"""Tables as spreadsheets of any locale write them: every reader gives what the plain table gives."""

import numpy as np
import pytest

from jawusd.base.errors import FormatError
from jawusd.base.tables import read_table, read_text
from jawusd.cameras.files import load_cameras_file
from jawusd.formats.arkit import read_arkit
from jawusd.formats.performance import HEADER
from jawusd.formats.poses import read_parameters, read_poses, read_poses_or_parameters

RNG = np.random.default_rng(0)


def rows_of(header, values, first=()):
    """Return a table as rows of text."""
    named = [*first] or [[str(k)] for k in range(len(values))]
    return [header.split(), *([*name, *(f"{x:.6f}" for x in row)] for name, row in zip(named, values, strict=True))]


QUATERNIONS = RNG.normal(size=(5, 4))
POSES = np.column_stack([RNG.normal(size=(5, 3)) * 30, QUATERNIONS / np.linalg.norm(QUATERNIONS, axis=1)[:, None]])
MATRICES = np.tile(np.eye(4).ravel(), (5, 1)) + np.outer(range(5), np.eye(16)[3] * 1.25)
WEIGHTS = RNG.uniform(0, 1, (60, 4))
CODES = [[f"14:00:{k // 25:02d}:{k % 25:02d}.207", "61"] for k in range(60)]
VIEWS = RNG.uniform(0.1, 0.9, (2, 7))
D = RNG.uniform(0, 9, (5, 3))
CELLS = ["frame", *(f"m{r}{c}" for r in range(4) for c in range(4))]


def cameras(path):
    found = load_cameras_file(path, 1000.0, dict.fromkeys("ab", (1920, 1080)))
    return np.concatenate([camera.T_cam_world.ravel() for camera in found])


def table_of_evaluator(path):
    from jawusd.evaluator.__main__ import _read_poses

    return _read_poses(path)[1]


# name: rows, reader
READERS = {
    "poses": (rows_of("frame tx ty tz qw qx qy qz", POSES), lambda path: read_poses(path)[1]),
    "poses of other names": (
        rows_of("Frame X Y Z W I J K", POSES),
        lambda path: read_poses(path, dict(zip(("tx", "ty", "tz", "qw", "qx", "qy", "qz"), "XYZWIJK")))[1],
    ),
    "matrices or d": (rows_of(" ".join(CELLS), MATRICES), lambda path: read_poses_or_parameters(path)[1]),
    "d": (rows_of("frame d1 d2 d3", D), lambda path: read_parameters(path)[1]),
    "the table of a solve": (
        [
            [*row, "inside", "solved"] if k else list(HEADER)
            for k, row in enumerate(rows_of("f", RNG.uniform(0, 9, (5, 8))))
        ],
        lambda path: read_parameters(path)[1],
    ),
    "ARKit": (
        rows_of("Timecode BlendShapeCount JawOpen JawLeft JawRight JawForward", WEIGHTS, CODES),
        lambda path: np.column_stack([read_arkit(path).frames, read_arkit(path).X]),
    ),
    "RealityScan": (rows_of("#name x y alt heading pitch roll f", VIEWS, [["a.jpg"], ["b.jpg"]]), cameras),
    "the evaluator's command": (rows_of(" ".join(CELLS), MATRICES), table_of_evaluator),
}


def joined(rows, sign):
    return "\n".join(sign.join(row) for row in rows) + "\n"


def quoted(rows, sign):
    return joined([[f'"{cell}"' for cell in row] for row in rows], sign)


def with_commas(rows):
    """Return rows with decimal commas; time codes keep their points, as text does in spreadsheets."""
    return [
        [cell.replace(".", ",") if cell.count(":") == 0 and "jpg" not in cell else cell for cell in row] for row in rows
    ]


def padded(rows):
    return [[*row, "", ""] for row in rows] + [[""] * (len(rows[0]) + 2)] * 3


LOCALES = {
    "semicolons": lambda rows: joined(rows, ";").encode(),
    "semicolons, decimal commas": lambda rows: joined(with_commas(rows), ";").encode(),
    "the same with a byte order mark, CRLF": lambda rows: (
        joined(with_commas(rows), ";").replace("\n", "\r\n").encode("utf-8-sig")
    ),
    "tabs, decimal commas, UTF-16": lambda rows: joined(with_commas(rows), "\t").encode("utf-16"),
    "tabs, UTF-16, big end first": lambda rows: ("\ufeff" + joined(rows, "\t")).encode("utf-16-be"),
    "UTF-16 without a byte order mark": lambda rows: joined(rows, ",").encode("utf-16-le"),
    "UTF-32": lambda rows: joined(rows, ",").encode("utf-32"),
    "commas, decimal commas in quotes": lambda rows: quoted(with_commas(rows), ",").encode(),
    "all in quotes": lambda rows: quoted(rows, ",").encode(),
    "old Mac": lambda rows: joined(rows, ",").replace("\n", "\r").encode(),
    "blank columns and rows at the end": lambda rows: joined(padded(rows), ",").encode(),
    "the same with semicolons": lambda rows: joined(padded(with_commas(rows)), ";").encode(),
    "a blank column at the end of the header": lambda rows: joined([[*rows[0], ""], *rows[1:]], ",").encode(),
    "sep=;": lambda rows: ("sep=;\r\n" + joined(with_commas(rows), ";")).encode("utf-8-sig"),
    "sep=, in quotes": lambda rows: ('"sep=,"\n' + joined(rows, ",")).encode(),
    "sep=|": lambda rows: ("SEP=|\n" + joined(rows, "|")).encode(),
    "blank lines": lambda rows: ("\n\n" + joined(rows, ",").replace("\n", "\n\n")).encode(),
}


@pytest.mark.parametrize("locale", LOCALES)
@pytest.mark.parametrize("reader", READERS)
def test_every_reader_reads_tables_of_every_locale(tmp_path, reader, locale):
    rows, read = READERS[reader]
    (tmp_path / "plain.csv").write_text(joined(rows, ","))
    (tmp_path / "local.csv").write_bytes(LOCALES[locale](rows))
    plain = read(tmp_path / "plain.csv")
    assert plain.size > 4
    np.testing.assert_array_equal(read(tmp_path / "local.csv"), plain)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frame;d1;d2;d3\n1;1,234;2,345;3,456\n", '"1,234" is ambiguous: 1.234 or 1234'),
        ("frame\td1\td2\td3\n1\t10,500\t2\t3\n", 'line 2, column "d1": "10,500" is ambiguous: 10.500 or 10500'),
        ('frame,d1,d2,d3\n1,"12,345",2,3\n', '"12,345" is ambiguous: 12.345 or 12345'),
        ("frame;d1;d2;d3\n1;1,5;2.5;3\n", "commas and points cannot both be decimal separators"),
        ("frame;d1;d2;d3\n1;1.234,5;2,5;3\n", "thousands separators are not allowed"),
        ('frame,d1,d2,d3\n1,"1,234.5",2.5,3\n', "thousands separators are not allowed"),
        ("frame;d1;d2;d3\n1;1,234,567;2,5;3\n", '"1,234,567" is not a number'),
        ("frame;d1;d2;d3\n1,000;1,5;2,5;3\n", 'column "frame": "1,000" is ambiguous: 1.000 or 1000'),
        ("frame,d1,d2,d3\n1,0,5,0,2,0,1\n", "line 2 has 7 values, .* 4 columns. .* write decimals with points"),
        ("frame;d1;d2;d3\n1;1 234,5;2,5;3\n", '"1 234,5" is not a number'),
        ('frame,d1,d2,d3\n1,"2,3,4\n', "is not a CSV table"),
    ],
)
def test_numbers_that_may_be_two_are_refused(tmp_path, text, words):
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(FormatError, match=words):
        read_parameters(tmp_path / "d.csv")


@pytest.mark.parametrize(
    ("text", "d"),
    [
        ("frame;d1;d2;d3\n1;0,123;1,234;2,345\n", [0.123, 1.234, 2.345]),  # no thousands begin with 0
        ("frame;d1;d2;d3\n1;1,5;-1,234;+2,345\n", [1.5, -1.234, 2.345]),  # the first tells
        ("frame;d1;d2;d3\n1;1,5e1;,25;3,\n", [15, 0.25, 3]),
        ("frame;d1;d2;d3\n1;1.234;2;3\n", [1.234, 2, 3]),  # a point alone is the decimal separator
        ('frame,d1,d2,d3,note\n1,1.5,2,3,"1,234; or so"\n', [1.5, 2, 3]),  # other columns do not count
        ("frame,note;more,d1,d2,d3\n1,x,1,2,3\n", [1, 2, 3]),
        ("# from a; spreadsheet\nframe,d1,d2,d3\n1,1,2,3\n", [1, 2, 3]),
    ],
)
def test_what_separates_and_what_is_decimal_is_found(tmp_path, text, d):
    (tmp_path / "d.csv").write_text(text)
    np.testing.assert_array_equal(read_parameters(tmp_path / "d.csv")[1], [d])


def test_lines_are_those_of_the_file(tmp_path):
    (tmp_path / "d.csv").write_text('sep=;\n# by hand\nframe;"two\nlines";d1;d2;d3\n\n1;;1;2;x\n')
    with pytest.raises(FormatError, match='line 6, column "d3": "x"'):
        read_parameters(tmp_path / "d.csv")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ("frame;Öffnung\n".encode("latin-1"), "is not UTF-8 text: line 1 has the byte 0xd6"),
        ("frame;d1\n".encode("utf-16")[:-1], "begins as UTF-16 text but has bytes that are invalid in it"),
        (b"", "is empty"),
        (b"\xef\xbb\xbf", "is empty"),
        (b";;;\n;;\n", "is empty"),
    ],
)
def test_what_is_no_table_is_said(tmp_path, data, words):
    (tmp_path / "d.csv").write_bytes(data)
    with pytest.raises(FormatError, match=words):
        read_table(tmp_path / "d.csv", 1000)


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    (tmp_path / "d.csv").write_text(1001 * "1")
    with pytest.raises(FormatError, match="is 1001 bytes long; at most 1000 bytes are allowed"):
        read_text(tmp_path / "d.csv", 1000)


def test_a_table_of_neither_poses_nor_d_is_told_of_both(tmp_path):
    (tmp_path / "d.csv").write_text("frame,opening,lateral\n1,2,3\n")
    with pytest.raises(FormatError) as error:
        read_poses_or_parameters(tmp_path / "d.csv")
    words = (
        "Name the columns frame, d1, d2, d3: opening, laterotrusion and protrusion in mm.",
        "m00 ... m23",
        "tx, ty",
        "it has frame, opening, lateral",
    )
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("d.csv", "Frame,D1,D2,D3\n1,0,0,0\n", "it has Frame, D1, D2, D3. Write the column names in lower case."),
        ("d.csv", "frame d1 d2 d3\n1 0 0 0\n", "Separate the columns by commas."),
        ("d.csv", "Timecode,JawOpen\n1,0.5\n", "jawusd animate RIG --arkit"),
        ("d.csv", "1,0,0,0\n2,5,0,0\n", "numbers in its first line: 1, 0, 0, 0. The first line must name the columns"),
        ("d.json", '[{"frame": 1, "d": [0, 0, 0]}]', 'Write keys as {"fps": 24, "keys": '),
    ],
)
def test_mistakes_of_beginners_in_tables_of_d_are_told_what_to_write(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError) as error:
        read_poses_or_parameters(tmp_path / name)
    assert words in str(error.value)
