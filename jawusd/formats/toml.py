"""Read TOML with errors that name file and line."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

from jawusd.errors import FormatError

_MAX_BYTES = 4 << 20


def read_toml(path: str | os.PathLike[str]) -> dict:
    """Read a TOML file.

    Raises:
        FormatError: missing, too large, not UTF-8 or not TOML.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise FormatError(f"is {path.stat().st_size} bytes, at most {_MAX_BYTES} are read.", path=path)
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FormatError("there is no such file.", path=path) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FormatError(f"is not valid TOML: {error}.", path=path) from error
    except OSError as error:
        raise FormatError(f"cannot be read: {error.strerror}.", path=path) from error
