"""Track the teeth of a capture, track them again with the fitted model as a prior, and summarise tracks."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NotRequired, cast

import numpy as np
from typing_extensions import TypedDict

from jawusd.base.errors import AnyPath, TrackingError, explain_missing_packages, naming_file
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture
from jawusd.formats.model import JawModel
from jawusd.formats.notes import TakeNotes
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, LostReason, Tracks, TrackStatus, save_tracks, used_coverage
from jawusd.geometry import LANDMARKS
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import load_cameras, rescaled_cameras
from jawusd.pipeline.pictures import write_overlay
from jawusd.pipeline.segment_record import auto_masks_folder
from jawusd.pipeline.state import Progress, no_progress
from jawusd.pipeline.subject import load_labelled, load_meshes, subject_of_capture
from jawusd.pipeline.workspace import open_capture

if TYPE_CHECKING:
    from jawusd.tracking import TrackingConfig


class TrackSummary(TakeNotes):
    """Key figures of tracks; counts are numbers of frames."""

    frames: int
    tracked: int
    lost: list[int]  # numbers of the lost frames
    lost_reasons: NotRequired[dict[str, dict[str, int]]]  # number of frames lost for each reason, by arch
    recovered: int
    without_a_camera: int
    prior_aided: int
    sigma_mm: dict[str, float | None]  # median standard deviation of each landmark's position; None if unknown
    coverage_error_percent: float | None  # mean fraction of the used masks not covered by the scans; None without masks
    frames_used: NotRequired[dict[str, int]]  # number of frames in which a camera was used, by camera


class ArchSummary(TypedDict):
    """How one arch was tracked in a frame; for a lost arch, also the quantity that failed its check, and the limit."""

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
    """How one frame was tracked."""

    frame: int
    prior_aided: bool
    arches: dict[str, ArchSummary]


def track(
    capture: Capture | AnyPath,
    out: AnyPath | None = None,
    *,
    solver: str = "contour",
    backend: str = "cpu",
    model: JawModel | None = None,
    overlay: AnyPath | None = None,
    jobs: int = 2,
    allow_outside: bool = False,
    progress: Progress | None = None,
) -> Tracks:
    """Track both arches of a capture, in its masks or, without masks, in its videos; optionally write the tracks.

    Args:
        capture: the capture, its capture.toml or its folder.
        out: `tracks.npz` to write.
        solver: "contour", or "paper" for the paper's method, for comparison.
        backend: renderer of the paper's method, "cpu" or "gl".
        model: jaw model of this subject, used as a prior when uncertain frames are tracked again.
        overlay: folder or .mp4 file to write, with videos of the tracked scans over the footage; see `write_overlay`.
        jobs: number of threads; the result does not depend on it.

    Raises:
        FormatError, CaptureError: the capture, or one of its masks or videos, cannot be read.
        SyncError: the cameras cannot be aligned in time.
        TrackingError: the teeth are not found.
        OutputError: a file cannot be written.
        MissingDependencyError: the extra `build` is not installed, or the GL backend finds no OpenGL.
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
    """Track both arches without a jaw model; parameters and errors are as for `track`."""
    from jawusd.pipeline.segment_guide import combine_guide
    from jawusd.pipeline.videos import track_videos
    from jawusd.tracking import track_capture
    from jawusd.tracking.region.jaw_priors import widen_strained

    with naming_file(capture.file):
        cameras, (meshes, findings) = load_cameras(capture), load_labelled(capture)
        given = capture, cameras, offsets, meshes["upper_teeth"], meshes["lower_teeth"]
        report = partial(progress, "track")
        if solver == "paper":
            from jawusd.paper.take import track_capture_paper  # needs torch, which takes seconds to import

            renderer: Literal["cpu", "gl"] = "gl" if backend == "gl" else "cpu"
            tracks = track_capture_paper(*given, backend=renderer, threads=jobs, progress=report)
        elif not any(camera.masks for camera in capture.cameras):
            tracks = track_videos(capture, offsets, meshes, jobs, progress)
        else:
            subject, config = subject_of_capture(capture, meshes), tracking_config(capture)
            landmarks = subject.landmarks
            tracks = track_capture(*given, landmarks, config, threads=jobs, progress=report)
            tracks, disagreements = combine_guide(capture, tracks, landmarks)
            if auto_masks_folder(capture) is not None:
                tracks = widen_strained(tracks, landmarks, subject.T_anatomical_skull[:3, :3])
            findings = [*findings, *disagreements]
    tracks.meta["findings"] = [*tracks.meta.get("findings", []), *(finding.as_json() for finding in findings)]
    rescaled = rescaled_cameras(capture)
    tracks.meta["calibration_rescaled_px"] = {name: [list(was), list(now)] for name, (was, now) in rescaled.items()}
    return tracks


@explain_missing_packages()
def model_pass(
    capture: Capture, offsets: dict[str, int], tracks: Tracks, model: JawModel, jobs: int, progress: Progress
) -> Tracks:
    """Track uncertain frames again with the fitted model as a prior.

    Captures without masks are not tracked again; their poses are combined with the model. For errors, see `track`.
    """
    from jawusd.tracking.sequence.model_refinement import refine_tracks, weigh_with_model

    jaw = JawRig(model.arrays, model.meta)
    if not any(camera.masks for camera in capture.cameras):
        return weigh_with_model(tracks, jaw)
    with naming_file(capture.file):
        meshes = load_meshes(capture, tracks.meta)
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
    """Return the tracker configuration for drawn or automatic masks."""
    from jawusd.tracking.config import FOR_AUTO_MASKS, FOR_TAKES

    return FOR_TAKES if auto_masks_folder(capture) is None else FOR_AUTO_MASKS


def track_summary(tracks: Tracks) -> TrackSummary:
    """Return the key figures of tracks: frame counts, uncertainty at the landmarks, and coverage error."""
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
    """Return the number of lost frames by arch and recorded reason."""
    out = {}
    for arch, name in enumerate(("upper", "lower")):
        reasons = tracks.lost_reason[tracks.status[:, arch] == LOST, arch]
        out[name] = {str(LostReason(code)): int((reasons == code).sum()) for code in np.unique(reasons) if code}
    return {name: counts for name, counts in out.items() if counts}


def frame_summary(tracks: Tracks, frame: int) -> FrameTrackSummary:
    """Return how one frame was tracked; raises TrackingError if the tracks do not contain it."""
    if frame not in tracks.frames:
        message = f"the tracks do not contain this frame; they run from {tracks.frames[0]} to {tracks.frames[-1]}"
        raise TrackingError(message, frame=frame)
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


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
