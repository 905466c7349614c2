"""Write the report of a build, and repeat the paper's experiments on a take."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from typing_extensions import TypedDict

from jawusd.base.errors import AnyPath, FormatError, JawusdError, MissingDependencyError, explain_missing_packages
from jawusd.formats.atomic import write_csv_atomic
from jawusd.formats.capture import Capture
from jawusd.formats.experiments import TABLE_COLUMNS, Experiments
from jawusd.formats.finding import Finding, FoundJson
from jawusd.formats.model import JawModel, load_model
from jawusd.formats.notes import SyncNotes
from jawusd.formats.report import BuildVerdict, CameraFacts, Origin, Overlay, ReportData, RigFacts
from jawusd.formats.tracks import Tracks, load_tracks
from jawusd.pipeline.cameras import check_same_cameras, load_cameras, open_videos
from jawusd.pipeline.contact import contact_pictures
from jawusd.pipeline.fit import Poses, fit_summary
from jawusd.pipeline.pictures import chosen_frames, draw_frames, replay_parts
from jawusd.pipeline.scans import with_stored_labels
from jawusd.pipeline.state import (
    BUILD_FILE,
    CALIBRATION,
    FIRST_PASS,
    LABELS,
    BuildState,
    Progress,
    ReportSummary,
    locked,
    no_progress,
    recorded_origin,
)
from jawusd.pipeline.subject import Subject, subject_of_build
from jawusd.pipeline.workspace import open_capture

T = TypeVar("T")

REPORT_FILE = "report.html"
TABLE_FILE = "experiments.csv"
_NETWORKS = (
    "The paper's own models (NLPCA) take about a minute to train: `jawusd report DIR --experiments` adds them to the "
    "figures."
)


class CheckResult(TypedDict):
    """Findings of the check before the first stage."""

    findings: list[FoundJson]


@dataclass(frozen=True)
class BuildFacts:
    """Facts of a finished build, with its capture if that is available."""

    state: BuildState
    capture: Capture | None
    origin: Origin
    why_not: str = ""  # why the capture is not available

    def given(self) -> Capture:
        """Return the capture; raises FormatError if it is not available."""
        if self.capture is None:
            raise FormatError(self.why_not)
        return self.capture


@explain_missing_packages()
def write_build_report(
    folder: Path, facts: BuildFacts, progress: Progress, experiments: Experiments | None = None
) -> tuple[Path, BuildVerdict]:
    """Write report.html of a finished build; return its path and the verdict.

    Args:
        experiments: results of all experiments; None: run only the experiments that take seconds.

    Raises:
        MissingDependencyError: matplotlib or jinja2 is not installed.
        FormatError, RigError: a file of the build is corrupt.
        OutputError: the file cannot be written.
    """
    # imported first, so that missing packages raise an error before any work
    from jawusd.paper.figures import inline_figures
    from jawusd.report.document import draw_figures, write_document

    progress("report", 0, 4)
    tracks, model = load_tracks(folder / "tracks.npz"), load_model(folder / "model.npz")
    subject = subject_of_build(folder)
    unmet, unseen = list[str](), list[str]()

    def draw() -> tuple[Overlay, ...]:
        capture, chosen = facts.given(), chosen_frames(tracks, facts.given().fps)
        check_same_cameras(capture, tracks)
        return draw_frames(capture, recorded_offsets(facts.state), tracks, chosen, open_videos(capture))

    with ThreadPoolExecutor(1) as pool:  # decoding, drawing and measuring images releases the GIL
        drawn = pool.submit(attempt, "images of the footage", unseen, draw)
        contacts = attempt("contacts of the teeth", unmet, lambda: contact_pictures(model, subject)) or ()
        data = _without_pictures(folder, facts, tracks, model, subject, experiments)
        progress("report", 1, 4)
        figures = draw_figures(data) | (inline_figures(data.experiments) if data.experiments else {})
        progress("report", 2, 4)
        overlays = drawn.result() or ()
    left_out = tuple(dict.fromkeys((*data.left_out, *unmet, *unseen)))
    progress("report", 3, 4)
    data = replace(data, overlays=overlays, contacts=contacts, left_out=left_out)
    verdict = write_document(folder / REPORT_FILE, data, figures)
    progress("report", 4, 4)
    return folder / REPORT_FILE, verdict


def _without_pictures(
    folder: Path, facts: BuildFacts, tracks: Tracks, model: JawModel, subject: Subject, experiments: Experiments | None
) -> ReportData:
    """Return the data of a report, except for the images of footage and teeth."""
    from jawusd.rig import describe, validate_stage

    about, findings = describe(folder / "actor.usda"), validate_stage(folder / "actor.usda")
    left_out: list[str] = []
    checked = facts.state.result("check", CheckResult)
    stages = {name: record for name, record in facts.state.stages.items() if name != "report"}
    if experiments is None:
        experiments = attempt(
            "experiments",
            left_out,
            lambda: run_paper_experiments(subject, load_tracks(fitted_poses(folder)), 1, no_progress, quick=True),
        )
        left_out.append(_NETWORKS)
    if about["placeholders"]:
        left_out.append("the mandible in 3-D: no mesh was given, and the rig's placeholder is not anatomical.")
    return ReportData(
        actor=subject.name,
        tracks=tracks,
        model=model,
        sync=facts.state.result("sync", SyncNotes) or SyncNotes(method="not recorded", offsets={}),
        cameras=attempt("cameras", left_out, lambda: camera_facts(facts.given())) or (),
        inferred=tuple(fit_summary(model).get("inferred", ())),
        seconds={name: record.seconds for name, record in stages.items()},
        hashes=dict(sorted(output for record in stages.values() for output in record.outputs.items())),
        origin=facts.origin,
        rig=RigFacts(float(about["table"]["max_error_mm"]), tuple(f"{f.severity}: {f.message}" for f in findings)),
        experiments=experiments,
        overlays=(),
        parts=attempt("3-D replay", left_out, lambda: replay_parts(folder, model)) or (),
        left_out=tuple(left_out),
        findings=tuple(map(Finding.from_json, checked["findings"] if checked else ())),
    )


def report_build(
    folder: Path,
    capture: AnyPath | None,
    progress: Progress,
    experiments: Experiments | None = None,
    *,
    allow_outside: bool = False,
) -> Path:
    """Write the report of a finished build again and return its path; see `write_build_report`.

    Args:
        capture: capture.toml or its folder; None: as recorded in the build.

    Raises:
        FormatError: the path is not the folder of a build, or its files are corrupt or were modified.
        MissingDependencyError, RigError, OutputError: see `write_build_report`.
        CaptureError: the given capture cannot be read.
    """
    if not is_build(folder):
        raise FormatError(
            f"is not the folder of a build: it has no {BUILD_FILE}.",
            path=folder,
            hint="Give the folder that `jawusd build` wrote, or add --experiments for poses.",
        )
    with locked(folder):
        state = BuildState(folder)
        if changed := [found for found in state.changed() if found.path != REPORT_FILE]:
            listed = "".join(f"\n  {found.line()}" for found in changed)
            raise FormatError(f"files of this build were modified:{listed}", path=folder)
        given = open_capture(capture, allow_outside=allow_outside) if capture is not None else None
        facts = build_facts(folder, state, given, allow_outside=allow_outside)
        path, verdict = write_build_report(folder, facts, progress, experiments)
        # Record the hash of the new file; otherwise the next --resume would write the report again.
        known = state.stages.get("report")
        result = dict(known.result if known else {}) | {"file": path.name, "verdict": verdict}
        if facts.capture:
            result["capture"] = relative_capture_path(facts.capture, folder)
        state.finish("report", known.inputs if known else "", [path], known.seconds if known else 0.0, result)
    return path


def is_build(folder: Path) -> bool:
    """Return whether a path is the folder of a build."""
    return (folder / BUILD_FILE).is_file()


def fitted_poses(folder: Path) -> Path:
    """Return the tracks to which a build fitted its model: those of the first pass."""
    first = folder / FIRST_PASS
    return first if first.is_file() else folder / "tracks.npz"


def missing_packages() -> str | None:
    """Return a message about the packages that a report lacks; None if none is missing."""
    try:
        with explain_missing_packages():
            import jawusd.report.document  # noqa: F401
    except MissingDependencyError as error:
        return str(error)
    return None


def build_facts(folder: Path, state: BuildState, capture: Capture | None, *, allow_outside: bool = False) -> BuildFacts:
    """Return the facts of a build, with its capture, by default that at the recorded path, if it can be read."""
    reported = state.result("report", ReportSummary) or {}
    origin, place = recorded_origin(reported), reported.get("capture")
    if capture is not None:
        return BuildFacts(state, as_built(capture, folder), origin)
    if not place:
        return BuildFacts(state, None, origin, "the build does not record its capture: name it with --capture.")
    path = folder / str(place)
    try:
        return BuildFacts(state, as_built(open_capture(path, allow_outside=allow_outside), folder), origin)
    except JawusdError as error:
        return BuildFacts(state, None, origin, f"the capture cannot be read ({error}): name it with --capture.")


def as_built(capture: Capture, folder: Path) -> Capture:
    """Return the capture with the calibration and the scan labels that the build wrote."""
    made = folder / CALIBRATION
    if capture.calibration is None and made.is_file():
        capture = capture.model_copy(update={"calibration": made, "calibration_unit_mm": 1.0})
    return with_stored_labels(capture, folder / LABELS)


def relative_capture_path(capture: Capture, folder: Path) -> str:
    """Return the path of a capture relative to the rig's folder, or its absolute path if on another drive."""
    try:
        return os.path.relpath(capture.folder, folder.resolve())
    except ValueError:  # the paths are on different drives
        return str(capture.folder)


