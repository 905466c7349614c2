"""The log of a run: everything it prints, with the time, its command line and versions; and errors in full."""

from __future__ import annotations

import platform
import re
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from jawusd.base.errors import OutputError, shown

_CODES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class RunLog:
    """Write lines to a file, each with the seconds since the start."""

    def __init__(self, path: Path, words: list[str]) -> None:
        """Begin a file with the command line and versions.

        Raises:
            OutputError: it cannot be written.
        """
        from jawusd.base.version import __version__
        from jawusd.formats.atomic import destination, is_stream, open_stream

        self._start = time.monotonic()
        where = destination(path)
        try:
            to = open_stream(where) if is_stream(where) else where
            self._file = open(to, "a", encoding="utf-8")  # noqa: SIM115  # open until the run ends
        except OSError as error:
            raise OutputError(f"the log cannot be written: {error.strerror}.", path=path) from error
        self.line(f"{time.strftime('%Y-%m-%d %H:%M:%S')} jawusd {' '.join(map(shown, words))}")
        self.line(f"jawusd {__version__}, Python {platform.python_version()}, {platform.platform()}, in {Path.cwd()}")

    def line(self, text: str) -> None:
        """Add lines."""
        for part in _CODES.sub("", text).split("\n"):
            if part.strip():
                self._file.write(f"{time.monotonic() - self._start:9.2f}  {shown(part.rstrip())}\n")
        self._file.flush()

    def error(self, error: BaseException) -> None:
        """Add an error with the places it came from."""
        self.line("".join(traceback.format_exception(error)))

    def close(self) -> None:
        """End the file."""
        self._file.close()


class _Copied:
    """A stream whose lines also go to a log."""

    def __init__(self, stream: TextIO, log: RunLog) -> None:
        self._stream, self._log, self._pending = stream, log, ""

    def write(self, text: str) -> int:
        self._pending += text
        *lines, self._pending = self._pending.split("\n")
        for line in lines:
            self._log.line(line.rpartition("\r")[2])
        return self._stream.write(text)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


@contextmanager
def logged(path: Path, words: list[str]) -> Iterator[RunLog]:
    """Copy what is printed inside to a file.

    Raises:
        OutputError: it cannot be written.
    """
    log = RunLog(path, words)
    streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (_Copied(stream, log) for stream in streams)
    try:
        yield log
    finally:
        sys.stdout, sys.stderr = streams
        log.line("ended")
        log.close()
