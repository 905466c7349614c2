"""Check, track and score one synthetic person's capture; used by population.py."""

from __future__ import annotations

import importlib.util
import json
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from population_bound import cramer_rao, crown_sigmas, efficient

from jawusd.base.errors import JawusdError
from jawusd.formats.capture import load_capture
from jawusd.formats.tracks import TRACKED, Tracks
from jawusd.geometry import (
    se3_inverse,
    se3_log,
    transform_point,
    transform_points,
)
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.track import track
from jawusd.tracking.contour.scan import prepare_scan

ROWS = ("upper", "lower")
AXES = ("left", "up", "front")
GROSS_MM = 0.5
STEADY_MM = 0.02


@dataclass
class Outcome:
    """What became of one capture."""

    seed: int
    groups: dict[str, str]
    refused: str = ""  # message of the error
    refused_by: str = ""  # "check" or "track"
    crashed: bool = False  # by an exception that is none of ours
    findings: list[tuple[str, str, str]] = field(default_factory=list)  # kind, severity, line
    figures: dict[str, float] = field(default_factory=dict)
    vectors: dict[str, list[float]] = field(default_factory=dict)
    seconds: float = 0.0


def truth_of(folder: Path) -> dict[str, np.ndarray]:
    """Return the truth of a synthetic capture."""
    with np.load(folder / "truth" / "truth.npz", allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def run(folder: Path, seed: int, score: bool = True) -> Outcome:
    """Check and track a capture as `jawusd check` and `jawusd track` do, and compare with its truth."""
    truth = truth_of(folder)
    outcome = Outcome(seed, json.loads(str(truth["groups"])))
    start = time.perf_counter()
    try:
        outcome.findings = check_findings(folder)
        errors = [line for _, severity, line in outcome.findings if severity == "error"]
        if errors:
            outcome.refused, outcome.refused_by = " | ".join(errors), "check"
            return outcome
        tracks = track(folder, jobs=1)
        outcome.findings += track_findings(tracks)
    except JawusdError as error:
        outcome.refused, outcome.refused_by = str(error), "track"
        return outcome
    except Exception as error:  # a crash is a result of this benchmark
        outcome.refused, outcome.refused_by, outcome.crashed = repr(error), "track", True
        return outcome
    finally:
        outcome.seconds = time.perf_counter() - start
    if score:
        compare(outcome, folder, tracks, truth)
    return outcome


def check_findings(folder: Path) -> list[tuple[str, str, str]]:
    """Return what `jawusd check` finds, nothing while there is no such command."""
    if importlib.util.find_spec("jawusd.pipeline.check") is None:
        return []
    from jawusd.pipeline.check import check_capture

    return [(f.kind, f.severity, f.line()) for f in check_capture(folder)]


def track_findings(tracks: Tracks) -> list[tuple[str, str, str]]:
    """Return every flag that tracks carry."""
    found = [(f["kind"], f["severity"], f["message"]) for f in tracks.meta.get("findings", [])]
    if not found:  # tracks from before findings had one form
        found += [("scans", "warning", line) for line in tracks.meta.get("start", {}).get("scan_findings", [])]
    if tracks.meta.get("calibration_rescaled_px"):
        found.append(("calibration_rescaled", "note", f"rescaled {tracks.meta['calibration_rescaled_px']}"))
    if tracks.meta.get("extrinsics", {}).get("corrected"):
        found.append(("cameras_moved", "note", "camera poses corrected"))
    late = {n: d for n, d in tracks.meta.get("delays_frames", {}).items() if abs(d) > 0.5}
    if late:
        found.append(("camera_late", "note", f"delays of frames {late}"))
    lost = ~tracks.tracked()
    if lost.any():
        found.append(("frames_lost", "note", f"{lost.sum()} of {len(lost)} frames lost"))
    seen = np.isfinite(tracks.coverage_error).any(1)
    unused = seen & ~tracks.masks_used.any(1)
    for c in np.flatnonzero(unused.mean(0) > 0.5):
        found.append(("camera_unused", "note", f"camera {tracks.camera_names[c]} left out of most frames"))
    return found


def compare(outcome: Outcome, folder: Path, tracks: Tracks, truth: dict[str, np.ndarray]) -> None:
    """Add errors, steady shifts, the Cramer-Rao bound and NEES."""
    capture = load_capture(folder)
    meshes, cameras = load_meshes(capture), load_cameras(capture)
    landmarks = subject_of_capture(capture, meshes).landmarks
    rows = np.searchsorted(truth["frames"], tracks.frames)
    good = tracks.tracked()
    figures, vectors = outcome.figures, outcome.vectors
    figures["lost"] = float((~good).mean())
    if not good.any():
        return
    rows = rows[good]
    to_bite = truth["T_bite_scan"][:3, :3]
    scans = [prepare_scan(meshes[f"{row}_teeth"], row) for row in ROWS]
    exact = np.stack([truth[f"T_world_{row}"][rows] for row in ROWS], axis=1)
    found = np.stack([getattr(tracks, f"T_world_{row}")[good] for row in ROWS], axis=1)
    bounds = cramer_rao(folder, scans, exact, truth, rows, cameras)
    usual = np.ones(len(rows), bool)
    for r, row in enumerate(ROWS):
        gap = transform_points(found[:, r], scans[r].probes) - transform_points(exact[:, r], scans[r].probes)
        distance = np.linalg.norm(gap, axis=-1)
        of_frame = np.sqrt((distance**2).mean(1))
        figures[f"vertices {row}"] = float(distance.mean())
        wrong = of_frame > GROSS_MM
        sigma = crown_sigmas(exact[:, r], scans[r], getattr(tracks, f"covariance_{row}")[good])
        flagged = (tracks.status[good, r] != TRACKED) | (sigma > GROSS_MM / 2)
        figures[f"gross {row}"] = float(wrong.mean())
        usual &= ~wrong
        figures[f"silent {row}"] = float((wrong & ~flagged).mean())
        least = crown_sigmas(exact[:, r], scans[r], bounds.unknown[:, r])
        figures[f"bound {row}"] = float(np.median(least))
        figures[f"ratio {row}"] = float(np.median(of_frame) / np.median(least))
        figures[f"ratio known {row}"] = float(
            np.median(of_frame) / np.median(crown_sigmas(exact[:, r], scans[r], bounds.known[:, r]))
        )
        inwards = np.swapaxes(exact[:, r, :3, :3], 1, 2)
        vectors[f"shift {row}"] = (to_bite @ np.median(np.einsum("fij,fj->fi", inwards, gap.mean(1)), axis=0)).tolist()
        twist = se3_log(exact[:, r] @ se3_inverse(found[:, r]))
        figures[f"nees {row}"] = _nees(twist[~wrong], getattr(tracks, f"covariance_{row}")[good][~wrong])
    relative = truth["T_upper_lower"][rows]
    measured = tracks.T_upper_lower[good]
    for k, name in ((0, "incisor"), (3, "condyle")):
        gap = transform_point(measured, landmarks[k]) - transform_point(relative, landmarks[k])
        figures[name] = float(np.linalg.norm(gap, axis=-1).mean())
        if name == "incisor":
            vectors["shift relative"] = (to_bite @ np.median(gap, axis=0)).tolist()
    twist = se3_log(relative @ se3_inverse(measured))
    figures["nees relative"] = _nees(twist[usual], tracks.covariance_relative[good][usual])
    figures["sigma incisor"] = float(np.nanmedian(tracks.sigma_mm[good, 0]))
    vectors |= efficient(bounds, scans, exact, landmarks[0], to_bite, STEADY_MM)
    for name in ("ratio", "ratio known"):
        figures[name] = max(figures[f"{name} {row}"] for row in ROWS)
    for name in ("gross", "silent"):
        figures[name] = max(figures[f"{name} {row}"] for row in ROWS)
    gum = tracks.meta.get("gum_line_mm")
    if gum is not None:
        vectors["gum error"] = (np.asarray(gum, float).ravel()[:2] - truth["gum_mm"]).tolist()


def _nees(twist: np.ndarray, covariance: np.ndarray) -> float:
    """Return the mean over frames of the normalised squared error over 6."""
    usable = np.isfinite(covariance).all((1, 2))
    if not usable.any():
        return float("nan")
    values = np.einsum("fi,fij,fj->f", twist[usable], np.linalg.pinv(covariance[usable]), twist[usable])
    return float(values.mean() / 6)
