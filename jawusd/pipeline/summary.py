"""The figures of a build, as data and as lines for people."""

from __future__ import annotations

import numpy as np

from jawusd.errors import TrackingError
from jawusd.formats.model import JawModel
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, LostReason, Tracks, TrackStatus
from jawusd.geometry import LANDMARKS
from jawusd.pipeline.calibration import calibration_lines
from jawusd.pipeline.segment_summary import segment_lines

_LISTED_FRAMES = 20


def track_summary(tracks: Tracks) -> dict:
    """Return what a person should know of tracks: counts, uncertainty at the landmarks, coverage error."""
    worst = tracks.status.min(1)
    lost = tracks.frames[worst == LOST]
    tracked = tracks.tracked()
    sigma = np.median(tracks.sigma_mm[tracked], axis=0) if tracked.any() else np.full(len(LANDMARKS), np.nan)
    coverage = tracks.coverage_error
    return {
        "frames": len(tracks.frames),
        "tracked": int(tracked.sum()),
        "lost": [int(frame) for frame in lost],
        "lost_reasons": lost_reasons(tracks),
        "recovered": int((tracks.status == RECOVERED).any(1).sum()),
        "without_a_camera": int((tracks.status == PARTIAL).any(1).sum()),
        "prior_aided": int(tracks.prior_aided.sum()),
        "calibration_rescaled_px": tracks.meta.get("calibration_rescaled_px", {}),
        "sigma_mm": {name: _rounded(value) for name, value in zip(LANDMARKS, sigma, strict=True)},
        "coverage_error_percent": _rounded(100 * np.nanmean(coverage)) if np.isfinite(coverage).any() else None,
    }


def lost_reasons(tracks: Tracks) -> dict[str, dict[str, int]]:
    """Return how many frames each arch lost for each recorded reason."""
    out = {}
    for arch, name in enumerate(("upper", "lower")):
        reasons = tracks.lost_reason[tracks.status[:, arch] == LOST, arch]
        out[name] = {str(LostReason(code)): int((reasons == code).sum()) for code in np.unique(reasons) if code}
    return {name: counts for name, counts in out.items() if counts}


def frame_summary(tracks: Tracks, frame: int) -> dict:
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
    arches = {}
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


def frame_lines(summary: dict) -> list[str]:
    """Return `frame_summary` as text."""
    lines = []
    for name, arch in summary["arches"].items():
        line = f"frame {summary['frame']}, {name} arch: {arch['status']}"
        if "explanation" in arch:
            line += (
                f": {arch['explanation']}" if arch["status"] == "lost" else f"; the masks alone: {arch['explanation']}"
            )
        if arch["masks_left_out"]:
            line += f"; mask left out: {', '.join(arch['masks_left_out'])}"
        lines.append(line)
    if summary["prior_aided"]:
        lines.append("the jaw model helped to find these poses")
    return lines


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def track_lines(summary: dict) -> list[str]:
    """Return `track_summary` as text.

    Args:
        summary: what it returned.
    """
    lost = summary["lost"]
    lines = [f"tracked {summary['tracked']} of {summary['frames']} frames"]
    if lost:
        more = "" if len(lost) <= _LISTED_FRAMES else f" and {len(lost) - _LISTED_FRAMES} more"
        lines.append(f"  lost: {', '.join(map(str, lost[:_LISTED_FRAMES]))}{more}")
    for name, counts in summary["lost_reasons"].items():
        lines.append(f"  {name} arch lost by: " + ", ".join(f"{reason} {count}" for reason, count in counts.items()))
    lines.append(f"  recovered {summary['recovered']}, without one of the cameras {summary['without_a_camera']}")
    for name, (was, now) in summary["calibration_rescaled_px"].items():
        lines.append(
            f"  {name} is calibrated at {was[0]} x {was[1]} px and recorded at {now[0]} x {now[1]}: taken as the same "
            "picture, scaled"
        )
    if summary["prior_aided"]:
        lines.append(f"  {summary['prior_aided']} uncertain frames tracked again with the fitted model's help")
    known = {name: value for name, value in summary["sigma_mm"].items() if value is not None}
    sigma = ", ".join(f"{name} {value}" for name, value in known.items()) or "not known"
    lines.append(f"  expected error (1 sigma, median) [mm]: {sigma}")
    lines.append(f"  mask left uncovered: {summary['coverage_error_percent']} %")
    return lines


def fit_summary(model: JawModel) -> dict:
    """Return what a person should know of a model: its errors, ranges and warnings."""
    keys = ("method", "kind", "errors", "ranges_mm", "warnings", "inferred", "trimmed_frames")
    return {key: model.meta[key] for key in keys if key in model.meta}


def fit_lines(summary: dict) -> list[str]:
    """Return `fit_summary` as text.

    Args:
        summary: what it returned.
    """
    lines = [f"model: {summary.get('method')}; largest distance per pose [mm]:  mean  median     p95     max"]
    for table, rows in summary.get("errors", {}).items():
        for place, figures in rows.items():
            values = "".join(f"{figures[key]:8.3f}" for key in ("mean", "median", "p95", "max"))
            lines.append(f"  {table:<8} {place:<28}{values}")
    if summary.get("trimmed_frames"):
        lines.append(f"  frames left out as outliers: {', '.join(map(str, summary['trimmed_frames']))}")
    return lines + [f"  warning: {warning['message']}" for warning in summary.get("warnings", [])]


def build_lines(summary: dict) -> list[str]:
    """Return the summary of a build as text."""
    offsets = ", ".join(f"{name} {offset:+d}" for name, offset in summary["sync"]["offsets"].items())
    lines = []
    if summary["calibrate"]:
        lines += [
            "the capture names no calibration: made one from its boards",
            *calibration_lines(summary["calibrate"]),
        ]
    lines += [f"sync ({summary['sync']['method']}): {offsets} frames"]
    lines += [f"  note: {note}" for note in summary["sync"].get("notes", [])]
    if summary["segment"]:
        lines += ["the capture names no masks: made them from its videos", *segment_lines(summary["segment"])]
    lines += track_lines(summary["track"])
    lines += fit_lines(summary["fit"])
    seconds = ", ".join(
        f"{name} {'kept' if name in summary['reused'] else f'{value:.1f} s'}"
        for name, value in summary["seconds"].items()
    )
    report = summary["report"]
    shown = f"{summary['folder']}/{report['file']}" if "file" in report else f"none: {report['missing']}"
    return [*lines, f"time: {seconds}", f"rig: {summary['folder']}/actor.usda", f"report: {shown}"]
