"""Read text files, TOML and JSON with errors that name the file."""

from __future__ import annotations

import json
import os
import tomllib
from pathlib import Path

from jawusd.errors import FormatError
from jawusd.inputs import check_input

_MOST_TOML_BYTES = 4 << 20


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
        raise FormatError(f"is not UTF-8 text ({error}).", path=path) from error
    except OSError as error:
        raise FormatError(f"cannot be read: {error.strerror}.", path=path) from error


def read_toml(path: str | os.PathLike[str]) -> dict[str, object]:
    """Return the tables and values of a TOML file.

    Raises:
        FormatError: missing, too large, not UTF-8 or not TOML.
    """
    path = Path(path)
    try:
        return tomllib.loads(read_text(path, _MOST_TOML_BYTES))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        hint = 'Text stands in quotes, as name = "anna", and tables in brackets, as [scans].'
        raise FormatError(f"is not valid TOML: {error}.", path=path, hint=hint) from error


def parse_json(text: str, path: Path) -> object:
    """Return the value of a JSON text read from a file.

    Raises:
        FormatError: it is not JSON.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"is not JSON ({error}).", path=path) from error
