"""Build a rig from a capture, stage by stage; a stage is reused if none of its inputs has changed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from typing_extensions import TypedDict

from jawusd.base.errors import AnyPath, explain_missing_packages, naming_file
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding, FoundJson
from jawusd.formats.model import load_model, save_model
from jawusd.formats.notes import CalibrationNotes, SyncNotes
from jawusd.formats.tracks import load_tracks, save_tracks
from jawusd.pipeline.bake import bake_subject, write_take
from jawusd.pipeline.calibrate import calibrate_boards, sync_cameras
from jawusd.pipeline.cameras import rescaled_cameras
from jawusd.pipeline.check import check_capture, refuse_errors
from jawusd.pipeline.fit import FitSummary, fit_subject, fit_summary
from jawusd.pipeline.report import BuildFacts, CheckResult, missing_packages, relative_capture_path, write_build_report
from jawusd.pipeline.scans import all_labelled, store_labels, with_stored_labels
from jawusd.pipeline.segment_record import delete_masks
from jawusd.pipeline.state import (
    CALIBRATION,
    FIRST_PASS,
    LABELS,
    Progress,
    ReportSummary,
    StageRecord,
    locked,
    no_progress,
    origin_now,
)
from jawusd.pipeline.subject import subject_of_capture
from jawusd.pipeline.track import TrackSummary, first_pass, model_pass, track_summary
from jawusd.pipeline.workspace import DryWorkspace, Stage, StageMissing, Workspace, check_folder, open_capture

OLD_MASKS = "masks"  # folder to which version 0.1 wrote masks if the capture named no mask folder


@dataclass(frozen=True)
class BuildOptions:
    """Options of a build."""

    model: str = "anchored"  # "anchored", "additive", "paper" or "pca"
    solver: str = "contour"  # "contour" or "paper"
    backend: str = "cpu"  # renderer of the paper's solver, "cpu" or "gl"
    jobs: int = 2  # number of threads of the tracker; the result does not depend on it
    resume: bool = False  # continue an earlier build in the folder
    fresh: bool = False  # delete an earlier build in the folder first
    allow_outside: bool = False  # allow paths in the capture that point outside its folder
    prim_name: str | None = None  # name of the actor's prim; None: derived from the name of the capture
    command: str = ""  # command line of the build, recorded in the report


class BuildSummary(TypedDict):
    """The result of a build."""

    capture: str
    folder: str
    files: list[str]  # names of all files written, relative to the folder
    seconds: dict[str, float]  # duration of each stage [s]; for a reused stage, the duration of its last run
    reused: list[str]  # stages reused from an earlier build
    findings: list[FoundJson]  # the findings of the check before the first stage, as `Finding.as_json`
    calibrate: CalibrationNotes | None  # summary of the calibration; None if the capture names a calibration file
    sync: SyncNotes
    track: TrackSummary  # summary of the final tracks
    fit: FitSummary
    report: ReportSummary


CHECK = Stage("check", CheckResult, 8.0)
SCANS = Stage("scans", dict[str, str], 5.0)
CALIBRATE = Stage("calibrate", CalibrationNotes, 60.0)
SYNC = Stage("sync", SyncNotes, 3.0)
TRACK = Stage("track", TrackSummary, 10.0, 0.15)
FIT = Stage("fit", FitSummary, 15.0)
REFINE = Stage("refine", TrackSummary, 5.0, 0.03)
BAKE = Stage("bake", dict[str, object], 5.0)
REPORT = Stage("report", ReportSummary, 15.0)


@explain_missing_packages()
def build(
    capture: Capture | AnyPath,
    out: AnyPath,
    options: BuildOptions = BuildOptions(),
    progress: Progress | None = None,
    tell: Callable[[Finding], None] | None = None,
) -> BuildSummary:
    """Build a rig from a capture.

    Args:
        capture: the capture, its capture.toml or the folder of that file.
        out: the rig's folder.
        tell: called with every finding of the capture's check, before any work.

    Raises:
        CaptureError: the check found errors (all are listed in the message), or inputs changed while a stage ran.
        JawusdError: a stage failed; finished stages stay valid for `resume`.
    """

    def read() -> Capture:
        return open_capture(capture, allow_outside=options.allow_outside)

    folder, given = Path(out), read()
    check_folder(folder, resume=options.resume, fresh=options.fresh)
    with locked(folder):
        run = Workspace(folder, given, read, progress or no_progress)
        if options.fresh:
            run.state.clear()
            delete_masks(folder / OLD_MASKS)
        return run_stages(run, options, tell)


def run_stages(run: Workspace, options: BuildOptions, tell: Callable[[Finding], None] | None) -> BuildSummary:
    """Run the stages of a build in order, or reuse them.

    Contents of files are hashed, but not paths, so that a capture may be moved; only the report depends on its path.
    """
    capture, videos = run.capture, run.hashes(["videos"])
    names = [camera.name for camera in capture.cameras]

    described = capture.model_dump(mode="json", exclude={"folder"})
    inputs = ["teeth", "mandible", "skull", "calibration", "masks"]
    check = run.run(CHECK, inputs, [videos, described], lambda: _check(run))
    if tell is not None:
        for found in check.result["findings"]:
            tell(Finding.from_json(found))

    scans = None if all_labelled(capture) else _labelled(run)
    calibration = _calibrated(run) if capture.calibration is None and capture.boards is not None else None

    sync = run.run(SYNC, [], [videos, capture.sync.model_dump(), names, capture.fps], lambda: _sync(run))
    offsets = sync.result["offsets"]

    described = capture.model_dump(mode="json", include={"frames", "bootstrap", "anatomy", "calibration_unit_mm"})
    labels = [camera.masks and camera.masks.labels for camera in capture.cameras]
    footage = [] if any(camera.masks for camera in capture.cameras) else videos
    solver = [options.solver, options.backend]
    settings: list[object] = [described, names, labels, rescaled_cameras(run.capture), offsets, solver, footage]
    inputs = ["teeth", "mandible", "calibration", "masks"]
    track = run.run(TRACK, inputs, settings, lambda: _track(run, options, offsets))

    settings = [track.outputs, track.inputs, [options.model, capture.name, capture.fps]]
    fit = run.run(FIT, [], settings, lambda: _fit(run, options))

    settings = [track.outputs, track.inputs, fit.outputs]
    refine = run.run(REFINE, [], settings, lambda: _refine(run, options, offsets))

    settings = [fit.outputs, refine.outputs, track.inputs, options.prim_name]
    bake = run.run(BAKE, ["skull"], settings, lambda: _bake(run, options))

    missing, place = missing_packages(), relative_capture_path(capture, run.folder)
    settings = [bake.outputs, bake.inputs, videos, sync.result, missing, place]
    report = run.run(REPORT, [], settings, lambda: _report(run, options, missing, place))

    written = [stage.outputs for stage in (scans, calibration, track, fit, refine, bake, report) if stage]
    return {
        "capture": capture.name,
        "folder": str(run.folder),
        "files": sorted({name for outputs in written for name in outputs}),
        "seconds": {name: record.seconds for name, record in run.state.stages.items()},
        "reused": run.reused,
        "findings": check.result["findings"],
        "calibrate": calibration.result if calibration else None,
        "sync": sync.result,
        "track": refine.result,
        "fit": fit.result,
        "report": report.result,
    }


def _labelled(run: Workspace) -> StageRecord[dict[str, str]]:
    """Label crown and gum of scans that have neither paint nor a label file."""
    folder = run.folder / LABELS
    none: dict[str, str] = {}
    record = run.run(SCANS, ["teeth"], [], lambda: (store_labels(run.capture, folder), none))
    run.capture = with_stored_labels(run.capture, folder)
    return record


def _calibrated(run: Workspace) -> StageRecord[CalibrationNotes]:
    """Calibrate the cameras from the boards."""
    capture, path = run.capture, run.folder / CALIBRATION
    boards = capture.boards.model_dump(mode="json", exclude={"videos"}) if capture.boards else None
    picks = capture.bootstrap.model_dump(mode="json") if capture.bootstrap else None
    # Without picks, the board's stated square size is verified with the masks.
    parts = ["boards", "teeth", *([] if picks else ["masks", "videos"])]
    settings = [boards, picks, [camera.name for camera in capture.cameras]]
    record = run.run(CALIBRATE, parts, settings, lambda: ([path], calibrate_boards(capture, path, run.progress)))
    run.capture = capture.model_copy(update={"calibration": path, "calibration_unit_mm": 1.0})
    return record


def _check(run: Workspace) -> tuple[list[Path], CheckResult]:
    """Check the capture before the first stage; raise one error that lists all problems."""
    findings = check_capture(run.capture, run.folder, progress=run.progress)
    refuse_errors(findings, run.capture)
    return [], {"findings": [finding.as_json() for finding in findings]}


def _sync(run: Workspace) -> tuple[list[Path], SyncNotes]:
    return [], sync_cameras(run.capture, run.progress)


def _track(run: Workspace, options: BuildOptions, offsets: dict[str, int]) -> tuple[list[Path], TrackSummary]:
    tracks = first_pass(run.capture, offsets, options.jobs, run.progress, options.solver, options.backend)
    path = run.folder / FIRST_PASS
    save_tracks(path, tracks)
    return [path], track_summary(tracks)


def _fit(run: Workspace, options: BuildOptions) -> tuple[list[Path], FitSummary]:
    tracks = load_tracks(run.folder / FIRST_PASS)
    with naming_file(run.capture.file):
        subject = subject_of_capture(run.capture)
        model = fit_subject(subject, tracks, options.model, run.progress)
    path = run.folder / "model.npz"
    save_model(path, model)
    return [path], fit_summary(model)


def _refine(run: Workspace, options: BuildOptions, offsets: dict[str, int]) -> tuple[list[Path], TrackSummary]:
    first, model = load_tracks(run.folder / FIRST_PASS), load_model(run.folder / "model.npz")
    tracks = model_pass(run.capture, offsets, first, model, options.jobs, run.progress)
    path = run.folder / "tracks.npz"
    save_tracks(path, tracks)
    return [path], track_summary(tracks)


def _bake(run: Workspace, options: BuildOptions) -> tuple[list[Path], dict[str, object]]:
    subject, model = subject_of_capture(run.capture), load_model(run.folder / "model.npz")
    files = bake_subject(subject, model, run.folder, run.progress, prim_name=options.prim_name)
    take = write_take(run.capture, load_tracks(run.folder / "tracks.npz"), run.folder)
    return [*files, *take], {}


def _report(run: Workspace, options: BuildOptions, missing: str | None, place: str) -> tuple[list[Path], ReportSummary]:
    origin = origin_now(options.command)
    if missing is not None:
        # The rig is complete without a report; the summary lists the missing packages.
        return [], {"capture": place, "origin": asdict(origin), "missing": missing}
    path, verdict = write_build_report(run.folder, BuildFacts(run.state, run.capture, origin), run.progress)
    return [path], {"capture": place, "origin": asdict(origin), "file": path.name, "verdict": verdict}


@dataclass(frozen=True)
class PlannedStage:
    """A stage of a planned build."""

    name: str
    keeps: bool  # whether the recorded result of the stage is reused
    seconds: float  # recorded duration [s], or an estimate if the stage has no record


@explain_missing_packages()
def plan_build(capture: Capture | AnyPath, out: Path, options: BuildOptions) -> list[PlannedStage]:
    """Return the stages of a build in order; nothing is written.

    Raises:
        CaptureError, FormatError: the capture cannot be read.
        OutputError: the build cannot write to this folder; see `check_folder`.
    """
    as_read = open_capture(capture, allow_outside=options.allow_outside)
    check_folder(out, resume=options.resume, fresh=options.fresh)
    run = DryWorkspace(out, as_read, lambda: as_read)
    recorded = dict(run.state.stages)
    with contextlib.suppress(StageMissing):
        if not options.fresh:
            run_stages(run, options, None)
    pictures = _pictures(as_read)
    stages = []
    for stage in _stages(as_read):
        estimate = stage.seconds + stage.seconds_per_picture * pictures
        seconds = recorded[stage.name].seconds if stage.name in recorded else estimate
        stages.append(PlannedStage(stage.name, stage.name in run.reused, seconds))
    return stages


def _stages(capture: Capture) -> list[Stage[Mapping[str, object]]]:
    before: list[Stage[Mapping[str, object]]] = [CHECK]
    before += [] if all_labelled(capture) else [SCANS]
    before += [CALIBRATE] if capture.calibration is None and capture.boards is not None else []
    return [*before, SYNC, TRACK, FIT, REFINE, BAKE, REPORT]


def _pictures(capture: Capture) -> int:
    """Return the total number of images to process, over all cameras."""
    from jawusd.media.footage import open_clip

    counts = [open_clip(camera.clip).count for camera in capture.cameras if camera.clip is not None]
    frames = capture.frames[1] - capture.frames[0] if capture.frames else max(counts, default=300)
    return frames * len(capture.cameras)
