"""The program `jawusd`: its commands, and one place that turns errors into messages and exit codes."""

from __future__ import annotations

import contextlib
import os
import sys

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
from jawusd.errors import JawusdError, OutputError, explain_missing_packages

app = typer.Typer(
    name="jawusd",
    help="Capture in, jaw rig out: person-specific jaw kinematics from video as an OpenUSD rig.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for _command in (
    start_commands.init,
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
    app.command()(_command)

#: Exit code of a run stopped with Ctrl+C, as shells report it.
INTERRUPTED = 130


@app.callback(invoke_without_command=True)
def _root(version: bool = typer.Option(False, "--version", help="Print the version and stop.")) -> None:
    if version:
        from jawusd import __version__

        typer.echo(f"jawusd {__version__}")
        raise typer.Exit


def main() -> None:
    """Run the command line and leave with its exit code: 0 ok, 1 a "no", 2 usage, 3 and up one per error family."""
    try:
        with explain_missing_packages():
            app()
    except JawusdError as error:
        typer.echo(f"jawusd: {error}", err=True)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        typer.echo("jawusd: stopped; finished stages are kept, continue with --resume.", err=True)
        sys.exit(INTERRUPTED)
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
