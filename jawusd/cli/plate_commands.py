"""The command that writes undistorted footage beside a rig's take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jawusd.cli.output import emit, progress, refuse_existing


def register(app: typer.Typer) -> None:
    """Add the command of this module."""
    app.command("plates")(plates)


def plates(
    capture: Annotated[Path, typer.Argument(help="capture.toml, or the folder that holds it.", show_default=False)],
    rig: Annotated[Path, typer.Argument(help="Folder of the rig built from it.", show_default=False)],
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing output.")] = False,
    allow_outside: Annotated[
        bool, typer.Option("--allow-outside", help="Let paths in the capture leave its folder.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Write the footage without lens distortion where the rig's cameras.usda says, numbered by its time codes."""
    from jawusd.formats.tracks import load_tracks
    from jawusd.pipeline.plates import write_plates
    from jawusd.pipeline.prepare import open_capture
    from jawusd.pipeline.stages import sync_cameras

    refuse_existing(rig / "plates", force)
    frames = load_tracks(rig / "tracks.npz").frames
    opened = open_capture(capture, allow_outside=allow_outside)
    with progress() as report:
        offsets = sync_cameras(opened, report)["offsets"]
        patterns = write_plates(opened, offsets, frames, rig, report)
    found = {"folder": str(rig), "frames": [int(frames[0]), int(frames[-1])], "plates": patterns}
    emit(found, as_json, lambda: [str(rig / pattern) for pattern in patterns])
