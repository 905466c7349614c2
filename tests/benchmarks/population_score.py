"""Check, track and score one synthetic person's capture; used by population.py."""

from __future__ import annotations

import importlib.util
import json
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from cramer_rao import MEAN_W

from jawusd.errors import JawusdError
from jawusd.formats.capture import load_capture
from jawusd.formats.tracks import TRACKED, Tracks
from jawusd.geometry import (
    Camera,
    mandible_metric,
    se3_adjoint,
    se3_inverse,
    se3_log,
    transform_point,
    transform_points,
)
from jawusd.pipeline.prepare import load_cameras, load_meshes, subject_of_capture
from jawusd.pipeline.track import track
from jawusd.synthetic.annotator import REFERENCE_HEIGHT
from jawusd.tracking import TrackingConfig
from jawusd.tracking.contour.equations import translation
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import twist_covariance
from jawusd.tracking.contour.scan import Scan, prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews
from jawusd.tracking.sequence.extrinsics import Extrinsics
from jawusd.tracking.sequence.nuisance import TakeEquations, pose_response

ROWS = ("upper", "lower")
AXES = ("left", "up", "front")
GROSS_MM = 0.5


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
    known, bound = cramer_rao(folder, scans, exact, truth, rows, cameras)
    usual = np.ones(len(rows), bool)
    for r, row in enumerate(ROWS):
        gap = transform_points(found[:, r], scans[r].probes) - transform_points(exact[:, r], scans[r].probes)
        distance = np.linalg.norm(gap, axis=-1)
        of_frame = np.sqrt((distance**2).mean(1))
        figures[f"vertices {row}"] = float(distance.mean())
        wrong = of_frame > GROSS_MM
        sigma = _crown_sigmas(exact[:, r], scans[r], getattr(tracks, f"covariance_{row}")[good])
        flagged = (tracks.status[good, r] != TRACKED) | (sigma > GROSS_MM / 2)
        figures[f"gross {row}"] = float(wrong.mean())
        usual &= ~wrong
        figures[f"silent {row}"] = float((wrong & ~flagged).mean())
        least = _crown_sigmas(exact[:, r], scans[r], bound[:, r])
        figures[f"bound {row}"] = float(np.median(least))
        figures[f"ratio {row}"] = float(np.median(of_frame) / np.median(least))
        figures[f"ratio known {row}"] = float(
            np.median(of_frame) / np.median(_crown_sigmas(exact[:, r], scans[r], known[:, r]))
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
    for name in ("ratio", "ratio known"):
        figures[name] = max(figures[f"{name} {row}"] for row in ROWS)
    for name in ("gross", "silent"):
        figures[name] = max(figures[f"{name} {row}"] for row in ROWS)
    gum = tracks.meta.get("gum_line_mm")
    if gum is not None:
        vectors["gum error"] = (np.asarray(gum, float).ravel()[:2] - truth["gum_mm"]).tolist()


def cramer_rao(
    folder: Path, scans: list, exact: np.ndarray, truth: dict, rows: np.ndarray, cameras: list
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least covariances of both arches' twists by the annotator's wobble, two of shape (F, 2, 6, 6).

    The first if the annotator's habits are known, the second if they must be told from the take by the spread that
    hands have (the bound of van Trees 1968 for parameters with a prior).
    """
    capture, config = load_capture(folder), TrackingConfig()
    offsets = dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))
    centre = np.mean([transform_point(exact[0, r], scans[r].centre) for r in (0, 1)], axis=0)
    table = {camera.name: camera for camera in cameras}
    solver, noise = ContourSolver(scans, config), _noise(truth, cameras[0], centre, config)
    status, used = np.full(2, TRACKED, np.int8), np.ones((2, len(cameras)), bool)
    records = {}
    with MaskViews(capture.cameras, table, offsets, centre, config.working_px_per_mm) as masks:
        for pose, row in zip(exact, rows):
            frame = int(truth["frames"][row])
            solution = solver.solve(pose, masks.at(frame), ())
            records[frame] = FrameRecord(solution, status, used, np.zeros((2, len(cameras))))
        extrinsics = Extrinsics.calibrated(masks.cameras, centre)
    # The weights of the robust estimate are left out of the information.
    habits = TakeEquations(records, np.full(2, noise * MEAN_W), extrinsics).solve(config, False).covariance
    known, unknown = np.empty((2, len(rows), 2, 6, 6))
    for k, (frame, record) in enumerate(records.items()):
        for r in (0, 1):
            known[k, r] = MEAN_W * twist_covariance(record.solution, r, 1.0, noise)
            to_world = se3_adjoint(translation(record.solution.centres[r]))
            response = to_world @ pose_response(records, frame, r, extrinsics)
            unknown[k, r] = known[k, r] + response @ habits @ response.T
    return known, unknown


def _noise(truth: dict, first: Camera, centre: np.ndarray, config: TrackingConfig) -> float:
    """Return variance times correlation length of the annotator's wobble at the working size [px^3]."""
    scale = max(first.size_px[1] / REFERENCE_HEIGHT, 0.45)
    full = float(first.K[0, 0] / first.depth(centre[None])[0])  # px per mm
    working = min(full, config.working_px_per_mm)
    wobble_px = float(truth["wobble_px"]) * scale / full * working
    together_px = float(truth["cell_px"]) * scale / full * working
    # rounding to whole pixels of the recorded picture, independent from pixel to pixel
    return wobble_px**2 * together_px + (working / full) ** 3 / 12.0


def _crown_sigmas(poses: np.ndarray, scan: Scan, covariances: np.ndarray) -> np.ndarray:
    """Return the rms standard deviation of crown vertices [mm], shape (F,), by covariances of left twists."""
    squares = [
        np.trace(mandible_metric(transform_points(T, scan.probes)) @ C) for T, C in zip(poses, covariances, strict=True)
    ]
    return np.sqrt(np.array(squares))


def _nees(twist: np.ndarray, covariance: np.ndarray) -> float:
    """Return the mean over frames of the normalised squared error over 6."""
    usable = np.isfinite(covariance).all((1, 2))
    if not usable.any():
        return float("nan")
    values = np.einsum("fi,fij,fj->f", twist[usable], np.linalg.pinv(covariance[usable]), twist[usable])
    return float(values.mean() / 6)
