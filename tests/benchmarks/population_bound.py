"""The Cramer-Rao bound of a synthetic take, and what an estimator that attains it would show; used by population.py."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cramer_rao import MEAN_W
from subjects.annotator import REFERENCE_HEIGHT

from jawusd.formats.capture import load_capture
from jawusd.formats.tracks import TRACKED
from jawusd.geometry import Camera, mandible_metric, se3_adjoint, transform_point, transform_points
from jawusd.tracking import TrackingConfig
from jawusd.tracking.contour.equations import translation
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import twist_covariance
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews
from jawusd.tracking.sequence.extrinsics import Extrinsics
from jawusd.tracking.sequence.nuisance import TakeEquations, pose_response

ROWS = ("upper", "lower")
DRAWS = 200


@dataclass(frozen=True)
class Bounds:
    """Hold the least covariances of both arches' left twists, with how habits move the poses of a whole take.

    Attributes:
        known: if the annotator's habits are known, shape (F, 2, 6, 6).
        unknown: if they must be told from the take by the spread that hands have (the bound of van Trees 1968 for
            parameters with a prior), shape (F, 2, 6, 6).
        response: twist per unit of the habits, shape (F, 2, 6, U).
        habits: covariance of what the take does not tell of the habits, shape (U, U).
    """

    known: np.ndarray
    unknown: np.ndarray
    response: np.ndarray
    habits: np.ndarray


def cramer_rao(folder: Path, scans: list, exact: np.ndarray, truth: dict, rows: np.ndarray, cameras: list) -> Bounds:
    """Return the bounds by the annotator's wobble at the true poses (F, 2, 4, 4)."""
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
    known = np.empty((len(rows), 2, 6, 6))
    response = np.empty((len(rows), 2, 6, len(habits)))
    for k, (frame, record) in enumerate(records.items()):
        for r in (0, 1):
            known[k, r] = MEAN_W * twist_covariance(record.solution, r, 1.0, noise)
            to_world = se3_adjoint(translation(record.solution.centres[r]))
            response[k, r] = to_world @ pose_response(records, frame, r, extrinsics)
    return Bounds(known, known + response @ habits @ np.swapaxes(response, -1, -2), response, habits)


def efficient(
    bounds: Bounds, scans: list[Scan], exact: np.ndarray, incisor: np.ndarray, to_bite: np.ndarray, steady_mm: float
) -> dict[str, list[float]]:
    """Return what errors drawn from the bound's normal distribution show, by the names of figures.

    Args:
        bounds: of the take.
        scans: of both arches.
        exact: true poses, shape (F, 2, 4, 4).
        incisor: incisal point in coordinates of the lower scan [mm], shape (3,).
        to_bite: rotation from the upper scan to anatomical axes, shape (3, 3).
        steady_mm: limit of a steady shift per axis.
    """
    rng = np.random.default_rng(0)
    habit = _root(bounds.habits) @ rng.standard_normal((len(bounds.habits), DRAWS))
    twists = bounds.response @ habit + _root(bounds.known) @ rng.standard_normal((*bounds.known.shape[:2], 6, DRAWS))
    out, ratios = {}, []
    to_bite_world = to_bite @ np.swapaxes(exact[:, 0, :3, :3], 1, 2)
    at_incisor = transform_point(exact[:, 1], incisor)
    for r, row in enumerate(ROWS):
        points = transform_points(exact[:, r], scans[r].probes)
        inwards = to_bite @ np.swapaxes(exact[:, r, :3, :3], 1, 2)
        out[f"efficient shift {row}"] = _within(inwards @ _moved(twists[:, r], points.mean(1)), steady_mm)
        metric = np.stack([mandible_metric(own) for own in points])
        of_frame = np.sqrt(np.einsum("fid,fij,fjd->fd", twists[:, r], metric, twists[:, r]))
        least = np.median(crown_sigmas(exact[:, r], scans[r], bounds.unknown[:, r]))
        ratios.append(np.median(of_frame, axis=0) / least)
    gap = _moved(twists[:, 1], at_incisor) - _moved(twists[:, 0], at_incisor)
    out["efficient shift relative"] = _within(to_bite_world @ gap, steady_mm)
    return out | {"efficient ratio": np.max(ratios, axis=0).tolist()}


def _root(covariance: np.ndarray) -> np.ndarray:
    """Return a matrix square root of covariances (..., N, N), which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0))[..., None, :]


def _moved(twists: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return how left twists (F, 6, D), rotation first, move a point per frame (F, 3), shape (F, 3, D)."""
    return np.cross(twists[:, :3], points[:, :, None], axis=1) + twists[:, 3:]


def _within(shifts: np.ndarray, steady_mm: float) -> list[float]:
    """Return per axis the share of draws whose median over frames is within a limit, of shifts (F, 3, D)."""
    return (np.abs(np.median(shifts, axis=0)) <= steady_mm).mean(axis=1).tolist()


def _noise(truth: dict, first: Camera, centre: np.ndarray, config: TrackingConfig) -> float:
    """Return variance times correlation length of the annotator's wobble at the working size [px^3]."""
    scale = max(first.size_px[1] / REFERENCE_HEIGHT, 0.45)
    full = float(first.K[0, 0] / first.depth(centre[None])[0])  # px per mm
    working = min(full, config.working_px_per_mm)
    wobble_px = float(truth["wobble_px"]) * scale / full * working
    together_px = float(truth["cell_px"]) * scale / full * working
    # rounding to whole pixels of the recorded picture, independent from pixel to pixel
    return wobble_px**2 * together_px + (working / full) ** 3 / 12.0


def crown_sigmas(poses: np.ndarray, scan: Scan, covariances: np.ndarray) -> np.ndarray:
    """Return the rms standard deviation of crown vertices [mm], shape (F,), by covariances of left twists."""
    squares = [
        np.trace(mandible_metric(transform_points(T, scan.probes)) @ C) for T, C in zip(poses, covariances, strict=True)
    ]
    return np.sqrt(np.array(squares))
