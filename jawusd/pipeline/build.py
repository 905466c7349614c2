"""From a capture to a rig in one call; finished stages are kept, and reused when nothing they read has changed."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NotRequired, TypeVar

from typing_extensions import TypedDict

from jawusd import __version__
from jawusd.errors import CaptureError, JawusdError, OutputError, explain_missing_packages, naming_file
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding, FoundJson
from jawusd.formats.model import load_model, save_model
from jawusd.formats.tracks import load_tracks, save_tracks
from jawusd.pipeline.bake import bake_subject, write_take
from jawusd.pipeline.calibrate import (
    CalibrationSummary,
    SyncResult,
    calibrate_boards,
    sync_cameras,
)
from jawusd.pipeline.cameras import rescaled_cameras
from jawusd.pipeline.capture_inputs import InputWatch, open_capture
from jawusd.pipeline.check import check_capture, refuse_errors
from jawusd.pipeline.fit import FitSummary, fit_subject, fit_summary
from jawusd.pipeline.memory import give_back_memory
from jawusd.pipeline.origin import origin_now
from jawusd.pipeline.report import (
    BuildFacts,
    CheckResult,
    ReportSummary,
    missing_packages,
    place_of,
    write_build_report,
)
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
from jawusd.pipeline.track import TrackSummary, first_pass, model_pass, track_summary

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
        CaptureError: the check found errors, all of which the message lists; or inputs changed while a stage ran.
        JawusdError: one of its kinds; stages finished before stay valid for `resume`.
    """

    def read() -> Capture:
        return open_capture(capture, allow_outside=options.allow_outside)

    opened, folder = read(), Path(out)
    check_folder(folder, options)
    with locked(folder):
        state = BuildState(folder)
        if options.fresh:
            state.clear()
            delete_masks(folder / OLD_MASKS)
        return StagedBuild(opened, folder, options, state, progress or no_progress, read).run(tell)


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
        self,
        capture: Capture,
        folder: Path,
        options: BuildOptions,
        state: BuildState,
        progress: Progress,
        read_again: Callable[[], Capture],
    ) -> None:
        self.capture, self.folder, self.options = capture, folder, options
        self.state, self.progress = state, progress
        self._watch, self._opened, self._read_again = InputWatch(), capture, read_again
        self.reused: list[str] = []

    def run(self, tell: Callable[[Finding], None] | None) -> BuildSummary:
        """Run the stages in order, or reuse them."""
        videos = self._watch.hashes(self.capture, ["videos"])
        check = self._checked(videos)
        if tell is not None:
            for found in check.result["findings"]:
                tell(Finding.from_json(found))
        labels = self._labelled()
        calibrate = self._calibrated()
        capture, options = self.capture, self.options
        names = [camera.name for camera in capture.cameras]
        sync = self._stage(
            "sync", SyncResult, self._inputs([], videos, capture.sync.model_dump(), names, capture.fps), self._sync
        )
        # Contents are hashed, not paths: a capture may be moved.
        described = capture.model_dump(mode="json", include={"frames", "bootstrap", "anatomy", "calibration_unit_mm"})
        masks = [camera.masks and camera.masks.labels for camera in capture.cameras]
        track = self._stage(
            "track",
            TrackSummary,
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
        fit = self._stage("fit", FitSummary, self._inputs([], track.outputs, track.inputs, person), self._fit)
        aid = self._stage(
            "aid",
            TrackSummary,
            self._inputs([], track.outputs, track.inputs, fit.outputs),
            lambda: self._aid(sync.result["offsets"]),
        )
        bake = self._stage(
            "bake", dict[str, object], self._inputs(["skull"], fit.outputs, aid.outputs, track.inputs), self._bake
        )
        missing = missing_packages()
        inputs = self._inputs([], bake.outputs, bake.inputs, videos, sync.result, missing)
        report = self._stage("report", ReportSummary, inputs, lambda: self._report(missing))
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
        return hash_value([self._watch.hashes(self.capture, parts), *values, __version__])

    def _stage(self, name: str, kind: type[R], inputs: str, work: Callable[[], tuple[list[Path], R]]) -> StageRecord[R]:
        record = self._kept(name, kind, inputs)
        if record is not None:
            self.progress(name, 1, 1)
            return record
        start = time.perf_counter()
        outputs, result = work()
        self._refuse_changes(name)
        give_back_memory()
        return self.state.finish(name, inputs, outputs, time.perf_counter() - start, result)

    def _kept(self, name: str, kind: type[R], inputs: str) -> StageRecord[R] | None:
        """Return the record of a stage that need not run."""
        record = self.state.valid(name, inputs)
        if record is None:
            return None
        self.reused.append(name)
        return replace(record, result=self.state.result(name, kind))

    def _refuse_changes(self, stage: str) -> None:
        """Refuse to record a stage whose inputs were edited while it ran: nobody knows what of them it has read.

        A capture.toml that says the same in other words has not changed.
        """
        changed = self._watch.changed()
        try:
            same = self._read_again() == self._opened
        except JawusdError:  # it is being saved
            same = False
        if changed or not same:
            raise CaptureError(
                f"changed while the stage {stage} ran: {', '.join([*changed, *([] if same else ['capture.toml'])])}. "
                "The stage is not recorded.",
                path=self._opened.folder,
                hint="Run the same command again with --resume: stages that do not read it are kept.",
            )

    def _checked(self, videos: dict[str, str]) -> StageRecord[CheckResult]:
        """Check the capture before any work, and refuse it with all errors at once."""
        capture = self.capture

        def work() -> tuple[list[Path], CheckResult]:
            findings = check_capture(capture, self.folder, progress=self.progress)
            refuse_errors(findings, capture)
            return [], {"findings": [finding.as_json() for finding in findings]}

        parts = ["teeth", "mandible", "skull", "calibration", "masks"]
        described = capture.model_dump(mode="json", exclude={"folder"})
        return self._stage("check", CheckResult, self._inputs(parts, videos, described), work)

    def _labelled(self) -> StageRecord[dict[str, str]] | None:
        """Tell crown and gum of the scans apart where neither paint nor a file does."""
        capture, folder = self.capture, self.folder / LABELS
        if all_labelled(capture):
            return None
        none: dict[str, str] = {}
        record = self._stage(
            "scans", dict[str, str], self._inputs(["teeth"]), lambda: (store_labels(capture, folder), none)
        )
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
            CalibrationSummary,
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
        facts = BuildFacts(self.state, self.capture, origin)
        path, verdict = write_build_report(self.folder, facts, self.progress)
        return [path], {"capture": place, "origin": asdict(origin), "file": path.name, "verdict": verdict}
