"""Read text files, TOML and JSON with errors that name the file."""

from __future__ import annotations

import json
import os
import re
import tomllib
from pathlib import Path

from jawusd.errors import FormatError
from jawusd.inputs import check_input

_MOST_TOML_BYTES = 4 << 20
_SHOWN = 80  # characters of a line
_WIDE = (b"\xff\xfe", b"\xfe\xff")  # byte order marks of UTF-16
_AS_UTF8 = "Save it as UTF-8: editors ask for the encoding under Save As."
# Tables within tables that one key may name: tomllib takes time by their square, hours for a file of 200 kB.
_MOST_DOTS = 64
_NAME = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:{_NAME}[ \t]*+\.[ \t]*+){{{_MOST_DOTS}}}", re.ASCII)


def read_text(path: Path, most_bytes: int, encoding: str = "utf-8") -> str:
    """Return what a text file holds; the encoding "utf-8-sig" drops the byte order mark that spreadsheets write.

    Raises:
        FormatError: missing, no file, too large or not UTF-8.
    """
    check_input(path)
    try:
        size = path.stat().st_size
        if size > most_bytes:
            raise FormatError(f"is {size} bytes, at most {most_bytes} are read.", path=path)
        return path.read_text(encoding=encoding)
    except FileNotFoundError as error:
        raise FormatError("there is no such file.", path=path) from error
    except UnicodeDecodeError as error:
        raise _not_utf8(path, error) from error
    except OSError as error:
        raise FormatError(f"cannot be read: {error.strerror}.", path=path) from error


def _not_utf8(path: Path, error: UnicodeDecodeError) -> FormatError:
    if error.object[:2] in _WIDE:
        return FormatError("is UTF-16 text, allowed is UTF-8.", path=path, hint=_AS_UTF8)
    line, byte = error.object[: error.start].count(b"\n") + 1, error.object[error.start]
    return FormatError(
        f"is not UTF-8 text: line {line} holds the byte 0x{byte:02x}, as an accented letter in another encoding.",
        path=path,
        hint=_AS_UTF8,
    )


def read_toml(path: str | os.PathLike[str]) -> dict[str, object]:
    """Return the tables and values of a TOML file, with a byte order mark or without.

    Raises:
        FormatError: missing, too large, not UTF-8 or not TOML.
    """
    path = Path(path)
    text = read_text(path, _MOST_TOML_BYTES, "utf-8-sig")
    if _LONG_KEY.search(text):
        raise FormatError(f"has a key of more than {_MOST_DOTS} names with dots between.", path=path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also of numbers of more than 4300 digits
        said, hint = _not_toml(text, str(error))
        raise FormatError(f"is not valid TOML: {said}.", path=path, hint=hint) from error


def _not_toml(text: str, said: str) -> tuple[str, str]:
    """Return what is wrong with the line that an error of tomllib names, and what to do."""
    place = re.search(r" \(at line (\d+), column \d+\)$", said)
    line = text.split("\n")[int(place[1]) - 1].strip() if place else ""
    if place:
        said = f"line {place[1]}, {line[:_SHOWN]}: {said[: place.start()]}"
    if "\\" in line:
        return said, 'Write paths with slashes, as "video/left.mp4", on Windows too.'
    if re.search("[\u2018-\u201f\u00ab\u00bb]", line):
        return said, 'Write straight quotes, as name = "anna"; word processors make others of them.'
    return said, 'Text stands in quotes, as name = "anna", and tables in brackets, as [scans].'


def parse_json(text: str, path: Path) -> object:
    """Return the value of a JSON text read from a file.

    Raises:
        FormatError: it is not JSON.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"is not JSON ({error}).", path=path) from error
