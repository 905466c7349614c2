"""Commands on a capture and its footage: check, calibrate, sync, segment, scans and plates."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jawusd.cli.options import CaptureArg, Force, Json, Outside
from jawusd.cli.output import emit, plain, progress
from jawusd.formats.atomic import refuse_existing

if TYPE_CHECKING:
    from jawusd.pipeline.calibrate import SyncResult


def check(capture: CaptureArg, allow_outside: Outside = False, as_json: Json = False) -> None:
    """Check a capture in seconds, before any work: scans, masks, clips, calibration, picks, frames, disk space.

    Prints everything wrong or doubtful at once. Exit code 0 without errors, 5 with.
    """
    from jawusd.base.errors import CaptureError
    from jawusd.pipeline.check import check_capture, check_lines, check_summary

    with progress() as report:
        findings = check_capture(capture, allow_outside=allow_outside, progress=report)
    summary = check_summary(str(capture), findings)
    emit(summary, as_json, lambda: check_lines(findings))
    if summary["errors"]:
        raise typer.Exit(CaptureError.exit_code)


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
    from jawusd.pipeline.calibrate import calibrate_boards, calibration_lines
    from jawusd.pipeline.capture_inputs import open_capture

    for path in (out, report_file):
        if path is not None:
            refuse_existing(path, force)
    opened = open_capture(capture, allow_outside=allow_outside)
    with progress() as report:
        summary = calibrate_boards(opened, out, report)
    found = {**summary, "file": str(out)}
    if report_file is not None:
        write_text_atomic(report_file, json.dumps(plain(found), indent=1) + "\n")
    emit(found, as_json, lambda: [*calibration_lines(summary), str(out)])


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
    from jawusd.base.errors import SyncError
    from jawusd.pipeline.calibrate import (
        PLOT_SUFFIXES,
        light_curves,
        sync_cameras,
        sync_videos,
        write_light_curves,
        write_sync_plot,
    )
    from jawusd.pipeline.capture_inputs import open_capture

    if plot is not None and plot.suffix.lower() not in PLOT_SUFFIXES:
        raise typer.BadParameter(f"--plot {plot} must end in {' or '.join(PLOT_SUFFIXES)}.")
    for path in (curves, plot):
        if path is not None:
            refuse_existing(path, force)
    single = len(clips) == 1
    if single and reference is not None:
        raise typer.BadParameter("--reference is for clips; a capture names its own in [sync].")
    capture = open_capture(clips[0], allow_outside=allow_outside) if single else None
    videos = {c.name: c.clip for c in capture.cameras if c.clip} if capture else _named(clips)
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
    if result is None:
        raise failure or SyncError("the cameras could not be aligned")
    emit(result, as_json, partial(_sync_lines, result))


def _named(clips: list[Path]) -> dict[str, Path]:
    """Return the clips by their names, with folders where names alone are not enough."""
    short = {clip.stem: clip for clip in clips}
    named = short if len(short) == len(clips) else {str(clip): clip for clip in clips}
    if len(named) < len(clips):
        raise typer.BadParameter("a clip is given twice.")
    return named


def _sync_lines(result: SyncResult) -> list[str]:
    exact, sure = result.get("exact_frames", {}), result.get("confidence", {})
    lines = [f"by {result['method']}:"]
    for name, offset in result["offsets"].items():
        more = f" (exactly {exact[name]:+.2f}, confidence {sure[name]:.2f})" if name in exact else ""
        lines.append(f"  {name}: {offset:+d} frames{more}")
    return lines + [f"  note: {note}" for note in result.get("notes", [])]


def segment(
    capture: CaptureArg,
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
    allow_outside: Outside = False,
    as_json: Json = False,
) -> None:
    """Make masks of both rows of teeth from the videos, starting from the picks, or from a search without them."""
    from jawusd.pipeline.calibrate import sync_cameras
    from jawusd.pipeline.capture_inputs import open_capture
    from jawusd.pipeline.segment import SegmentOptions, segment_teeth
    from jawusd.pipeline.segment_record import RECORD, segment_lines, write_summary

    if not resume:
        _refuse_masks(out, out / RECORD, force)
    opened = open_capture(capture, allow_outside=allow_outside)
    with progress() as report:
        offsets = sync_cameras(opened, report)["offsets"]
        entries = segment_teeth(opened, offsets, out, SegmentOptions(keys, resume, jobs), report)
        summary = write_summary(opened, entries, out)
    emit(summary, as_json, lambda: segment_lines(summary))


def _refuse_masks(folder: Path, record: Path, force: bool) -> None:
    """Refuse a folder that holds anything, unless forced; the masks in it may be drawn by hand.

    Raises:
        OutputError: it does.
    """
    from jawusd.base.errors import OutputError

    if force or not folder.exists() or not any(folder.iterdir()):
        return
    hint = "Name another folder, or overwrite with --force."
    if record.exists():
        hint = "Continue with --resume, overwrite with --force, or name another folder."
    raise OutputError("exists and is not empty.", path=folder, hint=hint)


def scans(
    capture: CaptureArg,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            help="Folder of labels and picture, by default beside the scans and in the capture's folder. Name it in "
            "the capture as [scans] labels.",
            show_default=False,
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Find labels again and overwrite those there are, corrected ones too.")
    ] = False,
    allow_outside: Outside = False,
    as_json: Json = False,
) -> None:
    """Tell crown and gum of both teeth scans apart, store the labels, and draw a picture to look at."""
    from jawusd.pipeline.scans import label_scans, scans_lines

    with progress() as report:
        summary = label_scans(capture, out, force=force, allow_outside=allow_outside, progress=report)
    emit(summary, as_json, lambda: scans_lines(summary))


def plates(
    capture: CaptureArg,
    rig: Annotated[Path, typer.Argument(help="Folder of the rig built from it.", show_default=False)],
    force: Force = False,
    allow_outside: Outside = False,
    as_json: Json = False,
) -> None:
    """Write the footage without lens distortion where the rig's cameras.usda says, numbered by its time codes."""
    from jawusd.base.errors import OutputError
    from jawusd.formats.tracks import load_tracks
    from jawusd.pipeline.calibrate import sync_cameras
    from jawusd.pipeline.capture_inputs import open_capture
    from jawusd.pipeline.media import write_plates

    if (rig / "plates").exists() and not force:
        raise OutputError("exists already.", path=rig / "plates", hint="Overwrite its pictures with --force.")
    frames = load_tracks(rig / "tracks.npz").frames
    opened = open_capture(capture, allow_outside=allow_outside)
    with progress() as report:
        offsets = sync_cameras(opened, report)["offsets"]
        patterns = write_plates(opened, offsets, frames, rig, report)
    found = {"folder": str(rig), "frames": [int(frames[0]), int(frames[-1])], "plates": patterns}
    emit(found, as_json, lambda: [str(rig / pattern) for pattern in patterns])
