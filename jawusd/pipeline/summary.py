"""The figures of a build, as data and as lines for people."""

from __future__ import annotations

import numpy as np

from jawusd.formats.model import JawModel
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, Tracks
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
        "recovered": int((tracks.status == RECOVERED).any(1).sum()),
        "without_a_camera": int((tracks.status == PARTIAL).any(1).sum()),
        "prior_aided": int(tracks.prior_aided.sum()),
        "calibration_rescaled_px": tracks.meta.get("calibration_rescaled_px", {}),
        "sigma_mm": {name: _rounded(value) for name, value in zip(LANDMARKS, sigma, strict=True)},
        "coverage_error_percent": _rounded(100 * np.nanmean(coverage)) if np.isfinite(coverage).any() else None,
    }


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
