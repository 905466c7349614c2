"""Conversion of the result of a solve to a performance, and of a performance to tracks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.formats.notes import Registration, TracksMeta
from jawusd.formats.performance import Performance, SolvedJaw, SolveState
from jawusd.formats.tracks import LOST, TRACKED, Tracks
from jawusd.geometry import make_transform, se3_adjoint, se3_left_jacobian
from jawusd.tracking.contour.quality import landmark_sigmas, matched_px, residual_px
from jawusd.tracking.performance.coordinates import HEAD, JAW
from jawusd.tracking.performance.smoother import Smoothed


def performance_of(
    jaw: JawRig,
    pivot: Array,
    frames: Sequence[int],
    smoothed: Smoothed,
    camera_names: tuple[str, ...],
    fps: float,
    *,
    free_focal: bool = False,
) -> Performance:
    """Return the performance of a take.

    Args:
        pivot: point of the upper scan about which the head rotates [mm], shape (3,).
        frames: frame numbers of the reference camera, in the order of the fits.
        free_focal: whether focal lengths were estimated, relative to those of the cameras.
    """
    fits = smoothed.fits
    d = np.stack([fit.pose.d for fit in fits])
    verdicts = jaw.validate_parameters(d, tolerance_mm=None)
    of_rig, found = jaw.pose_covariance(d), np.stack([fit.found for fit in fits])
    missed = np.stack([fit.missed for fit in fits]).any(1)
    unseen = np.where(missed, SolveState.LOST, SolveState.CARRIED)
    state = np.where(found.all(1), SolveState.SOLVED, np.where(smoothed.by_skin, SolveState.SKIN, unseen))
    nothing = np.full(2, np.nan)
    notes: dict[str, object] = {"fps": fps, "habits": smoothed.state.habits.tolist()}
    if free_focal:
        factors, sigmas = np.exp(smoothed.state.log_focal), smoothed.sigma_log_focal
        table = zip(camera_names, factors.tolist(), sigmas.tolist(), strict=True)
        notes["focal"] = {name: [factor, sigma] for name, factor, sigma in table}
    return Performance(
        frames=np.array(frames, np.int64),
        T_world_upper=np.stack([fit.pose.head for fit in fits]),
        d=d,
        covariance=smoothed.covariance,
        rig_covariance=_spread(smoothed.rig_gain, of_rig),
        rig_pose_covariance=_spread(jaw.spatial_jacobian(d) @ smoothed.rig_gain - np.eye(6), of_rig),
        pivot=pivot,
        state=state.astype(np.int8),
        found=found,
        use=np.stack([fit.use for fit in fits]),
        uncovered=np.stack([fit.uncovered for fit in fits]),
        residual_px=np.stack([nothing if f.solution is None else residual_px(f.solution) for f in fits]),
        matched_px=np.stack([np.zeros(2) if f.solution is None else matched_px(f.solution) for f in fits]),
        margin_mm=verdicts.margin_mm,
        valid=verdicts.valid,
        verdict=verdicts.words(),
        camera_names=camera_names,
        notes=notes,
    )


def tracks_of(performance: Performance, jaw: JawRig) -> Tracks:
    """Return the poses of both arches and their covariances as tracks.

    Arches that are not visible count as lost and have no raw poses. The standard deviations of the landmarks include
    the uncertainty of the rig.
    """
    p = performance
    head, relative = p.T_world_upper, jaw.pose(p.d)
    lower = head @ relative
    # Derivatives of left twists with respect to the nine unknowns: of the head in the world, and of the mandible in the
    # skull frame.
    turn = se3_adjoint(head @ make_transform(np.eye(3), p.pivot))
    by_d = se3_left_jacobian(jaw.twist(p.d)) @ jaw.jacobian(p.d)
    of_upper, of_lower = np.zeros((2, len(p.frames), 6, 9))
    of_upper[..., HEAD] = of_lower[..., HEAD] = turn
    of_lower[..., JAW] = se3_adjoint(head) @ by_d
    relative_covariance = _spread(by_d, p.covariance[:, JAW, JAW]) + p.rig_pose_covariance
    meta = TracksMeta(solver="performance", tolerance_mm=jaw.tolerance_mm)
    kinds = {"start": dict, "findings": list, "fps": float, "focal": dict}
    meta.update(cast(TracksMeta, {key: p.notes[key] for key in kinds if isinstance(p.notes.get(key), kinds[key])}))
    moved = jaw.meta.get("registration")
    if isinstance(moved, dict) and moved.get("applied"):  # the lower scan is registered as in the rig
        meta["registration"] = cast(Registration, moved)
    count, cameras = len(p.frames), len(p.camera_names)
    seen = (*p.found.T, p.found.all(1))
    raw = [
        np.where(known[:, None, None], poses, np.nan)
        for known, poses in zip(seen, (head, lower, relative), strict=True)
    ]
    return Tracks(
        frames=p.frames,
        T_world_upper=head,
        T_world_lower=lower,
        T_upper_lower=relative,
        raw_T_world_upper=raw[0],
        raw_T_world_lower=raw[1],
        raw_T_upper_lower=raw[2],
        status=np.where(p.found, TRACKED, LOST).astype(np.int8),
        prior_aided=np.ones(count, bool),
        coverage_error=p.uncovered.reshape(count, 2, cameras),
        masks_used=p.use,
        covariance_upper=_spread(of_upper, p.covariance),
        covariance_lower=_spread(of_lower, p.covariance),
        covariance_relative=relative_covariance,
        sigma_mm=landmark_sigmas(relative, relative_covariance, jaw.landmarks),
        residual_px=p.residual_px,
        matched_px=p.matched_px,
        camera_names=p.camera_names,
        meta=meta,
        solved=SolvedJaw(p.d, p.sigma_d, p.margin_mm, p.state, p.valid),
    )


def _spread(slope: Array, covariance: Array) -> Array:
    return np.asarray(slope @ covariance @ np.swapaxes(slope, -1, -2), np.float64)
