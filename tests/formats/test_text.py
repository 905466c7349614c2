"""Text files of hostile make end in one message, soon."""

import pytest

from jawusd.errors import FormatError
from jawusd.formats.text import read_toml


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a" + 100_000 * ".a" + " = 1", "more than 64 names"),  # tomllib takes hours
        ("[" + 70 * "a." + "b]", "more than 64 names"),
        (70 * "'a' . " + "b = 1", "more than 64 names"),
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
