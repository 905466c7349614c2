"""Solve the performance of a subject who has a rig, and write the result: `jawusd solve`."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NotRequired, TypedDict, cast

import numpy as np

import jawusd
from jawusd.base.errors import OutputError, RigError, explain_missing_packages, naming_file
from jawusd.evaluator import JawRig
from jawusd.evaluator.verdicts import is_inside
from jawusd.formats.capture import Capture
from jawusd.formats.performance import Performance, SolveState, write_performance
from jawusd.formats.tracks import save_tracks
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.capture_inputs import open_capture
from jawusd.pipeline.pictures import VIDEO, write_overlay
from jawusd.pipeline.segment_guide import combine_guide
from jawusd.pipeline.solve_report import check_page, solve_limits, write_solve_report
from jawusd.pipeline.solve_videos import VideoOptions, solve_videos
from jawusd.pipeline.state import Progress, no_progress
from jawusd.pipeline.subject import load_labelled, registered_meshes
from jawusd.pipeline.track import tracking_config

if TYPE_CHECKING:
    pass


SUFFIXES = (".csv", ".npz", ".usdc", ".usda")
_USD = (".usd", ".usda", ".usdc", ".usdz")


class SolveSummary(TypedDict):
    """Key figures of a solved performance; counts are numbers of frames."""

    frames: int
    solved: int
    carried: list[tuple[int, int]]  # runs of frames, as (first, last), in which an arch is occluded
    lost: list[tuple[int, int]]  # runs of frames, as (first, last), in which no pose fits the images
    within_tolerance: int  # number of frames outside the bound, but within the tolerance of measured poses
    outside: int  # number of frames outside the bound by more than the tolerance
    cameras: list[str]
    sigma_mm: dict[str, float]  # median standard deviation of d1, d2, d3 over solved frames
    worst_sigma_mm: dict[str, float]  # maximum standard deviation over all frames
    limits: str  # what limits the accuracy, in words
    focal: NotRequired[
        dict[str, tuple[float, float]]
    ]  # ratio of estimated to calibrated focal length, and its standard deviation, by camera
    findings: NotRequired[list[dict[str, str | float | int]]]


@explain_missing_packages()
def solve(
    rig: str | os.PathLike[str],
    shot: Capture | str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    prim: str | None = None,
    overlay: str | os.PathLike[str] | None = None,
    report: str | os.PathLike[str] | None = None,
    fixed_head: bool = False,
    free_focal: bool = False,
    jobs: int = 2,
    allow_outside: bool = False,
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
        allow_outside: allow paths in the capture that point outside its folder.

    Raises:
        FormatError, RigError: the rig cannot be read.
        CaptureError, CalibrationError, SyncError: see `track`.
        TrackingError: the teeth cannot be found in the masks or the videos.
        OutputError: a file cannot be written.
    """
    from jawusd.tracking.performance.results import tracks_of
    from jawusd.tracking.performance.shot import solve_capture

    check_output(rig, out, overlay, report)
    progress = progress or no_progress
    capture = open_capture(shot, allow_outside=allow_outside)
    jaw = jawusd.load(rig, prim=prim)
    offsets = sync_cameras(capture, progress)["offsets"]
    with naming_file(capture.folder / "capture.toml"):
        cameras = load_cameras(capture)
        meshes, findings = load_labelled(capture)
        meshes = registered_meshes(meshes, jaw.meta)
        if any(camera.masks for camera in capture.cameras):
            solving = partial(progress, "solve")
            teeth = meshes["upper_teeth"], meshes["lower_teeth"]
            found = solve_capture(
                capture,
                cameras,
                offsets,
                *teeth,
                jaw,
                tracking_config(capture),
                fixed_head=fixed_head,
                free_focal=free_focal,
                threads=jobs,
                progress=solving,
            )
            findings += combine_guide(capture, tracks_of(found, jaw), jaw.landmarks)[1]
        else:
            table = {camera.name: camera for camera in cameras}
            options = VideoOptions(fixed_head, free_focal, jobs)
            found = solve_videos(capture, table, offsets, meshes, jaw, options, progress)
    known = cast("list[dict[str, str | float | int]]", found.notes.get("findings", []))
    found.notes["findings"] = [*known, *(finding.as_json() for finding in findings)]
    if out is not None:
        write_solved(out, found, jaw, rig, capture.fps, prim)
    if overlay is not None:
        write_overlay(capture, offsets, tracks_of(found, jaw), Path(overlay), progress)
    if report is not None:
        write_solve_report(report, tracks_of(found, jaw), capture, offsets, progress)
    return found


