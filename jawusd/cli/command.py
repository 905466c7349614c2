"""What all commands share on the command line: -h, vectors with commas, and what Ctrl+C leaves behind."""

from __future__ import annotations

import contextlib
import re
import shlex
import signal
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

import typer
from typer.core import TyperCommand

from jawusd.base.errors import JawusdError
from jawusd.cli.log import RunLog
from jawusd.cli.output import say

#: Exit code of a run stopped with Ctrl+C, as shells report it.
INTERRUPTED = 130
CONTEXT = {"help_option_names": ["-h", "--help"]}

_WORDS = "jawusd.words"  # key of the words of a command in its context
_VECTOR = re.compile(r" *[-+]?[\d.eE+-]+((, *| +)[-+]?[\d.eE+-]+){2} *")
_VECTORS = ("--d", "--point", "--target", "--start")

# What is kept of each command's work, and how to go on; all other commands write whole files at their end only.
_KEPT = {
    "build": "finished stages are kept; go on with the same command and --resume, start over with --fresh",
    "build-many": "captures and stages that were finished are kept; go on with the same command and --resume",
    "segment": "finished frames are kept; go on with the same command and --resume",
    "plates": "the pictures written so far are kept; start over with --force",
    "demo": "the files written so far are kept, and no capture without its capture.toml; start over with --force",
    "bake": "the files written so far are kept, and are no rig before all are there; start over with --force",
}
_ELSE = "nothing was written that is not whole"


class Command(TyperCommand):
    """A command of jawusd."""

    # typer hands its public Context to both methods; the base class in its private copy of click declares that one's.

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]  # click has its own Context
        """Take vectors as `--d 20,2,1` too, and keep the words for `command_line`."""
        ctx.meta[_WORDS] = list(args)
        return super().parse_args(ctx, with_vectors_split(args))

    def invoke(self, ctx: typer.Context) -> object:  # type: ignore[override]  # as above
        """Run, and say on Ctrl+C what is kept."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as stop:
            interrupted(self.name or "", stop.exit_code if isinstance(stop, _StoppedError) else INTERRUPTED)
        except (JawusdError, OSError, RuntimeError) as error:
            if isinstance(ctx.obj, RunLog) and not isinstance(error, typer.Exit):
                ctx.obj.error(error)
            raise


def command_line(ctx: typer.Context) -> str:
    """Return the command line of the command that runs, quoted as a shell needs it."""
    return shlex.join(["jawusd", str(ctx.info_name), *ctx.meta[_WORDS]])


def with_vectors_split(args: list[str]) -> list[str]:
    """Return arguments with a,b,c or "a b c" after the options of vectors as three words."""
    out: list[str] = []
    for word in args:
        option, sign, value = word.partition("=")
        if sign and option in _VECTORS and _VECTOR.fullmatch(value):
            out += [option, *value.replace(",", " ").split()]
        elif out and out[-1] in _VECTORS and _VECTOR.fullmatch(word):
            out += word.replace(",", " ").split()
        else:
            out.append(word)
    return out


class _StoppedError(KeyboardInterrupt):
    """A signal other than Ctrl+C, which ends a command in the same way."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.exit_code = 128 + number  # as shells report it


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the work inside as Ctrl+C does, so that it leaves nothing behind."""

    def stop(number: int, _: FrameType | None) -> NoReturn:
        for other in taken:  # whatever comes next, the work is being ended
            signal.signal(other, signal.SIG_IGN)
        raise _StoppedError(number)

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    taken = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]  # nohup ignores one
    for number in taken:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


def interrupted(command: str, exit_code: int = INTERRUPTED) -> NoReturn:
    """Say that a command was stopped and what is kept of it, and end with the exit code of that."""
    say(f"jawusd {command}: stopped; {_KEPT.get(command, _ELSE)}.", err=True)
    raise typer.Exit(exit_code)
