"""Text files of hostile make end in one message, soon."""

import json

import pytest

from jawusd.base.errors import FormatError
from jawusd.formats.keys import load_keys
from jawusd.formats.landmarks import load_landmarks
from jawusd.formats.poses import read_parameters
from jawusd.formats.text import read_json, read_toml
from jawusd.geometry import LANDMARKS


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a" + 100_000 * ".a" + " = 1", "more than 64 parts"),  # tomllib takes hours
        ("[" + 70 * "a." + "b]", "more than 64 parts"),
        (70 * "'a' . " + "b = 1", "more than 64 parts"),
        ("a = " + 5000 * "9", "not valid TOML"),
        ("a = 0x" + 5000 * "f" + "\na = 1", "not valid TOML"),
        ("a = " + 50_000 * "[", "not valid TOML"),
        ("a = " + 50_000 * "{a = ", "not valid TOML"),
    ],
)
def test_hostile_toml_is_one_message(text, said, tmp_path):
    path = tmp_path / "capture.toml"
    path.write_text(text)
    with pytest.raises(FormatError, match=said):
        read_toml(path)


def test_keys_of_several_names_are_read(tmp_path):
    path = tmp_path / "capture.toml"
    path.write_text('[a.b]\nc.d."e" = 1\n# ' + 100 * "a.b " + '\nf = "' + 100 * "x. y, " + '"\n')
    assert read_toml(path)["a"]["b"]["c"] == {"d": {"e": 1}}


PLACES = {"format": "jawusd-landmarks/1", "units": "mm", "landmarks": {name: [1, 2, 3] for name in LANDMARKS}}
FILES = {
    "keys.json": (json.dumps({"fps": 24, "keys": [{"frame": 0, "d": [0, 0, 0]}]}, indent=1), load_keys),
    "landmarks.json": (json.dumps(PLACES, indent=1), lambda path: load_landmarks(path).landmarks.tolist()),
    "d.json": (json.dumps([{"frame": 1, "d1": 1, "d2": 2, "d3": 3}]), lambda path: read_parameters(path)[1].tolist()),
    "capture.toml": ('name = "Zoë"\n[a]\nb = 1 # c\n', read_toml),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-32"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_json_and_toml_of_every_encoding_are_read(tmp_path, name, encoding, end):
    text, read = FILES[name]
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    plain = read(path)
    path.write_bytes(text.replace("\n", end).encode(encoding))
    assert read(path) == plain


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{\n "fps": 24, // rate\n "keys": []}', 'line 2, "fps": 24, // rate: .*JSON has none'),
        ("# keys\n{}", "line 1, # keys: .*JSON has none"),
        ('{"a": 1, /* b */ "b": 2}', "JSON has none"),
        ('{"a": [1, 2,]}', "Remove the comma before it"),
        ('{"a": 1,\n}', "line 2, }: .*Remove the comma before it"),
        ("{'a': 1}", "straight double quotes"),
        ('{"a": 1', 'line 1, {"a": 1: '),
        ("", "is empty"),
        ("[" * 100_000, "is not JSON"),
    ],
)
def test_what_is_not_json_is_named_with_its_line(tmp_path, text, words):
    path = tmp_path / "a.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FormatError, match=words):
        read_json(path, 1 << 20)