@explain_missing_packages()
def write_solved(
    out: str | os.PathLike[str],
    performance: Performance,
    jaw: JawRig,
    rig: str | os.PathLike[str],
    fps: float,
    prim: str | None = None,
) -> None:
    """Write a performance to a file whose suffix selects the format; see `solve`.

    Raises:
        OutputError: the file cannot be written.
        RigError: an animation layer of the rig cannot be written.
    """
    suffix = Path(out).suffix.lower()
    if suffix == ".csv":
        write_performance(out, performance, fps)
    elif suffix == ".npz":
        from jawusd.tracking.performance.results import tracks_of

        save_tracks(out, tracks_of(performance, jaw))
    else:
        from jawusd.rig import write_animation
        from jawusd.rig.rebake import write_over

        unseen = performance.frames[performance.state != SolveState.SOLVED]
        if prim is not None:
            write_over(out, rig, jaw, performance.frames, performance.d, fps, prim, unseen)
        else:
            write_animation(out, rig, performance.frames, performance.d, fps, rig=jaw, carried=unseen)


def check_output(
    rig: str | os.PathLike[str],
    out: str | os.PathLike[str] | None,
    overlay: str | os.PathLike[str] | None = None,
    report: str | os.PathLike[str] | None = None,
) -> None:
    """Check, before any work, the suffixes of the output files: performance, overlay and report.

    Raises:
        OutputError: a suffix is not supported.
        RigError: an animation layer needs a USD rig.
        MissingDependencyError: packages that the report needs are not installed.
    """
    if report is not None:
        check_page(report)
    if overlay is not None and Path(overlay).suffix.lower() != VIDEO:
        raise OutputError("an overlay is a single video.", path=overlay, hint=f"Name a file ending in {VIDEO}.")
    if out is None:
        return
    if Path(out).suffix.lower() in _USD and Path(rig).suffix.lower() not in _USD:
        raise RigError("is not a USD rig; an animation layer needs one.", path=rig, hint="Name the rig's actor.usda.")
    if Path(out).suffix.lower() not in SUFFIXES:
        raise OutputError("has an unsupported suffix.", path=out, hint=f"Name a file ending in {', '.join(SUFFIXES)}.")


def solve_summary(performance: Performance) -> SolveSummary:
    """Return the key figures of a performance."""
    p = performance
    solved = p.state == SolveState.SOLVED
    sigma = p.sigma_d
    typical = np.median(sigma[solved], axis=0) if solved.any() else np.full(3, np.nan)
    names = ("d1", "d2", "d3")
    summary = SolveSummary(
        frames=len(p.frames),
        solved=int(solved.sum()),
        carried=_runs(p, SolveState.CARRIED),
        lost=_runs(p, SolveState.LOST),
        within_tolerance=int((p.valid & ~is_inside(p.margin_mm)).sum()),
        outside=int((~p.valid).sum()),
        cameras=list(p.camera_names),
        sigma_mm={name: round(float(value), 4) for name, value in zip(names, typical, strict=True)},
        worst_sigma_mm={name: round(float(value), 4) for name, value in zip(names, sigma.max(0), strict=True)},
        limits=solve_limits(p.camera_names),
        findings=cast("list[dict[str, str | float | int]]", p.notes.get("findings", [])),
    )
    if "focal" in p.notes:
        summary["focal"] = cast("dict[str, tuple[float, float]]", p.notes["focal"])
    return summary


def _runs(p: Performance, state: SolveState) -> list[tuple[int, int]]:
    """Return the first and the last frame of each run of frames in a given state."""
    runs: list[tuple[int, int]] = []
    for frame in p.frames[p.state == state].tolist():
        if runs and runs[-1][1] == frame - 1:
            runs[-1] = (runs[-1][0], frame)
        else:
            runs.append((frame, frame))
    return runs
