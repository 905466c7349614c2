"""From a capture to a rig in one call; finished stages are kept, and reused when nothing they read has changed."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NotRequired, TypedDict, TypeVar, cast

from jawusd import __version__
from jawusd.errors import OutputError, explain_missing_packages, naming_file
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding
from jawusd.formats.model import load_model, save_model
from jawusd.formats.tracks import load_tracks, save_tracks
from jawusd.pipeline.bake import bake_subject, write_take
from jawusd.pipeline.calibrate import (
    CalibrationSummary,
    SyncResult,
    calibrate_boards,
    calibration_lines,
    sync_cameras,
)
from jawusd.pipeline.cameras import rescaled_cameras
from jawusd.pipeline.capture_inputs import input_hashes, open_capture
from jawusd.pipeline.check import check_capture, refuse_errors
from jawusd.pipeline.fit import FitSummary, fit_lines, fit_subject, fit_summary
from jawusd.pipeline.memory import give_back_memory
from jawusd.pipeline.origin import origin_now
from jawusd.pipeline.report import BuildFacts, missing_packages, place_of, write_build_report
from jawusd.pipeline.scans import all_labelled, store_labels, with_stored_labels
from jawusd.pipeline.segment_record import delete_masks
from jawusd.pipeline.state import (
    BUILD_FILE,
    CALIBRATION,
    FIRST_PASS,
    LABELS,
    LOCK_FILE,
    BuildState,
    Progress,
    StageRecord,
    hash_value,
    locked,
    no_progress,
)
from jawusd.pipeline.subject import subject_of_capture
from jawusd.pipeline.track import TrackSummary, first_pass, model_pass, track_lines, track_summary

if TYPE_CHECKING:
    from jawusd.report.verdicts import BuildVerdict

OLD_MASKS = "masks"  # folder in which version 0.1 made masks where the capture named none

R = TypeVar("R", bound=Mapping[str, object])


@dataclass(frozen=True)
class BuildOptions:
    """Choose how to build.

    Attributes:
        model: "anchored", "additive", "paper" or "pca".
        solver: "contour" or "paper".
        backend: where the paper's solver draws, "cpu" or "gl".
        jobs: threads of the tracker; the result does not depend on it.
        resume: continue an earlier build in the folder.
        fresh: delete an earlier build in the folder first.
        allow_outside: let paths in the capture leave its folder.
        command: the command line that asks for it, for the report.
    """

    model: str = "anchored"
    solver: str = "contour"
    backend: str = "cpu"
    jobs: int = 2
    resume: bool = False
    fresh: bool = False
    allow_outside: bool = False
    command: str = ""


FoundJson = dict[str, str | float | int]


class CheckResult(TypedDict):
    """Hold `Finding.as_json` of what was found before the first stage."""

    findings: list[FoundJson]


class ReportSummary(TypedDict):
    """Hold the capture's path relative to the rig, `Origin`, and the report's file, or which package it lacks."""

    capture: str
    origin: NotRequired[dict[str, object]]
    file: NotRequired[str]
    verdict: NotRequired[BuildVerdict]
    missing: NotRequired[str]


class BuildSummary(TypedDict):
    """Hold what a build found.

    Attributes:
        files: names of all files written, relative to the folder.
        seconds: per stage, also of those reused.
        reused: stages kept from an earlier build.
        findings: `Finding.as_json` of what the check before the first stage found.
        calibrate: None if the capture names a calibration.
        track: of the final tracks.
    """

    capture: str
    folder: str
    files: list[str]
    seconds: dict[str, float]
    reused: list[str]
    findings: NotRequired[list[FoundJson]]
    calibrate: CalibrationSummary | None
    sync: SyncResult
    track: TrackSummary
    fit: FitSummary
    report: ReportSummary


@explain_missing_packages()
def build(
    capture: Capture | str | os.PathLike[str],
    out: str | os.PathLike[str],
    options: BuildOptions = BuildOptions(),
    progress: Progress | None = None,
    tell: Callable[[Finding], None] | None = None,
) -> BuildSummary:
    """Build a rig from a capture.

    Args:
        capture: the capture, its capture.toml or the folder that holds it.
        out: the rig's folder.
        progress: called with (stage, done, total) as work proceeds.
        tell: called, before any work, with everything doubtful that a check of the capture found.

    Raises:
        CaptureError: the check found errors; the message lists all of them.
        JawusdError: one of its kinds; stages finished before stay valid for `resume`.
    """
    capture = open_capture(capture, allow_outside=options.allow_outside)
    folder = Path(out)
    check_folder(folder, options)
    with locked(folder):
        state = BuildState(folder)
        if options.fresh:
            state.clear()
            delete_masks(folder / OLD_MASKS)
        return StagedBuild(capture, folder, options, state, progress or no_progress).run(tell)


def check_folder(folder: Path, options: BuildOptions) -> None:
    """Check that a build may go to a folder.

    Raises:
        OutputError: it is a file, or holds other files, or a build that is neither to be continued nor deleted.
    """
    if folder.is_file():
        raise OutputError("is a file; the rig needs a folder.", path=folder, hint="Name a new folder.")
    if not folder.is_dir() or options.resume or options.fresh:
        return
    if (folder / BUILD_FILE).exists():
        raise OutputError(
            "holds an earlier build.", path=folder, hint="Continue it with --resume, or start over with --fresh."
        )
    if any(entry.name != LOCK_FILE for entry in folder.iterdir()):
        raise OutputError("exists and is not empty.", path=folder, hint="Name a new folder.")


class StagedBuild:
    """One run of the stages over one capture."""

    def __init__(
        self, capture: Capture, folder: Path, options: BuildOptions, state: BuildState, progress: Progress
    ) -> None:
        self.capture, self.folder, self.options = capture, folder, options
        self.state, self.progress = state, progress
        self.reused: list[str] = []

    def run(self, tell: Callable[[Finding], None] | None) -> BuildSummary:
        """Run the stages in order, or reuse them."""
        videos = input_hashes(self.capture, ["videos"])
        check = self._checked(videos)
        if tell is not None:
            for found in check.result["findings"]:
                tell(Finding.from_json(found))
        labels = self._labelled()
        calibrate = self._calibrated()
        capture, options = self.capture, self.options
        names = [camera.name for camera in capture.cameras]
        sync = self._stage("sync", self._inputs([], videos, capture.sync.model_dump(), names, capture.fps), self._sync)
        # Contents are hashed, not paths: a capture may be moved.
        described = capture.model_dump(mode="json", include={"frames", "bootstrap", "anatomy", "calibration_unit_mm"})
        masks = [camera.masks and camera.masks.labels for camera in capture.cameras]
        track = self._stage(
            "track",
            self._inputs(
                ["teeth", "mandible", "calibration", "masks"],
                described,
                names,
                masks,
                rescaled_cameras(self.capture),
                sync.result["offsets"],
                [options.solver, options.backend],
                [] if any(camera.masks for camera in capture.cameras) else videos,
            ),
            lambda: self._track(sync.result["offsets"]),
        )
        person = [options.model, capture.name, capture.fps]
        fit = self._stage("fit", self._inputs([], track.outputs, track.inputs, person), self._fit)
        aid = self._stage(
            "aid",
            self._inputs([], track.outputs, track.inputs, fit.outputs),
            lambda: self._aid(sync.result["offsets"]),
        )
        bake = self._stage("bake", self._inputs(["skull"], fit.outputs, aid.outputs, track.inputs), self._bake)
        missing = missing_packages()
        inputs = self._inputs([], bake.outputs, bake.inputs, videos, sync.result, missing)
        report = self._stage("report", inputs, lambda: self._report(missing))
        stages = (labels, calibrate, track, fit, aid, bake, report)
        outputs = {name for stage in stages if stage for name in stage.outputs}
        return {
            "capture": capture.name,
            "folder": str(self.folder),
            "files": sorted(outputs),
            "seconds": {name: record.seconds for name, record in self.state.stages.items()},
            "reused": self.reused,
            "findings": check.result["findings"],
            "calibrate": calibrate.result if calibrate else None,
            "sync": sync.result,
            "track": aid.result,
            "fit": fit.result,
            "report": report.result,
        }

    def _inputs(self, parts: Iterable[str], *values: object) -> str:
        return hash_value([input_hashes(self.capture, parts), *values, __version__])

    def _stage(self, name: str, inputs: str, work: Callable[[], tuple[list[Path], R]]) -> StageRecord[R]:
        record = self.state.valid(name, inputs)
        if record is not None:
            self.reused.append(name)
            self.progress(name, 1, 1)
            # build.json is what this stage wrote: its hash was checked when it was read.
            return cast("StageRecord[R]", record)
        start = time.perf_counter()
        outputs, result = work()
        give_back_memory()
        return self.state.finish(name, inputs, outputs, time.perf_counter() - start, result)

    def _checked(self, videos: dict[str, str]) -> StageRecord[CheckResult]:
        """Check the capture before any work, and refuse it with all errors at once."""
        capture = self.capture

        def work() -> tuple[list[Path], CheckResult]:
            findings = check_capture(capture, self.folder, progress=self.progress)
            refuse_errors(findings, capture)
            return [], {"findings": [finding.as_json() for finding in findings]}

        parts = ["teeth", "mandible", "skull", "calibration", "masks"]
        described = capture.model_dump(mode="json", exclude={"folder"})
        return self._stage("check", self._inputs(parts, videos, described), work)

    def _labelled(self) -> StageRecord[dict[str, str]] | None:
        """Tell crown and gum of the scans apart where neither paint nor a file does."""
        capture, folder = self.capture, self.folder / LABELS
        if all_labelled(capture):
            return None
        none: dict[str, str] = {}
        record = self._stage("scans", self._inputs(["teeth"]), lambda: (store_labels(capture, folder), none))
        self.capture = with_stored_labels(capture, folder)
        return record

    def _calibrated(self) -> StageRecord[CalibrationSummary] | None:
        """Calibrate from the boards if the capture names no calibration but has boards."""
        capture = self.capture
        if capture.calibration is not None or capture.boards is None:
            return None
        described = capture.boards.model_dump(mode="json", exclude={"videos"})
        picks = capture.bootstrap.model_dump(mode="json") if capture.bootstrap else None
        names = [camera.name for camera in capture.cameras]
        path = self.folder / CALIBRATION
        record = self._stage(
            "calibrate",
            # Without picks, the stated size of the squares is checked with the masks.
            self._inputs(["boards", "teeth", *([] if picks else ["masks", "videos"])], described, picks, names),
            lambda: ([path], calibrate_boards(capture, path, self.progress)),
        )
        self.capture = capture.model_copy(update={"calibration": path, "calibration_unit_mm": 1.0})
        return record

    def _sync(self) -> tuple[list[Path], SyncResult]:
        return [], sync_cameras(self.capture, self.progress)

    def _track(self, offsets: dict[str, int]) -> tuple[list[Path], TrackSummary]:
        options = self.options
        tracks = first_pass(self.capture, offsets, options.jobs, self.progress, options.solver, options.backend)
        path = self.folder / FIRST_PASS
        save_tracks(path, tracks)
        return [path], track_summary(tracks)

    def _fit(self) -> tuple[list[Path], FitSummary]:
        tracks = load_tracks(self.folder / FIRST_PASS)
        with naming_file(self.capture.folder / "capture.toml"):
            subject = subject_of_capture(self.capture)
            model = fit_subject(subject, tracks, self.options.model, self.progress)
        path = self.folder / "model.npz"
        save_model(path, model)
        return [path], fit_summary(model)

    def _aid(self, offsets: dict[str, int]) -> tuple[list[Path], TrackSummary]:
        first, model = load_tracks(self.folder / FIRST_PASS), load_model(self.folder / "model.npz")
        tracks = model_pass(self.capture, offsets, first, model, self.options.jobs, self.progress)
        path = self.folder / "tracks.npz"
        save_tracks(path, tracks)
        return [path], track_summary(tracks)

    def _bake(self) -> tuple[list[Path], dict[str, object]]:
        subject, model = subject_of_capture(self.capture), load_model(self.folder / "model.npz")
        files = bake_subject(subject, model, self.folder, self.progress)
        take = write_take(self.capture, load_tracks(self.folder / "tracks.npz"), self.folder)
        return [*files, *take], {}

    def _report(self, missing: str | None) -> tuple[list[Path], ReportSummary]:
        place, origin = place_of(self.capture, self.folder), origin_now(self.options.command)
        if missing is not None:
            # The rig is complete without; the summary says what is missing and how to get it.
            return [], {"capture": place, "origin": asdict(origin), "missing": missing}
        facts = BuildFacts(self.state.stages, self.capture, origin)
        path, verdict = write_build_report(self.folder, facts, self.progress)
        return [path], {"capture": place, "origin": asdict(origin), "file": path.name, "verdict": verdict}


def build_lines(summary: BuildSummary) -> list[str]:
    """Return the summary of a build as text."""
    offsets = ", ".join(f"{name} {offset:+d}" for name, offset in summary["sync"]["offsets"].items())
    # What the tracks say of the scans is said with them.
    known = [Finding.from_json(found).line() for found in summary["track"].get("findings", [])]
    lines = [Finding.from_json(found).line() for found in summary.get("findings", [])]
    lines = [line for line in lines if line not in known]
    if summary["calibrate"]:
        lines += [
            "the capture names no calibration: made one from its boards",
            *calibration_lines(summary["calibrate"]),
        ]
    lines += [f"sync ({summary['sync']['method']}): {offsets} frames"]
    lines += [f"  note: {note}" for note in summary["sync"].get("notes", [])]
    lines += track_lines(summary["track"])
    lines += fit_lines(summary["fit"])
    seconds = ", ".join(
        f"{name} {'kept' if name in summary['reused'] else f'{value:.1f} s'}"
        for name, value in summary["seconds"].items()
    )
    report = summary["report"]
    shown = f"{summary['folder']}/{report['file']}" if "file" in report else f"none: {report['missing']}"
    ends = [f"time: {seconds}", f"rig: {summary['folder']}/actor.usda", f"report: {shown}"]
    return [*lines, *ends, *_verdict_lines(report)]


_MOST_REASONS = 4


def _verdict_lines(report: ReportSummary) -> list[str]:
    """Return the verdict on the build: what the report says, with the figures that make it so."""
    if "verdict" not in report:
        return ["verdict: none, there is no report that judges it"]
    grade, because = report["verdict"]["grade"], report["verdict"]["because"]
    words = {
        "good": "good",
        "look": "usable; look at this in the report first:",
        "bad": "not usable as it is, because of:",
        "open": "none, there is nothing to judge it by",
    }
    more = [f"and {len(because) - _MOST_REASONS} more"] if len(because) > _MOST_REASONS else []
    return [f"verdict: {words.get(grade, grade)}", *(f"  {one}" for one in (*because[:_MOST_REASONS], *more))]
