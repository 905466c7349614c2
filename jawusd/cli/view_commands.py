"""The command that shows a rig in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("view")(view)


def view(
    rig: Annotated[Path, typer.Argument(help="actor.usda, another layer of it, or its folder.", show_default=False)],
    host: Annotated[str, typer.Option(help="Address to listen on; the default is reached from this machine.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; the next free one if it is taken.")] = 8080,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open a browser.")] = True,
) -> None:
    """See a rig in the browser, drag it, key it."""
    import webbrowser

    from jawusd.pipeline.extras import stage
    from jawusd.pipeline.view import open_viewer

    if not stage("jawusd.viewer.server").is_loopback(host):
        typer.echo(
            f"jawusd: warning: listening on {host}: whoever reaches this address sees this person's jaw, without a "
            "password, and may write animations beside the rig. `ssh -L 8080:localhost:8080` works without --host.",
            err=True,
        )
    viewer = open_viewer(rig, host, port)
    try:
        typer.echo(f"{viewer.url}  (Ctrl+C stops)")
        if browser:
            webbrowser.open(viewer.url)
        viewer.wait()
    except KeyboardInterrupt:
        viewer.stop()
