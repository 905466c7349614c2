"""Track the teeth of a capture: the first pass, the pass with the fitted model as a prior, and what to say of both."""

from __future__ import annotations

import math
import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NotRequired, cast

import numpy as np
from typing_extensions import TypedDict

from jawusd.base.errors import TrackingError, explain_missing_packages, naming_file
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding
from jawusd.formats.model import JawModel
from jawusd.formats.notes import TakeNotes
from jawusd.formats.tracks import (
    LOST,
    PARTIAL,
    RECOVERED,
    LostReason,
    Tracks,
    TrackStatus,
    save_tracks,
    used_coverage,
)
from jawusd.geometry import LANDMARKS
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import load_cameras, rescaled_cameras
from jawusd.pipeline.capture_inputs import open_capture
from jawusd.pipeline.meshes import load_labelled, load_meshes, registered_meshes
from jawusd.pipeline.overlay import write_overlay
from jawusd.pipeline.segment_guide import take_up_guide
from jawusd.pipeline.segment_record import auto_masks_folder
from jawusd.pipeline.state import Progress, no_progress
from jawusd.pipeline.subject import subject_of_capture
from jawusd.pipeline.track_pictures import track_videos

if TYPE_CHECKING:
    from jawusd.tracking import TrackingConfig

_LISTED_FRAMES = 20


class TrackSummary(TakeNotes):
    """Hold what a person should know of tracks; numbers of frames, unless the name says otherwise."""

    frames: int
    tracked: int
    lost: list[int]  # frame numbers
    lost_reasons: NotRequired[dict[str, dict[str, int]]]  # frames lost for each reason, by arch
    recovered: int
    without_a_camera: int
    prior_aided: int
    sigma_mm: dict[str, float | None]  # median standard deviation of the landmarks, None if not known
    coverage_error_percent: float | None  # share of the masks used that is left uncovered, None without any
    frames_used: NotRequired[dict[str, int]]  # frames that a camera took part in, by camera


class ArchSummary(TypedDict):
    """Hold how one arch was tracked in a frame; cameras by name, and of a lost arch the figure found and its limit."""

    status: str
    masks_used: list[str]
    masks_left_out: list[str]
    matched_px: float | None
    residual_px: float | None
    lost_reason: NotRequired[str]
    lost_value: NotRequired[float | None]
    lost_limit: NotRequired[float | None]
    explanation: NotRequired[str]


class FrameTrackSummary(TypedDict):
    """Hold how one frame was tracked."""

    frame: int
    prior_aided: bool
    arches: dict[str, ArchSummary]


def track(
    capture: Capture | str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    solver: str = "contour",
    backend: str = "cpu",
    model: JawModel | None = None,
    overlay: str | os.PathLike[str] | None = None,
    jobs: int = 2,
    allow_outside: bool = False,
    progress: Progress | None = None,
) -> Tracks:
    """Track both arches of a capture through its masks, and write the tracks if a file is named.

    Args:
        capture: the capture, its capture.toml or the folder that holds it.
        out: `tracks.npz` to write.
        solver: "contour", or "paper" for the paper's own method, to compare with.
        backend: where the paper's method draws, "cpu" or "gl".
        model: jaw model of this person: uncertain frames are tracked again with it as a prior.
        overlay: folder, or .mp4 file, for videos with the tracked scans over the footage; see `overlay.write_overlay`.
        jobs: threads of the tracker; the result does not depend on it.
        allow_outside: let paths in the capture leave its folder.

    Raises:
        FormatError, CaptureError: the capture cannot be read, or a mask or video in it.
        SyncError: the cameras cannot be aligned in time.
        TrackingError: the teeth cannot be found in the masks.
        OutputError: a file cannot be written.
        MissingDependencyError: the extra `build` is not installed, or there is no OpenGL for the GL backend.
    """
    progress = progress or no_progress
    capture = open_capture(capture, allow_outside=allow_outside)
    offsets = sync_cameras(capture, progress)["offsets"]
    tracks = first_pass(capture, offsets, jobs, progress, solver, backend)
    if model is not None:
        tracks = model_pass(capture, offsets, tracks, model, jobs, progress)
    if out is not None:
        save_tracks(out, tracks)
    if overlay is not None:
        write_overlay(capture, offsets, tracks, Path(overlay), progress)
    return tracks


