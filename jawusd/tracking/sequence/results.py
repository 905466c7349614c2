"""From records of single frames to tracks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from jawusd.formats.tracks import LOST, Tracks
from jawusd.geometry import relative_pose
from jawusd.geometry.arrays import Array
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import (
    correlation_px,
    landmark_sigmas,
    matched_px,
    relative_covariance,
    residual_px,
    twist_covariance,
)
from jawusd.tracking.sequence.extrinsics import Extrinsics
from jawusd.tracking.sequence.nuisance import Nuisances
from jawusd.tracking.sequence.smoothing import smooth_poses


def assemble(
    records: Mapping[int, FrameRecord],
    camera_names: tuple[str, ...],
    landmarks: Array,
    nuisances: Nuisances,
    extrinsics: Extrinsics,
    config: TrackingConfig,
    notes: dict,
) -> Tracks:
    """Return the tracks of a take: raw poses as aligned, final poses smoothed over time.

    The covariances are those of the raw poses. Outline errors change slowly, so smoothing takes out little of them
    and the final poses are given no more credit.

    Args:
        records: by frame.
        camera_names: the cameras that have masks.
        landmarks: mandible coordinates [mm], shape (5, 3).
        nuisances: delays and biases, reported in the meta data.
        extrinsics: the camera poses the records were aligned with, reported too.
        config: the tracker's numbers, kept in the meta data.
        notes: more meta data.
    """
    frames = np.array(sorted(records), np.int64)
    ordered = [records[f] for f in frames]
    status = np.stack([r.status for r in ordered])
    raw = np.stack([r.solution.poses for r in ordered])
    raw[status == LOST] = np.nan
    correlation = take_correlation_px(records, config)
    covariance = _covariances(ordered, correlation)
    known = status != LOST
    centres = np.stack([r.solution.centres for r in ordered])
    middle = np.median(centres[known.all(1)] if known.all(1).any() else centres, axis=(0, 1))
    final = np.stack([smooth_poses(frames, raw[:, r], covariance[:, r], middle) for r in (0, 1)], axis=1)
    raw_relative, relative = _relative(raw), _relative(final)
    covariance_relative = _relative_covariance(raw, covariance)
    meta = {
        "tracking": asdict(config),
        "correlation_px": correlation,
        "delays_frames": dict(zip(camera_names, nuisances.delays.tolist(), strict=True)),
        "delays_sigma_frames": dict(zip(camera_names, nuisances.sigma_delays.tolist(), strict=True)),
        "mask_bias_px": nuisances.bias_px.tolist(),
        "mask_bias_sigma_px": nuisances.sigma_bias_px.tolist(),
        "extrinsics": extrinsics.report(camera_names),
        **notes,
    }
    return Tracks(
        frames=frames,
        T_world_upper=final[:, 0],
        T_world_lower=final[:, 1],
        T_upper_lower=relative,
        raw_T_world_upper=raw[:, 0],
        raw_T_world_lower=raw[:, 1],
        raw_T_upper_lower=raw_relative,
        status=status,
        prior_aided=np.zeros(len(frames), bool),
        coverage_error=np.stack([r.coverage for r in ordered]),
        masks_used=np.stack([r.used for r in ordered]),
        covariance_upper=covariance[:, 0],
        covariance_lower=covariance[:, 1],
        covariance_relative=covariance_relative,
        sigma_mm=landmark_sigmas(raw_relative, covariance_relative, landmarks),
        residual_px=np.stack([residual_px(r.solution) for r in ordered]),
        matched_px=np.stack([matched_px(r.solution) for r in ordered]),
        camera_names=camera_names,
        meta=meta,
        lost_reason=np.array([[loss.reason for loss in r.losses] for r in ordered], np.uint8),
        lost_value=np.array([[loss.value for loss in r.losses] for r in ordered]),
        lost_limit=np.array([[loss.limit for loss in r.losses] for r in ordered]),
    )


def outline_variance(records: Mapping[int, FrameRecord], config: TrackingConfig) -> Array:
    """Return the variance times correlation length of the outline errors per row [px^3], shape (2,)."""
    residual = np.stack([np.where(r.status != LOST, residual_px(r.solution), np.nan) for r in records.values()])
    typical = np.full(2, config.typical_noise_px3)
    for r in np.flatnonzero(np.isfinite(residual).any(0)):
        typical[r] = np.nanmedian(residual[:, r]) ** 2 * take_correlation_px(records, config)
    return typical


def take_correlation_px(records: Mapping[int, FrameRecord], config: TrackingConfig) -> float:
    """Return the correlation length of the outline errors of a take, the median over its frames [px]."""
    values = np.stack(
        [np.where(r.status != LOST, correlation_px(r.solution, config), np.nan) for r in records.values()]
    )
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else config.correlation_px


def _covariances(records: list[FrameRecord], correlation: float) -> Array:
    """Return the covariance of both rows' left twists, NaN where lost, shape (F, 2, 6, 6)."""
    out = np.full((len(records), 2, 6, 6), np.nan)
    for k, record in enumerate(records):
        sigma = residual_px(record.solution)
        for r in np.flatnonzero(record.status != LOST):
            out[k, r] = twist_covariance(record.solution, r, sigma[r], correlation)
    return out


def _relative(poses: Array) -> Array:
    """Return T_upper_lower, NaN where a row is lost, shape (F, 4, 4)."""
    out = np.full((len(poses), 4, 4), np.nan)
    both = np.isfinite(poses).all((1, 2, 3))
    out[both] = relative_pose(poses[both, 0], poses[both, 1])
    return out


def _relative_covariance(poses: Array, covariance: Array) -> Array:
    """Return the covariance of T_upper_lower's left twist, NaN where a row is lost, shape (F, 6, 6)."""
    out = np.full((len(poses), 6, 6), np.nan)
    both = np.isfinite(poses).all((1, 2, 3))
    out[both] = relative_covariance(poses[both, 0], covariance[both, 0], covariance[both, 1])
    return out
