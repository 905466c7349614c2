"""Read text files with errors that name the file."""

from __future__ import annotations

from pathlib import Path

from jawusd.errors import FormatError


def read_text(path: Path, most_bytes: int, encoding: str = "utf-8") -> str:
    """Return what a text file holds; the encoding "utf-8-sig" drops the byte order mark that spreadsheets write.

    Raises:
        FormatError: missing, too large or not UTF-8.
    """
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