@explain_missing_packages()
def first_pass(
    capture: Capture,
    offsets: dict[str, int],
    jobs: int,
    progress: Progress,
    solver: str = "contour",
    backend: str = "cpu",
) -> Tracks:
    """Track both arches without a jaw model; parameters and errors as `track`.

    Args:
        offsets: frame offset by camera.
    """
    from jawusd.paper.take import track_capture_paper
    from jawusd.tracking import track_capture
    from jawusd.tracking.region.condyle_fusion import widen_strained

    with naming_file(capture.folder / "capture.toml"):
        cameras, (meshes, findings) = load_cameras(capture), load_labelled(capture)
        upper, lower = meshes["upper_teeth"], meshes["lower_teeth"]
        report = partial(progress, "track")
        if solver == "paper":
            tracks = track_capture_paper(
                capture,
                cameras,
                offsets,
                upper,
                lower,
                backend="gl" if backend == "gl" else "cpu",
                threads=jobs,
                progress=report,
            )
        elif not any(camera.masks for camera in capture.cameras):
            tracks = track_videos(capture, offsets, meshes, jobs, progress)
        else:
            subject = subject_of_capture(capture, meshes)
            landmarks = subject.landmarks
            config = tracking_config(capture)
            tracks = track_capture(
                capture, cameras, offsets, upper, lower, landmarks, config, threads=jobs, progress=report
            )
            tracks, doubts = take_up_guide(capture, tracks, landmarks)
            if auto_masks_folder(capture) is not None:
                tracks = widen_strained(tracks, landmarks, subject.T_anatomical_skull[:3, :3])
            findings = [*findings, *doubts]
    tracks.meta["findings"] = [*tracks.meta.get("findings", []), *(finding.as_json() for finding in findings)]
    rescaled = rescaled_cameras(capture)
    tracks.meta["calibration_rescaled_px"] = {name: [list(was), list(now)] for name, (was, now) in rescaled.items()}
    return tracks


@explain_missing_packages()
def model_pass(
    capture: Capture, offsets: dict[str, int], tracks: Tracks, model: JawModel, jobs: int, progress: Progress
) -> Tracks:
    """Track uncertain frames again with the fitted model as a prior, or weigh poses of colours with it.

    Parameters and errors as `track`.

    Args:
        offsets: frame offset by camera.
        tracks: the first pass.
    """
    from jawusd.tracking.sequence.kinematic_prior import weigh_with_model
    from jawusd.tracking.sequence.model_refinement import refine_tracks

    jaw = JawRig(model.arrays, model.meta)
    if not any(camera.masks for camera in capture.cameras):
        return weigh_with_model(tracks, jaw)
    with naming_file(capture.folder / "capture.toml"):
        meshes = registered_meshes(load_meshes(capture), tracks.meta)
        return refine_tracks(
            tracks,
            jaw,
            capture,
            load_cameras(capture),
            offsets,
            meshes["upper_teeth"],
            meshes["lower_teeth"],
            tracking_config(capture),
            threads=jobs,
            progress=partial(progress, "refine"),
        )


def tracking_config(capture: Capture) -> TrackingConfig:
    """Return the tracker's numbers for the masks of a capture."""
    from jawusd.tracking.config import FOR_AUTO_MASKS, FOR_TAKES

    return FOR_TAKES if auto_masks_folder(capture) is None else FOR_AUTO_MASKS


def track_summary(tracks: Tracks) -> TrackSummary:
    """Sum up tracks: counts, uncertainty at the landmarks, coverage error."""
    lost = tracks.frames[tracks.status.min(1) == LOST]
    tracked = tracks.tracked()
    sigma = np.median(tracks.sigma_mm[tracked], axis=0) if tracked.any() else np.full(len(LANDMARKS), np.nan)
    coverage = used_coverage(tracks)
    coverage = coverage[np.isfinite(coverage)]
    counted = TrackSummary(
        frames=len(tracks.frames),
        tracked=int(tracked.sum()),
        lost=[int(frame) for frame in lost],
        lost_reasons=lost_reasons(tracks),
        recovered=int((tracks.status == RECOVERED).any(1).sum()),
        without_a_camera=int((tracks.status == PARTIAL).any(1).sum()),
        prior_aided=int(tracks.prior_aided.sum()),
        sigma_mm={name: _rounded(value) for name, value in zip(LANDMARKS, sigma.tolist(), strict=True)},
        coverage_error_percent=_rounded(100 * float(coverage.mean())) if coverage.size else None,
        frames_used=dict(zip(tracks.camera_names, tracks.masks_used.any(1).sum(0).tolist(), strict=True)),
    )
    notes = {name: value for name, value in tracks.meta.items() if name in TakeNotes.__annotations__}
    return cast(TrackSummary, {"calibration_rescaled_px": {}, "findings": [], **notes, **counted})


def lost_reasons(tracks: Tracks) -> dict[str, dict[str, int]]:
    """Return how many frames each arch lost for each recorded reason."""
    out = {}
    for arch, name in enumerate(("upper", "lower")):
        reasons = tracks.lost_reason[tracks.status[:, arch] == LOST, arch]
        out[name] = {str(LostReason(code)): int((reasons == code).sum()) for code in np.unique(reasons) if code}
    return {name: counts for name, counts in out.items() if counts}


