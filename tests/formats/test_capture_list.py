"""Lists of captures: paths beside the file, names of folders, and each way a line can be wrong."""

from pathlib import Path

import pytest

from jawusd.base.errors import FormatError
from jawusd.formats.capture_list import ListedCapture, load_capture_list


def written(tmp_path, text):
    path = tmp_path / "list.txt"
    path.write_text(text)
    return path


def test_paths_are_relative_to_the_list_and_names_follow_from_them(tmp_path):
    text = '# a shoot\n\nday/anna/capture.toml\n  ben , again\n/abs/eve.toml\n"c, d", cd,\n../up,,\n'
    assert load_capture_list(written(tmp_path, text)) == [
        ListedCapture(tmp_path / "day/anna/capture.toml", "anna"),
        ListedCapture(tmp_path / "ben", "again"),
        ListedCapture(Path("/abs/eve.toml"), "eve"),
        ListedCapture(tmp_path / "c, d", "cd"),
        ListedCapture(tmp_path.parent / "up", "up"),
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "lists no captures"),
        ("# nothing\n", "lists no captures"),
        ("a/anna\nb/Anna\n", "lines 1 and 2.*PATH, NAME"),
        ("anna, x, y\n", "line 1 must be"),
        (", x\n", "line 1 must be"),
        ('"anna\n', "line 1 is not CSV"),
        ("anna, ../out\n", "not a valid folder name"),
        ("anna, .\n", "not a valid folder name"),
        ("/\n", "not a valid folder name"),
        ("an\0na\n", "line 1"),
    ],
)
def test_a_wrong_line_is_one_clear_error(tmp_path, text, words):
    with pytest.raises(FormatError, match=words):
        load_capture_list(written(tmp_path, text))


def test_a_list_that_is_no_text_or_not_there_is_one_clear_error(tmp_path):
    (tmp_path / "b").write_bytes(b"\xff\xfe\x00")
    for name, words in (("b", "UTF-8"), ("c", "no such file"), (".", "is not a regular file")):
        with pytest.raises(FormatError, match=words):
            load_capture_list(tmp_path / name)
