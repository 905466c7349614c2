"""The program `jawusd`: runs its commands, and converts errors to messages and exit codes."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import traceback
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from jawusd.base.errors import JawusdError, OutputError, explain_missing_packages
from jawusd.base.guard import out_of_memory
from jawusd.cli.commands import CONTEXT, EXIT_CODES, Commands
from jawusd.cli.output import complain, logged, say

app = typer.Typer(
    name="jawusd",
    cls=Commands,
    help="Capture in, jaw rig out: person-specific jaw kinematics from video as an OpenUSD rig.",
    epilog=EXIT_CODES,
    context_settings=CONTEXT,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, Option("--version", help="Print the version and exit.")] = False,
    verbose: Annotated[bool, Option("--verbose", "-v", help="Also print the traceback of an error.")] = False,
    log: Annotated[
        Path | None, Option("--log", metavar="FILE", help="Also write the output, with times and versions, to a file.")
    ] = None,
) -> None:
    if version:
        from jawusd.base.version import __version__

        say(f"jawusd {__version__}")
        raise typer.Exit
    global _verbose  # used by `main` to print errors after the context of the command has ended
    _verbose = verbose
    if verbose:
        import faulthandler

        faulthandler.enable()
    if log is not None:
        context.obj = context.with_resource(logged(log, sys.argv[1:]))


_verbose = False


def main() -> None:
    """Run the command line and exit: 0 success, 1 negative result, 2 wrong usage, 3 and above by error family."""
    # OpenUSD reads this variable when loaded; rigs are too small to gain from threads.
    if "PXR_WORK_THREAD_LIMIT" not in os.environ:
        os.environ |= {"PXR_WORK_THREAD_LIMIT": "1", "TF_ENV_SETTING_ALERTS_ENABLED": "0"}
    # Numpy reads the number of threads when it is loaded. Multi-threaded sums differ in their last bits between
    # machines, which changes fits by micrometres. The matrices are too small to gain from threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for stream in (sys.stdout, sys.stderr):  # escape characters that the terminal cannot encode
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        with explain_missing_packages():
            app()
    except JawusdError as error:
        sys.exit(_report(error))
    except MemoryError as error:
        sys.exit(_report(out_of_memory(), error))
    except BrokenPipeError:
        # The program that reads the pipe, such as head or less, has closed it.
        sys.stderr.close()
        sys.exit(0)
    except (OSError, RuntimeError) as error:
        sys.exit(_unwritable(error))


def _report(error: JawusdError, cause: BaseException | None = None) -> int:
    """Print an error; return its exit code."""
    if _verbose:
        traceback.print_exception(cause or error)
    complain(error)
    return error.exit_code


def _unwritable(error: OSError | RuntimeError) -> int:
    """Print an error raised outside any command, such as a full disk or an invalid file name; return the exit code."""
    if isinstance(error, OSError):
        message = f"{str(error.filename or 'the output'):.200}: {error.strerror or error}."
    elif str(error).startswith("Symlink loop"):  # Path.resolve raises RuntimeError for circular links
        message = f"{error}."
    else:
        raise error
    complain(message)
    with contextlib.suppress(OSError):  # otherwise Python would try to flush stdout again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return OutputError.exit_code
