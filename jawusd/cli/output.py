"""Output of commands: results on stdout as text or JSON, progress on stderr, and the log file."""

from __future__ import annotations

import contextlib
import math
import platform
import re
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import typer

from jawusd.base.errors import OutputError, shown

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import TaskID


def emit(data: Mapping[str, object], as_json: bool, lines: Iterable[str]) -> None:
    """Print a result as one JSON object, or as lines of text."""
    if as_json:
        import json

        typer.echo(json.dumps(plain(data), indent=1))
    else:
        for line in lines:
            say(line)


def say(line: object, err: bool = False) -> None:
    """Print one line, with control characters from files escaped; see `shown`."""
    typer.echo(shown(line), err=err)


def complain(text: object) -> None:
    """Print a message, possibly of several lines, on stderr, preceded by the program's name."""
    for line in f"jawusd: {text}".split("\n"):
        say(line, err=True)


def plain(value: object) -> object:
    """Return a value for JSON, with numpy types converted to Python's and NaN to None."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def shortened(items: Sequence[object], most: int, more: str = "more") -> str:
    """Return the first items as a list in words, and how many more there are."""
    rest = f" and {len(items) - most} {more}" if len(items) > most else ""
    return ", ".join(map(str, items[:most])) + rest


def refuse_any(force: bool, *paths: Path | None) -> None:
    """Check that none of the output files exists, unless forced; see `refuse_existing`."""
    from jawusd.formats.atomic import refuse_existing

    for path in paths:
        if path is not None:
            refuse_existing(path, force)


@contextlib.contextmanager
def progress() -> Iterator[Callable[[str, int, int], None]]:
    """Show the progress of long work on stderr; yield the callback for it, which takes (stage, done, total)."""
    from rich import progress as rich_progress
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _plain_progress(console)
        return
    with rich_progress.Progress(
        rich_progress.TextColumn("{task.description:<10}"),
        rich_progress.BarColumn(),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TimeElapsedColumn(),
        rich_progress.TimeRemainingColumn(),
        console=console,
    ) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total or None)
            bars.update(tasks[stage], completed=done, total=total or None)

        yield report


def _plain_progress(console: Console) -> Callable[[str, int, int], None]:
    """Return a progress callback for log files, which writes a line per stage and per tenth of a stage."""
    last: dict[str, int] = {}

    def report(stage: str, done: int, total: int) -> None:
        tenth = 10 * done // total if total else -1
        if last.get(stage) != tenth:
            last[stage] = tenth
            console.print(f"{stage} {done}/{total}" if total else stage, highlight=False)

    return report


_CODES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class RunLog:
    """A log file; each line begins with the number of seconds since the file was opened."""

    def __init__(self, path: Path, words: list[str]) -> None:
        """Open the file and write the command line and versions; raises OutputError if it cannot be written."""
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
        """Write lines."""
        for part in _CODES.sub("", text).split("\n"):
            if part.strip():
                self._file.write(f"{time.monotonic() - self._start:9.2f}  {shown(part.rstrip())}\n")
        self._file.flush()

    def error(self, error: BaseException) -> None:
        """Write an error with its traceback."""
        self.line("".join(traceback.format_exception(error)))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class _Copied:
    """An output stream that also writes its lines to a log."""

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


@contextlib.contextmanager
def logged(path: Path, words: list[str]) -> Iterator[RunLog]:
    """Copy everything written to stdout and stderr in the context to a log file; raises like `RunLog`."""
    log = RunLog(path, words)
    streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (_Copied(stream, log) for stream in streams)
    try:
        yield log
    finally:
        sys.stdout, sys.stderr = streams
        log.line("ended")
        log.close()
