"""The command that makes masks from footage."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jawusd.cli.output import emit, progress


def register(app: typer.Typer) -> None:
    """Add the command of this module."""
    app.command("segment")(segment)


def segment(
    capture: Annotated[Path, typer.Argument(help="capture.toml, or the folder that holds it.", show_default=False)],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the masks.")] = Path("masks"),
    keys: Annotated[
        Path | None,
        typer.Option(
            help="Folder with what you drew for some frames: CAMERA/upper/000123.png, CAMERA/lower/000123.png. "
            "Finished masks, 255 on teeth and 0 elsewhere, also teach how you draw; "
            "or strokes: 255 on teeth, 0 on anything else, 128 where you say nothing.",
            show_default=False,
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Keep the frames finished before.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing masks.")] = False,
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Threads that segment and align.")] = 2,
    allow_outside: Annotated[
        bool, typer.Option("--allow-outside", help="Let paths in the capture leave its folder.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Make masks of both rows of teeth from the videos, starting from the picks."""
    from jawusd.pipeline.journal import FILE
    from jawusd.pipeline.prepare import open_capture
    from jawusd.pipeline.segment import SegmentOptions, segment_teeth
    from jawusd.pipeline.segment_summary import segment_lines, write_summary
    from jawusd.pipeline.stages import sync_cameras

    if not resume:
        _refuse_masks(out, out / FILE, force)
    opened = open_capture(capture, allow_outside=allow_outside)
    with progress() as report:
        offsets = sync_cameras(opened, report)["offsets"]
        entries = segment_teeth(opened, offsets, out, SegmentOptions(keys, resume, jobs), report)
        summary = write_summary(opened, entries, out)
    emit(summary, as_json, lambda: segment_lines(summary))


def _refuse_masks(folder: Path, journal: Path, force: bool) -> None:
    """Refuse a folder that holds anything, unless forced; the masks in it may be drawn by hand.

    Raises:
        OutputError: it does.
    """
    from jawusd.errors import OutputError

    if force or not folder.exists() or not any(folder.iterdir()):
        return
    hint = "Name another folder, or overwrite with --force."
    if journal.exists():
        hint = "Continue with --resume, overwrite with --force, or name another folder."
    raise OutputError("exists and is not empty.", path=folder, hint=hint)
