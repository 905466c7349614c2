"""The tracks of a take from the records of its frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict

import numpy as np

from jawusd.formats.tracks import LOST, Tracks, TracksMeta
from jawusd.geometry import relative_pose
from jawusd.geometry.arrays import Array
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import (
    correlation_px,
    landmark_sigmas,
    matched_px,
    relative_covariance,
    residual_px,
    twist_covariance,
)
from jawusd.tracking.contour.scan import ARCHES
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
    notes: TracksMeta,
) -> Tracks:
    """Return the tracks of a take: raw poses as aligned, final poses smoothed over time.

    The covariances are those of the raw poses: outline errors change slowly, so smoothing reduces them little.

    `landmarks` are in mandible coordinates [mm], shape (5, 3); everything else goes to the meta data as well.
    """
    frames = np.array(sorted(records), np.int64)
    ordered = [records[f] for f in frames]
    status = np.stack([record.status for record in ordered])
    raw = np.stack([record.solution.poses for record in ordered])
    raw[status == LOST] = np.nan
    correlation = take_correlation_px(records, config)
    covariance = _covariances(ordered, correlation)
    losses = np.array([record.losses for record in ordered], np.float64)  # reason, value, limit
    known = status != LOST
    centres = np.stack([record.solution.centres for record in ordered])
    middle = np.median(centres[known.all(1)] if known.all(1).any() else centres, axis=(0, 1))
    final = np.stack([smooth_poses(frames, raw[:, r], covariance[:, r], middle) for r in ARCHES], axis=1)
    raw_relative, relative = _relative(raw), _relative(final)
    covariance_relative = _relative_covariance(raw, covariance)
    meta: TracksMeta = {
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
        coverage_error=np.stack([record.coverage for record in ordered]),
        masks_used=np.stack([record.used for record in ordered]),
        covariance_upper=covariance[:, 0],
        covariance_lower=covariance[:, 1],
        covariance_relative=covariance_relative,
        sigma_mm=landmark_sigmas(raw_relative, covariance_relative, landmarks),
        residual_px=np.stack([residual_px(record.solution) for record in ordered]),
        matched_px=np.stack([matched_px(record.solution) for record in ordered]),
        camera_names=camera_names,
        meta=meta,
        lost_reason=losses[..., 0].astype(np.uint8),
        lost_value=losses[..., 1],
        lost_limit=losses[..., 2],
    )


def outline_variance(records: Mapping[int, FrameRecord], config: TrackingConfig) -> Array:
    """Return the variance times correlation length of the outline errors per arch [px^3], shape (2,)."""
    residual = _of_tracked(records, residual_px)
    typical = np.full(2, config.typical_noise_px3)
    for r in np.flatnonzero(np.isfinite(residual).any(0)):
        typical[r] = np.nanmedian(residual[:, r]) ** 2 * take_correlation_px(records, config)
    return typical


def take_correlation_px(records: Mapping[int, FrameRecord], config: TrackingConfig) -> float:
    """Return the correlation length of the outline errors of a take, the median over its frames [px]."""
    values = _of_tracked(records, lambda solution: correlation_px(solution, config))
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else config.correlation_px


def _of_tracked(records: Mapping[int, FrameRecord], figure: Callable[[Solution], Array]) -> Array:
    """Return a figure of every frame and arch, NaN where lost, shape (F, 2)."""
    return np.stack([np.where(r.status != LOST, figure(r.solution), np.nan) for r in records.values()])


def _covariances(records: list[FrameRecord], correlation: float) -> Array:
    """Return the covariance of both arches' left twists, NaN where lost, shape (F, 2, 6, 6)."""
    out = np.full((len(records), 2, 6, 6), np.nan)
    for k, record in enumerate(records):
        sigma = residual_px(record.solution)
        for r in np.flatnonzero(record.status != LOST).tolist():
            out[k, r] = twist_covariance(record.solution, r, sigma[r], correlation)
    return out


def _relative(poses: Array) -> Array:
    """Return T_upper_lower, NaN where an arch is lost, shape (F, 4, 4)."""
    out = np.full((len(poses), 4, 4), np.nan)
    both = np.isfinite(poses).all((1, 2, 3))
    out[both] = relative_pose(poses[both, 0], poses[both, 1])
    return out


def _relative_covariance(poses: Array, covariance: Array) -> Array:
    """Return the covariance of T_upper_lower's left twist, NaN where an arch is lost, shape (F, 6, 6)."""
    out = np.full((len(poses), 6, 6), np.nan)
    both = np.isfinite(poses).all((1, 2, 3))
    out[both] = relative_covariance(poses[both, 0], covariance[both, 0], covariance[both, 1])
    return out
