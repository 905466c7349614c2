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
    app.command("sync")(sync)


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


def sync(
    clips: Annotated[
        list[Path], typer.Argument(help="A capture (capture.toml or its folder), or two and more videos.")
    ],
    reference: Annotated[
        str | None, typer.Option(help="Clip that counts the frames, by its name; the first.", show_default=False)
    ] = None,
    curves: Annotated[
        Path | None,
        typer.Option(help="Also write the brightness of every picture of every clip as CSV.", show_default=False),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(help="Also draw the brightness before and after alignment, as PNG or SVG.", show_default=False),
    ] = None,
    force: Force = False,
    allow_outside: Outside = False,
    as_json: Json = False,
) -> None:
    """Find the frame offsets between cameras from light flashes, else from their sound."""
    from jawusd.errors import SyncError
    from jawusd.pipeline.prepare import open_capture
    from jawusd.pipeline.stages import sync_cameras, sync_videos
    from jawusd.pipeline.sync_files import PLOT_SUFFIXES, light_curves, write_light_curves, write_sync_plot

    if plot is not None and plot.suffix.lower() not in PLOT_SUFFIXES:
        raise typer.BadParameter(f"--plot {plot} must end in {' or '.join(PLOT_SUFFIXES)}.")
    for path in (curves, plot):
        if path is not None:
            refuse_existing(path, force)
    single = len(clips) == 1
    if single and reference is not None:
        raise typer.BadParameter("--reference is for clips; a capture names its own in [sync].")
    capture = open_capture(clips[0], allow_outside=allow_outside) if single else None
    videos = {c.name: c.video for c in capture.cameras if c.video} if capture else _named(clips)
    if reference is not None and reference not in videos:
        raise typer.BadParameter(f"--reference {reference} is none of {', '.join(videos)}.")
    result, failure = None, None
    with progress() as report:
        try:
            if capture is not None:
                result = sync_cameras(capture, report)
            else:
                result = sync_videos(videos, reference or next(iter(videos)), report)
        except SyncError as error:
            failure = error  # the curves show best why
        found = light_curves(videos, report) if curves is not None or plot is not None else {}
        if curves is not None:
            write_light_curves(curves, found)
        if plot is not None:
            write_sync_plot(plot, found, result)
    if failure is not None:
        raise failure
    emit(result, as_json, lambda: _sync_lines(result))


def _named(clips: list[Path]) -> dict[str, Path]:
    """Return the clips by their names, with folders where names alone are not enough."""
    short = {clip.stem: clip for clip in clips}
    named = short if len(short) == len(clips) else {str(clip): clip for clip in clips}
    if len(named) < len(clips):
        raise typer.BadParameter("a clip is given twice.")
    return named


def _sync_lines(result: dict) -> list[str]:
    exact, sure = result.get("exact_frames", {}), result.get("confidence", {})
    lines = [f"by {result['method']}:"]
    for name, offset in result["offsets"].items():
        more = f" (exactly {exact[name]:+.2f}, confidence {sure[name]:.2f})" if name in exact else ""
        lines.append(f"  {name}: {offset:+d} frames{more}")
    return lines + [f"  note: {note}" for note in result.get("notes", [])]