def frame_summary(tracks: Tracks, frame: int) -> FrameTrackSummary:
    """Return what is known about the tracking of one frame; of lost arches the reason.

    Raises:
        TrackingError: the tracks do not hold the frame.
    """
    if frame not in tracks.frames:
        raise TrackingError(
            f"the tracks do not hold it; they go from {tracks.frames[0]} to {tracks.frames[-1]}",
            frame=frame,
        )
    k = int(np.searchsorted(tracks.frames, frame))
    cameras = np.array(tracks.camera_names)
    arches: dict[str, ArchSummary] = {}
    for arch, name in enumerate(("upper", "lower")):
        status = TrackStatus(int(tracks.status[k, arch]))
        used, masked = tracks.masks_used[k, arch], np.isfinite(tracks.coverage_error[k, arch])
        arches[name] = {
            "status": str(status),
            "masks_used": cameras[used].tolist(),
            "masks_left_out": cameras[masked & ~used].tolist(),
            "matched_px": _rounded(tracks.matched_px[k, arch]),
            "residual_px": _rounded(tracks.residual_px[k, arch]),
        }
        if status == TrackStatus.LOST or tracks.lost_reason[k, arch]:
            arches[name] |= {
                "lost_reason": str(LostReason(int(tracks.lost_reason[k, arch]))),
                "lost_value": _rounded(tracks.lost_value[k, arch]),
                "lost_limit": _rounded(tracks.lost_limit[k, arch]),
                "explanation": tracks.explain_loss(k, arch),
            }
    return {"frame": frame, "prior_aided": bool(tracks.prior_aided[k]), "arches": arches}


def frame_lines(summary: FrameTrackSummary) -> list[str]:
    """Return `frame_summary` as text."""
    lines = []
    for name, arch in summary["arches"].items():
        line = f"frame {summary['frame']}, {name} arch: {arch['status']}"
        if "explanation" in arch:
            start = ": " if arch["status"] == "lost" else "; the masks alone: "
            line += start + arch["explanation"]
        if arch["masks_left_out"]:
            line += f"; mask left out: {', '.join(arch['masks_left_out'])}"
        lines.append(line)
    if summary["prior_aided"]:
        lines.append("the jaw model helped to find these poses")
    return lines


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def track_lines(summary: TrackSummary) -> list[str]:
    """Return `track_summary` as text."""
    lost = summary["lost"]
    lines = [f"tracked {summary['tracked']} of {summary['frames']} frames"]
    if lost:
        more = "" if len(lost) <= _LISTED_FRAMES else f" and {len(lost) - _LISTED_FRAMES} more"
        lines.append(f"  lost: {', '.join(map(str, lost[:_LISTED_FRAMES]))}{more}")
    for name, counts in summary.get("lost_reasons", {}).items():
        lines.append(f"  {name} arch lost by: " + ", ".join(f"{reason} {count}" for reason, count in counts.items()))
    lines.append(f"  recovered {summary['recovered']}, without one of the cameras {summary['without_a_camera']}")
    for name, (was, now) in summary["calibration_rescaled_px"].items():
        lines.append(
            f"  {name} is calibrated at {was[0]} x {was[1]} px and recorded at {now[0]} x {now[1]}: taken as the same "
            "picture, scaled"
        )
    if summary["prior_aided"]:
        lines.append(f"  {summary['prior_aided']} uncertain frames tracked again with the fitted model's help")
    if "prior_spread_mm" in summary:
        lines.append(f"  final poses weighed with the fitted model, {summary['prior_spread_mm']:.2f} mm from it (rms)")
    known = {name: value for name, value in summary["sigma_mm"].items() if value is not None}
    sigma = ", ".join(f"{name} {value}" for name, value in known.items()) or "not known"
    lines.append(f"  expected error (1 sigma, median) [mm]: {sigma}")
    uncovered = summary["coverage_error_percent"]
    if uncovered is not None:
        lines.append(f"  mask left uncovered: {uncovered} %")
    if "frames_used" in summary:
        used = ", ".join(f"{name} {count}" for name, count in summary["frames_used"].items())
        lines.append(f"  frames that cameras took part in: {used}")
    lines += _take_lines(summary)
    return [*lines, *(f"  {Finding.from_json(found).line()}" for found in summary.get("findings", []))]


def _take_lines(summary: TrackSummary) -> list[str]:
    """Return what was estimated from all frames together: where outlines lie, and the scans' registration."""
    lines = []
    reaches = (("free edges", summary.get("outline_bias_px")), ("gum line", summary.get("gum_bias_px")))
    for what, found in reaches:
        if found is not None:
            reach = ", ".join(f"{name} {upper:+.2f} {lower:+.2f}" for name, (upper, lower) in found.items())
            lines.append(f"  outlines reach beyond the {what}, upper and lower arch [px]: {reach}")
    if "gum_line_mm" in summary:
        upper, lower = summary["gum_line_mm"]
        lines.append(
            f"  gum line drawn towards the gum, along the surface [mm]: upper {upper:+.2f}, lower {lower:+.2f}"
        )
    if "registration" in summary:
        bite = summary["registration"]
        shift, turn = math.hypot(*bite["shift_mm"]), math.hypot(*bite["turn_deg"])
        sigmas = math.hypot(*bite["shift_sigma_mm"]), math.hypot(*bite["turn_sigma_deg"])
        what = "lower scan moved to the closed bite by" if bite["applied"] else "lower scan off the closed bite by"
        lines.append(f"  {what} {shift:.2f} +- {sigmas[0]:.2f} mm, {turn:.2f} +- {sigmas[1]:.2f} degrees")
    return lines
