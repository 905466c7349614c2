"""The command that shows a rig or a capture in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jawusd.cli.build_commands import Outside
from jawusd.cli.output import progress


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("view")(view)


def view(
    rig: Annotated[
        Path,
        typer.Argument(
            help="A rig (actor.usda, another layer of it, or its folder) or a capture (capture.toml or its folder).",
            metavar="RIG|CAPTURE",
            show_default=False,
        ),
    ],
    tracks: Annotated[
        Path | None,
        typer.Option(
            help="Poses to draw over a capture's footage: the folder of its build, or tracks.npz.", show_default=False
        ),
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on; the default is reached from this machine.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; the next free one if it is taken.")] = 8080,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open a browser.")] = True,
    allow_outside: Outside = False,
) -> None:
    """See a rig in the browser, drag it, key it; or a capture's footage, to judge its poses and to set its picks."""
    import webbrowser

    from jawusd.pipeline.view import open_viewer
    from jawusd.pipeline.view_capture import is_capture, open_capture_viewer
    from jawusd.viewer.server import is_loopback

    capture = is_capture(rig)
    if tracks is not None and not capture:
        raise typer.BadParameter("--tracks belongs to a capture; a rig has its own poses.")
    if not is_loopback(host):
        may = "write picks into the capture" if capture else "write animations beside the rig"
        typer.echo(
            f"jawusd: warning: listening on {host}: whoever reaches this address sees this person's jaw, without a "
            f"password, and may {may}. `ssh -L 8080:localhost:8080` works without --host.",
            err=True,
        )
    if capture:
        with progress() as report:
            viewer = open_capture_viewer(rig, tracks, host, port, report, allow_outside=allow_outside)
    else:
        viewer = open_viewer(rig, host, port)
    try:
        typer.echo(f"{viewer.url}  (Ctrl+C stops)")
        if browser:
            webbrowser.open(viewer.url)
        viewer.wait()
    except KeyboardInterrupt:
        viewer.stop()
