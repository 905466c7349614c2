"""Commands that bring the cameras of a capture together: calibrate and sync."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from jawusd.cli.build_commands import CaptureArg, Force, Json, Outside
from jawusd.cli.output import emit, plain, progress, refuse_existing


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("calibrate")(calibrate)


def calibrate(
    capture: CaptureArg,
    out: Annotated[Path, typer.Option("-o", "--out", help="File of the calibration.")] = Path("calibration.toml"),
    report_file: Annotated[
        Path | None, typer.Option("--report", help="Also write the report as JSON.", show_default=False)
    ] = None,
    force: Force = False,
    allow_outside: Outside = False,
    as_json: Json = False,
) -> None:
    """Calibrate the cameras from clips of a chessboard or ChArUco board, and say how far the result can be trusted."""
    from jawusd.formats.atomic import write_text_atomic
    from jawusd.pipeline.calibration import calibrate_boards, calibration_lines
    from jawusd.pipeline.prepare import open_capture

    for path in (out, report_file):
        if path is not None:
            refuse_existing(path, force)
    opened = open_capture(capture, allow_outside=allow_outside)
    with progress() as report:
        summary = {**calibrate_boards(opened, out, report), "file": str(out)}
    if report_file is not None:
        write_text_atomic(report_file, json.dumps(plain(summary), indent=1) + "\n")
    emit(summary, as_json, lambda: [*calibration_lines(summary), str(out)])
