"""Commands of a first hour: init, which begins a capture from a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jawusd.cli.options import Force, Json
from jawusd.cli.output import emit, progress, refuse_existing


def init(
    folder: Annotated[
        Path | None, typer.Argument(help="Folder with footage, scans and board clips.", show_default=False)
    ] = None,
    square_mm: Annotated[
        float | None,
        typer.Option(min=0.1, max=200.0, help="Side of the board's squares [mm].", show_default=False),
    ] = None,
    fps: Annotated[
        float | None, typer.Option(min=0.001, max=10000.0, help="Pictures per second.", show_default=False)
    ] = None,
    reference: Annotated[bool, typer.Option("--reference", help="List every key of capture.toml and stop.")] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Begin a capture: look at a folder, write its capture.toml with comments, and say what is missing.

    Exit code 1 if something must be filled in.
    """
    if reference:
        _print_reference(as_json)
        return
    if folder is None:
        raise typer.BadParameter("name a folder, or give --reference.", param_hint="FOLDER")
    from jawusd.pipeline.start_capture import start_capture, start_lines, write_start

    refuse_existing(folder / "capture.toml", force)
    with progress() as report:
        start = start_capture(folder, square_mm, fps, report)
    write_start(start)
    found = {"file": str(start.path), "found": start.found, "notes": start.notes, "missing": start.missing}
    emit(found, as_json, lambda: start_lines(start))
    if start.missing:
        raise typer.Exit(1)


def _print_reference(as_json: bool) -> None:
    from dataclasses import asdict

    from jawusd.formats.capture import capture_keys
    from jawusd.formats.capture_keys import reference_lines

    keys = capture_keys()
    emit({"keys": [asdict(entry) for entry in keys]}, as_json, lambda: reference_lines(keys, 80))


def doctor(as_json: Json = False) -> None:
    """Say what is installed and what works here: versions, extras, OpenGL, codecs, cores, the cache of compiled code.

    Exit code 1 if something that a build needs does not work.
    """
    from jawusd.pipeline.doctor import examine, examined_lines

    found = examine()
    emit(found, as_json, lambda: examined_lines(found))
    if found["problems"]:
        raise typer.Exit(1)
