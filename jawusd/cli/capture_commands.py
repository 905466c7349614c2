"""Commands on a capture and its footage, from a first draft to masks; the check of the installation."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from typer import Argument, BadParameter, Exit, Option

from jawusd.base.errors import CaptureError, OutputError, SyncError, TrackingError
from jawusd.cli import options
from jawusd.cli.output import emit, plain, progress, refuse_any
from jawusd.formats.atomic import refuse_existing, write_text_atomic


def init(
    folder: Annotated[Path | None, Argument(help="Folder with footage, scans and board clips.")] = None,
    square_mm: Annotated[float | None, Option(min=0.1, max=200.0, help="Side of the board's squares [mm].")] = None,
    fps: Annotated[float | None, Option(min=0.001, max=10000.0, help="Frames per second.")] = None,
    reference: Annotated[bool, Option("--reference", help="List every key of capture.toml and exit.")] = False,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Draft a commented capture.toml from a folder of footage and scans, and list what is missing.

    Exit code 1 if something must be filled in.
    """
    if reference:
        from jawusd.formats.capture import capture_keys
        from jawusd.formats.capture_keys import reference_lines

        keys = capture_keys()
        emit({"keys": [asdict(entry) for entry in keys]}, as_json, reference_lines(keys, 80))
        return
    if folder is None:
        raise BadParameter("give a folder or --reference.", param_hint="FOLDER")
    from jawusd.cli.text_capture import start_lines
    from jawusd.pipeline.start_capture import start_capture, write_start

    refuse_existing(folder / "capture.toml", force)
    with progress() as report:
        start = start_capture(folder, square_mm, fps, report)
    write_start(start)
    found = {"file": str(start.path), "found": start.found, "notes": start.notes, "missing": start.missing}
    emit(found, as_json, start_lines(start))
    if start.missing:
        raise Exit(1)


def doctor(as_json: options.Json = False) -> None:
    """Check the installation: versions, extras, OpenGL, codecs, CPU cores, and the cache of compiled code.

    Exit code 1 if something that a build needs is missing.
    """
    from jawusd.cli.text_capture import examined_lines
    from jawusd.pipeline.check import examine

    found = examine()
    emit(found, as_json, examined_lines(found))
    if found["problems"]:
        raise Exit(1)