def attempt(what: str, left_out: list[str], work: Callable[[], T]) -> T | None:
    """Run a function that makes one part of the report; if it fails, list the part as left out and return None."""
    try:
        with explain_missing_packages():
            return work()
    except JawusdError as error:
        left_out.append(f"{what}: {error}")
        return None


def recorded_offsets(state: BuildState) -> dict[str, int]:
    """Return the recorded frame offset of every camera, if any; raises FormatError if build.json is corrupt."""
    found = state.result("sync", SyncNotes)
    return found["offsets"] if found else {}


def camera_facts(capture: Capture) -> tuple[CameraFacts, ...]:
    """Return the footage, masks and image size of each camera; raises like `load_cameras`."""
    return tuple(
        CameraFacts(
            source.name,
            source.video.name if source.video else "",
            f"{source.masks.upper.name}, {source.masks.lower.name}" if source.masks else "",
            (int(camera.size_px[0]), int(camera.size_px[1])),
        )
        for source, camera in zip(capture.cameras, load_cameras(capture), strict=True)
    )


@explain_missing_packages()
def run_paper_experiments(
    subject: Subject, motion: Tracks | Poses, starts: int, progress: Progress, *, quick: bool = False
) -> Experiments:
    """Run the paper's experiments, with some random `starts` of its networks; raises FittingError for too few poses.

    With `quick`, the networks and the paper's model, which take minutes, are skipped.
    """
    from jawusd.fitting import FittingConfig
    from jawusd.fitting.data import SubjectAnatomy
    from jawusd.paper.experiments import run_experiments

    points = subject.measured_points()
    anatomy = SubjectAnatomy.of(subject.T_anatomical_skull, subject.landmarks, points, subject.T_rest)
    return run_experiments(
        motion,
        anatomy,
        bones=subject.meshes,
        config=FittingConfig(starts=starts),
        actor=subject.name,
        quick=quick,
        progress=partial(progress, "experiments"),
    )


@explain_missing_packages()
def draw_experiments(found: Experiments, folder: Path) -> list[Path]:
    """Write figures and table of the experiments to a folder; return the files; raises OutputError."""
    from jawusd.paper import figures

    files = figures.draw_experiments(found, folder)
    write_csv_atomic(folder / TABLE_FILE, TABLE_COLUMNS, found.table())
    return [*files, folder / TABLE_FILE]


@explain_missing_packages()
def experiment_files(folder: Path) -> list[Path]:
    """Return the files that `draw_experiments` writes into a folder."""
    from jawusd.paper.figures import FIGURES

    return [folder / f"{name}.{suffix}" for name in FIGURES for suffix in ("png", "svg")] + [folder / TABLE_FILE]
