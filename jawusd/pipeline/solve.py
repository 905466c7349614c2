"""Solve the performance of a subject who has a rig, and write the result: `jawusd solve`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Literal, NotRequired, TypedDict, cast

import numpy as np
from numpy.typing import NDArray

import jawusd
from jawusd.base.errors import AnyPath, OutputError, RigError, TrackingError, explain_missing_packages, naming_file
from jawusd.evaluator import JawRig
from jawusd.evaluator.verdicts import is_inside
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding
from jawusd.formats.performance import Performance, SolveState, write_performance
from jawusd.formats.tracks import save_tracks
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.pictures import VIDEO, write_overlay
from jawusd.pipeline.segment_guide import combine_guide
from jawusd.pipeline.skin import SkinOptions
from jawusd.pipeline.solve_report import check_page, solve_limits, write_solve_report
from jawusd.pipeline.solve_skin import SkinOfFootage, SkinOfShot, skin_of_footage
from jawusd.pipeline.state import Progress, no_progress
from jawusd.pipeline.subject import load_labelled
from jawusd.pipeline.track import tracking_config
from jawusd.pipeline.videos import VideoOptions, solve_videos
from jawusd.pipeline.workspace import open_capture
from jawusd.rig import write_animation
from jawusd.rig.rebake import write_over
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.performance.results import tracks_of
from jawusd.tracking.performance.shot import solve_by_skin, solve_capture

SUFFIXES = (".csv", ".npz", ".usdc", ".usda")
_USD = (".usd", ".usda", ".usdc", ".usdz")


class SkinLearned(TypedDict):
    """What was learned from skin in the footage of a shot; see `fitting.skin.fit_skin`."""

    points: int  # number of points on the skin
    frames: int  # number of frames with visible teeth
    errors_mm: dict[str, float]


class SolveSummary(TypedDict):
    """Key figures of a solved performance; counts are numbers of frames."""

    frames: int
    solved: int
    carried: list[tuple[int, int]]  # runs of frames, as (first, last), in which an arch is occluded
    skin: list[tuple[int, int]]  # runs of frames in which d is estimated from facial skin
    lost: list[tuple[int, int]]  # runs of frames in which no pose fits the images
    within_tolerance: int  # number of frames outside the bound, but within the tolerance of measured poses
    outside: int  # number of frames outside the bound by more than the tolerance
    cameras: list[str]
    sigma_mm: dict[str, float]  # median standard deviation of d1, d2, d3 over solved frames, if any
    worst_sigma_mm: dict[str, float]  # maximum standard deviation over all frames
    limits: str  # what limits the accuracy, in words
    #: ratio of estimated to calibrated focal length, and its standard deviation, by camera
    focal: NotRequired[dict[str, tuple[float, float]]]
    skin_learned: NotRequired[SkinLearned]
    skin_offset_s: NotRequired[float]  # seconds from frame 0 of the shot to frame 0 of the face data
    unfamiliar: NotRequired[list[tuple[int, int]]]  # runs of `skin` with a face unlike those of the calibration
    findings: NotRequired[list[dict[str, str | float | int]]]


@explain_missing_packages()
def solve(
    rig: AnyPath,
    shot: Capture | AnyPath,
    out: AnyPath | None = None,
    *,
    prim: str | None = None,
    overlay: AnyPath | None = None,
    report: AnyPath | None = None,
    fixed_head: bool = False,
    free_focal: bool = False,
    jobs: int = 2,
    allow_outside: bool = False,
    skin: SkinOptions | Literal["footage"] | None = None,
    progress: Progress | None = None,
) -> Performance:
    """Solve for head pose and jaw parameters in every frame of a shot; optionally write them to a file.

    Args:
        rig: `actor.usda`, another layer of it, or `model.npz`.
        shot: the capture of the shot, its capture.toml or folder. Without any masks, the teeth are followed in the
            videos by their colours.
        out: file to write, a table of d (.csv), tracks (.npz), or an animation layer over the rig (.usdc, .usda).
        prim: path of the rig's prim, if a stage has several; an animation layer then targets the stage.
        overlay: video to write (.mp4), of the solved scans drawn over the images of all cameras side by side.
        report: page to write (.html), with d and its standard deviations, frames with a hidden arch, verdicts, findings
            and images.
        fixed_head: the cameras are head-mounted.
        free_focal: estimate the focal lengths; those of the calibration may then be wrong by up to 10 %.
        jobs: number of threads; the result does not depend on it.
        skin: facial skin data of the shot, which determine d in frames with hidden teeth. With them, the shot needs no
            images. "footage": points on the skin are followed in the videos of two or more cameras, and d is learned
            from them in the frames with visible teeth.

    Raises:
        FormatError, RigError: the rig or a skin file cannot be read.
        FittingError: the skin data do not belong to the rig or the shot, or the jaw cannot be learned from the footage.
        CaptureError, CalibrationError, SyncError: see `track`.
        TrackingError: the teeth cannot be found in the masks or the videos.
        OutputError: a file cannot be written.
    """
    check_output(rig, out, overlay, report)
    progress = progress or no_progress
    capture = open_capture(shot, allow_outside=allow_outside)
    jaw = jawusd.load(rig, prim=prim)
    by_skin = SkinOfShot(jaw, skin, capture.fps) if isinstance(skin, SkinOptions) else None
    learned: SkinOfFootage | None = None
    has_images = any(camera.masks or camera.video for camera in capture.cameras)
    if isinstance(skin, SkinOptions) and by_skin is not None and (skin.only or not has_images):
        if overlay is not None:
            raise OutputError("needs the head pose, which cannot be estimated from skin alone.", path=overlay)
        offsets: dict[str, int] = {}
        found, findings = _from_skin(capture, jaw, by_skin)
    else:
        offsets = sync_cameras(capture, progress)["offsets"]
        if skin == "footage":
            learned = skin_of_footage(capture, jaw, offsets, free_focal, progress)
        options = VideoOptions(fixed_head, free_focal, jobs, by_skin or learned)
        try:
            found, findings = _from_images(capture, jaw, offsets, options, progress)
        except TrackingError as error:
            if by_skin is not None:
                error.hint = f"{error.hint or ''} If no frame shows the teeth, use --skin-only.".strip()
            raise
    if by_skin is not None:
        found.notes |= {"skin_offset_s": by_skin.offset_s, "unfamiliar": by_skin.unfamiliar.tolist()}
    if learned is not None:
        found.notes["skin_learned"] = learned.summary()
    known = cast("list[dict[str, str | float | int]]", found.notes.get("findings", []))
    found.notes["findings"] = [*known, *(finding.as_json() for finding in findings)]
    if out is not None:
        write_solved(out, found, jaw, rig, capture.fps, prim)
    if overlay is not None:
        write_overlay(capture, offsets, tracks_of(found, jaw), Path(overlay), progress)
    if report is not None:
        write_solve_report(report, tracks_of(found, jaw), capture, offsets, progress)
    return found


def _from_images(
    capture: Capture, jaw: JawRig, offsets: dict[str, int], options: VideoOptions, progress: Progress
) -> tuple[Performance, list[Finding]]:
    """Return the performance solved from masks or images of the teeth, and findings about the scans."""
    with naming_file(capture.file):
        cameras = load_cameras(capture)
        meshes, findings = load_labelled(capture, jaw.meta)
        if not any(camera.masks for camera in capture.cameras):
            table = {camera.name: camera for camera in cameras}
            return solve_videos(capture, table, offsets, meshes, jaw, options, progress), findings
        found = solve_capture(
            capture,
            cameras,
            offsets,
            meshes["upper_teeth"],
            meshes["lower_teeth"],
            jaw,
            tracking_config(capture),
            fixed_head=options.fixed_head,
            free_focal=options.free_focal,
            skin=options.skin,
            threads=options.jobs,
            progress=partial(progress, "solve"),
        )
        findings += combine_guide(capture, tracks_of(found, jaw), jaw.landmarks)[1]
    return found, findings


def _from_skin(capture: Capture, jaw: JawRig, skin: SkinOfShot) -> tuple[Performance, list[Finding]]:
    """Return the performance estimated from facial skin alone, and findings about the scans."""
    with naming_file(capture.file):
        meshes, findings = load_labelled(capture, jaw.meta)
    scans = prepare_scan(meshes["upper_teeth"], "upper"), prepare_scan(meshes["lower_teeth"], "lower")
    frames = range(*capture.frames) if capture.frames else skin.frames()
    return solve_by_skin(jaw, scans, skin, frames, capture.fps), findings


@explain_missing_packages()
def write_solved(
    out: AnyPath, performance: Performance, jaw: JawRig, rig: AnyPath, fps: float, prim: str | None = None
) -> None:
    """Write a performance to a file whose suffix selects the format; see `solve`.

    Raises OutputError, and RigError if an animation layer of the rig cannot be written.
    """
    suffix = Path(out).suffix.lower()
    if suffix == ".csv":
        write_performance(out, performance, fps)
    elif suffix == ".npz":
        save_tracks(out, tracks_of(performance, jaw))
    else:
        frames, d, state = performance.frames, performance.d, performance.state
        unseen = frames[(state == SolveState.CARRIED) | (state == SolveState.LOST)]
        by_skin = frames[state == SolveState.SKIN]
        if prim is not None:
            write_over(out, rig, jaw, frames, d, fps, prim, unseen, by_skin)
        else:
            write_animation(out, rig, frames, d, fps, rig=jaw, carried=unseen, by_skin=by_skin)


def check_output(
    rig: AnyPath, out: AnyPath | None, overlay: AnyPath | None = None, report: AnyPath | None = None
) -> None:
    """Check, before any work, the suffixes of the output files: performance, overlay and report.

    Raises:
        OutputError, RigError: a suffix is not supported, or an animation layer lacks a USD rig.
        MissingDependencyError: packages that the report needs are not installed.
    """
    if report is not None:
        check_page(report)
    if overlay is not None and Path(overlay).suffix.lower() != VIDEO:
        raise OutputError("an overlay is a single video.", path=overlay, hint=f"Give a file name ending in {VIDEO}.")
    if out is None:
        return
    if Path(out).suffix.lower() in _USD and Path(rig).suffix.lower() not in _USD:
        raise RigError("is not a USD rig; an animation layer needs one.", path=rig, hint="Give the rig's actor.usda.")
    if Path(out).suffix.lower() not in SUFFIXES:
        raise OutputError(
            "has an unsupported suffix.", path=out, hint=f"Give a file name ending in one of {', '.join(SUFFIXES)}."
        )


def solve_summary(performance: Performance) -> SolveSummary:
    """Return the key figures of a performance."""
    p = performance
    solved = p.state == SolveState.SOLVED
    sigma = p.sigma_d
    typical = np.median(sigma[solved] if solved.any() else sigma, axis=0)
    by_skin = p.frames[p.state == SolveState.SKIN]
    median, largest = (
        {name: round(float(value), 4) for name, value in zip(("d1", "d2", "d3"), values, strict=True)}
        for values in (typical, sigma.max(axis=0))
    )
    summary = SolveSummary(
        frames=len(p.frames),
        solved=int(solved.sum()),
        carried=_runs(p.frames[p.state == SolveState.CARRIED]),
        skin=_runs(by_skin),
        lost=_runs(p.frames[p.state == SolveState.LOST]),
        within_tolerance=int((p.valid & ~is_inside(p.margin_mm)).sum()),
        outside=int((~p.valid).sum()),
        cameras=list(p.camera_names),
        sigma_mm=median,
        worst_sigma_mm=largest,
        limits=solve_limits(p.camera_names),
        findings=cast("list[dict[str, str | float | int]]", p.notes.get("findings", [])),
    )
    optional = ("focal", "skin_learned", "skin_offset_s")
    known: dict[str, object] = {name: p.notes[name] for name in optional if name in p.notes}
    if "unfamiliar" in p.notes:
        known["unfamiliar"] = _runs(np.intersect1d(by_skin, cast("list[int]", p.notes["unfamiliar"])))
    return cast(SolveSummary, {**summary, **known})  # the values of notes are untyped JSON


def _runs(frames: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return the first and the last frame of each run of consecutive frames (F,)."""
    runs = np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1)
    return [(int(run[0]), int(run[-1])) for run in runs if len(run)]