def cameras(
    source: Annotated[
        Path,
        Argument(
            help="TOML (aniposelib, Pose2Sim, Caliscope), Metashape XML, RealityScan CSV or XMP, COLMAP, "
            "transforms.json, OpenCV YAML, XML or JSON, Nuke script of 3DEqualizer, or a USD stage."
        ),
    ],
    out: Annotated[Path, Option("-o", "--out", help=".toml, .usda, or a folder for COLMAP.")],
    unit_mm: Annotated[float, Option(min=1e-6, help="Length of the source's unit [mm]: 1000 for metres.")] = 1.0,
    size: Annotated[str | None, Option(help="Image size, such as 1920x1080, if the source does not state it.")] = None,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Convert calibrated cameras between the file formats of other programs, in mm."""
    from jawusd.cli.text_capture import camera_lines
    from jawusd.pipeline.cameras import convert_cameras

    given = None
    if size is not None:
        words = size.lower().split("x")
        if len(words) != 2 or not all(word.isdecimal() and int(word) > 0 for word in words):
            raise BadParameter(f'"{size}" is not of the form 1920x1080.', param_hint="--size")
        given = int(words[0]), int(words[1])
    refuse_existing(out, force)
    found, files = convert_cameras(source, out, unit_mm, given)
    data = {"cameras": [camera.name for camera in found], "files": [str(path) for path in files]}
    emit(data, as_json, camera_lines(found, files))


def check(capture: options.CaptureArg, allow_outside: options.Outside = False, as_json: options.Json = False) -> None:
    """Check a capture in seconds: scans, masks, clips, calibration, picks, frames, disk space.

    Prints all errors and warnings at once. Exit code 0 without errors, 5 with errors.
    """
    from jawusd.cli.text_capture import check_lines
    from jawusd.pipeline.check import check_capture

    with progress() as report:
        findings = check_capture(capture, allow_outside=allow_outside, progress=report)
    errors, warnings = (sum(found.severity == kind for found in findings) for kind in ("error", "warning"))
    listed = {"capture": str(capture), "findings": [finding.as_json() for finding in findings]}
    emit({**listed, "errors": errors, "warnings": warnings}, as_json, check_lines(findings))
    if errors:
        raise Exit(CaptureError.exit_code)


def calibrate(
    capture: options.CaptureArg,
    out: Annotated[Path, Option("-o", "--out", help="File of the calibration.")] = Path("calibration.toml"),
    report_file: Annotated[Path | None, Option("--report", help="Also write the report as JSON.")] = None,
    force: options.Force = False,
    allow_outside: options.Outside = False,
    as_json: options.Json = False,
) -> None:
    """Calibrate the cameras from clips of a chessboard or ChArUco board, and report the expected accuracy."""
    from jawusd.cli.text_capture import calibration_lines
    from jawusd.pipeline.calibrate import calibrate_boards
    from jawusd.pipeline.workspace import open_capture

    refuse_any(force, out, report_file)
    opened = open_capture(capture, allow_outside=allow_outside)
    with progress() as report:
        summary = calibrate_boards(opened, out, report)
    found = {**summary, "file": str(out)}
    if report_file is not None:
        write_text_atomic(report_file, json.dumps(plain(found), indent=1) + "\n")
    emit(found, as_json, [*calibration_lines(summary), str(out)])


def sync(
    clips: Annotated[list[Path], Argument(help="A capture (capture.toml or its folder), or two or more videos.")],
    reference: Annotated[str | None, Option(help="Name of the reference clip. Default: the first.")] = None,
    curves: Annotated[Path | None, Option(help="Also write the brightness of every image as CSV.")] = None,
    plot: Annotated[
        Path | None, Option(help="Also draw the brightness before and after alignment, as PNG or SVG.")
    ] = None,
    force: options.Force = False,
    allow_outside: options.Outside = False,
    as_json: options.Json = False,
) -> None:
    """Estimate the frame offsets between cameras from light flashes or, without flashes, from sound."""
    from jawusd.cli.text_capture import sync_lines
    from jawusd.pipeline import calibrate as stage
    from jawusd.pipeline.workspace import open_capture

    if plot is not None and plot.suffix.lower() not in stage.PLOT_SUFFIXES:
        raise BadParameter(f"--plot {plot} must end in {' or '.join(stage.PLOT_SUFFIXES)}.")
    refuse_any(force, curves, plot)
    single = len(clips) == 1
    if single and reference is not None:
        raise BadParameter("--reference applies only to clips; a capture names its reference camera in [sync].")
    capture = open_capture(clips[0], allow_outside=allow_outside) if single else None
    videos = {c.name: c.clip for c in capture.cameras if c.clip} if capture else _named(clips)
    if reference is not None and reference not in videos:
        raise BadParameter(f"--reference {reference} is not one of {', '.join(videos)}.")
    result, failure = None, None
    with progress() as report:
        try:
            if capture is not None:
                result = stage.sync_cameras(capture, report)
            else:
                result = stage.sync_videos(videos, reference or next(iter(videos)), report)
        except SyncError as error:
            failure = error  # raised after the curves are written, because they show why alignment failed
        found = stage.light_curves(videos, report) if curves is not None or plot is not None else {}
        if curves is not None:
            stage.write_light_curves(curves, found)
        if plot is not None:
            stage.write_sync_plot(plot, found, result)
    if result is None:
        raise failure or SyncError("the cameras could not be aligned")
    emit(result, as_json, sync_lines(result))


def _named(clips: list[Path]) -> dict[str, Path]:
    """Return the clips by file name, or by path if the names are not unique."""
    short = {clip.stem: clip for clip in clips}
    named = short if len(short) == len(clips) else {str(clip): clip for clip in clips}
    if len(named) < len(clips):
        raise BadParameter("the same clip is given twice.")
    return named


def segment(
    capture: options.CaptureArg,
    out: Annotated[Path, Option("-o", "--out", help="Folder of the masks.")] = Path("masks"),
    keys: Annotated[
        Path | None,
        Option(
            help="Folder of hand-drawn frames: CAMERA/upper/000123.png, CAMERA/lower/000123.png. These are finished "
            "masks, 255 on teeth and 0 elsewhere, which also teach your style; or strokes, 255 on teeth, 0 on "
            "other things, and 128 where unknown."
        ),
    ] = None,
    resume: Annotated[bool, Option("--resume", help="Keep finished frames.")] = False,
    force: Annotated[bool, Option("--force", help="Overwrite existing masks.")] = False,
    jobs: options.Jobs = 2,
    allow_outside: options.Outside = False,
    as_json: options.Json = False,
) -> None:
    """Make masks of the teeth of both jaws from the videos, starting from picks or, without picks, from a search."""
    from jawusd.cli.text_capture import segment_lines
    from jawusd.pipeline.calibrate import sync_cameras
    from jawusd.pipeline.segment import SegmentOptions, segment_teeth
    from jawusd.pipeline.segment_record import RECORD, write_summary
    from jawusd.pipeline.workspace import open_capture

    if not resume:
        _refuse_masks(out, out / RECORD, force)
    opened = open_capture(capture, allow_outside=allow_outside)
    with progress() as report:
        offsets = sync_cameras(opened, report)["offsets"]
        entries = segment_teeth(opened, offsets, out, SegmentOptions(keys, resume, jobs), report)
        summary = write_summary(opened, entries, out)
    emit(summary, as_json, segment_lines(summary))


def _refuse_masks(folder: Path, record: Path, force: bool) -> None:
    """Check that a folder for masks is empty, unless forced: it may contain hand-drawn masks."""
    if force or not folder.exists() or not any(folder.iterdir()):
        return
    hint = "Choose another folder, or overwrite with --force."
    if record.exists():
        hint = "Continue with --resume, overwrite with --force, or choose another folder."
    raise OutputError("exists and is not empty.", path=folder, hint=hint)


def scans(
    capture: options.CaptureArg,
    out: Annotated[
        Path | None,
        Option(
            "-o",
            "--out",
            help="Folder of labels and image; enter it in [scans] labels of the capture. Default: beside the "
            "scans, and the capture's folder.",
        ),
    ] = None,
    force: Annotated[
        bool, Option("--force", help="Label again and overwrite existing labels, including reviewed ones.")
    ] = False,
    allow_outside: options.Outside = False,
    as_json: options.Json = False,
) -> None:
    """Label the crowns and gums in both dental scans, store the labels, and draw an image for review."""
    from jawusd.cli.text_capture import scans_lines
    from jawusd.pipeline.scans import label_scans

    with progress() as report:
        summary = label_scans(capture, out, force=force, allow_outside=allow_outside, progress=report)
    emit(summary, as_json, scans_lines(summary))


def plates(
    capture: options.CaptureArg,
    rig: Annotated[Path, Argument(help="Folder of the rig built from the capture.")],
    force: options.Force = False,
    allow_outside: options.Outside = False,
    as_json: options.Json = False,
) -> None:
    """Write undistorted footage at the paths in the rig's cameras.usda, numbered by its time codes."""
    from jawusd.formats.tracks import load_tracks
    from jawusd.pipeline.calibrate import sync_cameras
    from jawusd.pipeline.pictures import write_plates
    from jawusd.pipeline.workspace import open_capture

    if (rig / "plates").exists() and not force:
        raise OutputError("exists already.", path=rig / "plates", hint="Overwrite its images with --force.")
    frames = load_tracks(rig / "tracks.npz").frames
    opened = open_capture(capture, allow_outside=allow_outside)
    with progress() as report:
        offsets = sync_cameras(opened, report)["offsets"]
        patterns = write_plates(opened, offsets, frames, rig, report)
    found = {"folder": str(rig), "frames": [int(frames[0]), int(frames[-1])], "plates": patterns}
    emit(found, as_json, [str(rig / pattern) for pattern in patterns])


def photos(
    outlines: Annotated[
        list[Path], Argument(help="An image per photograph: tooth outlines as bright lines on black, or filled teeth.")
    ],
    upper_teeth: Annotated[Path, Option(help="Scan of the upper teeth, in any frame.")],
    lower_teeth: Annotated[Path, Option(help="Scan of the lower teeth, in any frame.")],
    out: Annotated[Path, Option("-o", "--out", help="Folder for photos.json and an overlay per photograph.")] = Path(
        "photos"
    ),
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Register two scans in occlusion, from outlines drawn in photographs of the closed bite.

    All photographs must show the same bite and be taken with one camera, whose focal length may be unknown. Some may be
    taken via an intraoral mirror. Exit code 6 if the scans do not fit the outlines.
    """
    from jawusd.cli.text_capture import photograph_lines
    from jawusd.photographs.align import align_photograph_files

    with progress() as report:
        found = align_photograph_files(outlines, upper_teeth, lower_teeth, out, force=force, progress=report)
    emit({**found.result.as_json(), "file": str(found.file)}, as_json, photograph_lines(found))
    if any(finding.severity == "error" for finding in found.result.findings):
        raise Exit(TrackingError.exit_code)
