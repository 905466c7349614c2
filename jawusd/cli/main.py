"""The program `jawusd`: its commands, and one place that turns errors into messages and exit codes."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from pathlib import Path
from typing import Annotated

import typer

from jawusd.cli import (
    animate_command,
    build_commands,
    capture_commands,
    face_commands,
    library_commands,
    live_commands,
    photo_commands,
    report_commands,
    rig_commands,
    solve_commands,
    stage_commands,
    start_commands,
)
from jawusd.cli.command import CONTEXT, Command
from jawusd.cli.log import logged
from jawusd.cli.summaries import EXIT_CODES, SUMMARIES
from jawusd.errors import JawusdError, OutputError, explain_missing_packages

app = typer.Typer(
    name="jawusd",
    help="Capture in, jaw rig out: person-specific jaw kinematics from video as an OpenUSD rig.",
    epilog=EXIT_CODES,
    context_settings=CONTEXT,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for _command in (
    start_commands.init,
    start_commands.doctor,
    start_commands.cameras,
    build_commands.build,
    build_commands.track,
    build_commands.fit,
    build_commands.bake,
    build_commands.demo,
    build_commands.build_many,
    capture_commands.check,
    capture_commands.calibrate,
    capture_commands.sync,
    capture_commands.segment,
    capture_commands.scans,
    photo_commands.photos,
    rig_commands.info,
    rig_commands.pose,
    stage_commands.encode,
    rig_commands.validate,
    rig_commands.ik,
    animate_command.animate,
    face_commands.arkit_fit,
    face_commands.arkit_table,
    stage_commands.rebake,
    stage_commands.publish,
    solve_commands.solve,
    live_commands.live,
    library_commands.retarget,
    library_commands.library,
    capture_commands.plates,
    report_commands.report,
    report_commands.view,
):
    _name = _command.__name__.replace("_", "-")
    app.command(_name, cls=Command, context_settings=CONTEXT, short_help=SUMMARIES[_name])(_command)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="With an error, also print where in the program it arose.")
    ] = False,
    log: Annotated[
        Path | None,
        typer.Option("--log", metavar="FILE", help="Also write what is printed, with times and versions, to a file."),
    ] = None,
) -> None:
    if version:
        from jawusd import __version__

        typer.echo(f"jawusd {__version__}")
        raise typer.Exit
    global _verbose  # errors are printed outside of every context
    _verbose = verbose
    if log is not None:
        context.obj = context.with_resource(logged(log, sys.argv[1:]))


_verbose = False


def main() -> None:
    """Run the command line and leave with its exit code: 0 ok, 1 a "no", 2 usage, 3 and up one per error family."""
    if "PXR_WORK_THREAD_LIMIT" not in os.environ:
        # Before OpenUSD is loaded: rigs are small, and where it has no threads it can be tried in a fork at any moment.
        os.environ |= {"PXR_WORK_THREAD_LIMIT": "1", "TF_ENV_SETTING_ALERTS_ENABLED": "0"}
    try:
        with explain_missing_packages():
            app()
    except JawusdError as error:
        if _verbose:
            traceback.print_exception(error)
        typer.echo(f"jawusd: {error}", err=True)
        sys.exit(error.exit_code)
    except BrokenPipeError:
        # The reader of the pipe (head, less) has closed it.
        sys.stderr.close()
        sys.exit(0)
    except (OSError, RuntimeError) as error:
        sys.exit(_unwritable(error))


def _unwritable(error: OSError | RuntimeError) -> int:
    """Print what no command reports by itself, a full disk behind `>` or a name no file can have; return the exit code.

    Raises:
        RuntimeError: the error is another one.
    """
    if isinstance(error, OSError):
        message = f"{str(error.filename or 'the output'):.200}: {error.strerror or error}."
    elif str(error).startswith("Symlink loop"):  # Path.resolve
        message = f"{error}."
    else:
        raise error
    typer.echo(f"jawusd: {message}", err=True)
    with contextlib.suppress(OSError):  # what could not be printed would be tried again at the end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return OutputError.exit_code
