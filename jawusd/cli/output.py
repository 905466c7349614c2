"""What commands print: results on stdout, progress on stderr, JSON where a machine reads."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from jawusd.base.errors import shown

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import TaskID


def emit(data: Mapping[str, object], as_json: bool, lines: Callable[[], list[str]]) -> None:
    """Print a result as one JSON object, or as lines for people."""
    if as_json:
        import json

        typer.echo(json.dumps(plain(data), indent=1))
    else:
        for line in lines():
            say(line)


def say(line: object, err: bool = False) -> None:
    """Print one line; what files say in it cannot control the terminal, see `shown`."""
    typer.echo(shown(line), err=err)


def complain(text: object) -> None:
    """Print a message on stderr, which may hold the lines of several findings, after the program's name."""
    for line in f"jawusd: {text}".split("\n"):
        say(line, err=True)


def plain(value: object) -> object:
    """Return a value with numpy types turned into JSON's and NaN into null."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


@contextlib.contextmanager
def progress() -> Iterator[Callable[[str, int, int], None]]:
    """Show the progress of long work on stderr; yields a function (stage, done, total) to call as work proceeds."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description:<10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _plain_progress(console)
        return
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total or None)
            bars.update(tasks[stage], completed=done, total=total or None)

        yield report


def _plain_progress(console: Console) -> Callable[[str, int, int], None]:
    """Return a reporter for log files: a line per stage and per tenth of it."""
    last: dict[str, int] = {}

    def report(stage: str, done: int, total: int) -> None:
        tenth = 10 * done // total if total else -1
        if last.get(stage) != tenth:
            last[stage] = tenth
            console.print(f"{stage} {done}/{total}" if total else stage, highlight=False)

    return report
