"""Commands to get started: draft a capture, check the installation, convert calibrated cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jawusd.cli.options import Force, Json
from jawusd.cli.output import emit, progress
from jawusd.formats.atomic import refuse_existing


def init(
    folder: Annotated[
        Path | None, typer.Argument(help="Folder with footage, scans and board clips.", show_default=False)
    ] = None,
    square_mm: Annotated[
        float | None,
        typer.Option(min=0.1, max=200.0, help="Side of the board's squares [mm].", show_default=False),
    ] = None,
    fps: Annotated[
        float | None, typer.Option(min=0.001, max=10000.0, help="Frames per second.", show_default=False)
    ] = None,
    reference: Annotated[bool, typer.Option("--reference", help="List every key of capture.toml and exit.")] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Draft a commented capture.toml from a folder of footage and scans, and list what is missing.

    Exit code 1 if something must be filled in.
    """
    if reference:
        _print_reference(as_json)
        return
    if folder is None:
        raise typer.BadParameter("give a folder or --reference.", param_hint="FOLDER")
    from jawusd.cli.text_capture import start_lines
    from jawusd.pipeline.start_capture import start_capture, write_start

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
    """Check the installation: versions, extras, OpenGL, codecs, CPU cores, and the cache of compiled code.

    Exit code 1 if something that a build needs is missing.
    """
    from jawusd.cli.text_capture import examined_lines
    from jawusd.pipeline.doctor import examine

    found = examine()
    emit(found, as_json, lambda: examined_lines(found))
    if found["problems"]:
        raise typer.Exit(1)


def cameras(
    source: Annotated[
        Path,
        typer.Argument(
            help="TOML (aniposelib, Pose2Sim, Caliscope), Metashape XML, RealityScan CSV or XMP, COLMAP, "
            "transforms.json, OpenCV YAML, XML or JSON, Nuke script of 3DEqualizer, or a USD stage.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help=".toml, .usda, or a folder for COLMAP.", show_default=False)],
    unit_mm: Annotated[float, typer.Option(min=1e-6, help="Length of the source's unit [mm]: 1000 for metres.")] = 1.0,
    size: Annotated[
        str | None,
        typer.Option(help="Image size, such as 1920x1080, if the source does not state it.", show_default=False),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Convert calibrated cameras between the file formats of other programs, in mm."""
    from jawusd.cli.text_capture import camera_lines
    from jawusd.pipeline.cameras import convert_cameras

    given = None
    if size is not None:
        words = size.lower().split("x")
        if len(words) != 2 or not all(word.isdecimal() and int(word) > 0 for word in words):
            raise typer.BadParameter(f'"{size}" is not of the form 1920x1080.', param_hint="--size")
        given = int(words[0]), int(words[1])
    refuse_existing(out, force)
    found, files = convert_cameras(source, out, unit_mm, given)
    data = {"cameras": [camera.name for camera in found], "files": [str(path) for path in files]}
    emit(data, as_json, lambda: camera_lines(found, files))
