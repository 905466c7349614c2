"""Read TOML with errors that name file and line."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

from jawusd.errors import FormatError
from jawusd.formats.text import read_text

_MAX_BYTES = 4 << 20


def read_toml(path: str | os.PathLike[str]) -> dict[str, object]:
    """Read a TOML file.

    Raises:
        FormatError: missing, too large, not UTF-8 or not TOML.
    """
    path = Path(path)
    try:
        return tomllib.loads(read_text(path, _MAX_BYTES))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise FormatError(f"is not valid TOML: {error}.", path=path) from error
