"""From records of single frames to tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from jawusd.formats.tracks import LOST, Tracks
from jawusd.geometry import relative_pose
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.history import FrameRecord
from jawusd.tracking.quality import (
    correlation_px,
    landmark_sigmas,
    matched_px,
    relative_covariance,
    residual_px,
    twist_covariance,
)
from jawusd.tracking.scan import Scan


def assemble(
    records: Mapping[int, FrameRecord],
    scans: Sequence[Scan],
    camera_names: tuple[str, ...],
    landmarks: NDArray[np.float64],
    config: TrackingConfig,
    notes: dict,
) -> Tracks:
    """Return the tracks of a take without smoothing: the final poses equal the raw ones.

    Args:
        records: by frame.
        scans: upper and lower.
        camera_names: the cameras that have masks.
        landmarks: mandible coordinates [mm], shape (5, 3).
        config: the tracker's numbers, kept in the meta data.
        notes: more meta data.
    """
    frames = np.array(sorted(records), np.int64)
    rows = [records[f] for f in frames]
    status = np.stack([r.status for r in rows])
    lost = status == LOST
    poses = np.stack([r.solution.poses for r in rows])
    poses[lost] = np.nan
    residual = np.stack([residual_px(r.solution) for r in rows])
    correlation = _take_correlation_px(rows, lost, config)
    covariance = np.full((len(rows), 2, 6, 6), np.nan)
    for k, record in enumerate(rows):
        for r in (0, 1):
            if not lost[k, r]:
                covariance[k, r] = twist_covariance(record.solution, r, residual[k, r], correlation)
    both = ~lost.any(1)
    relative = np.full((len(rows), 4, 4), np.nan)
    covariance_relative = np.full((len(rows), 6, 6), np.nan)
    sigma = np.full((len(rows), len(landmarks)), np.nan)
    relative[both] = relative_pose(poses[both, 0], poses[both, 1])
    covariance_relative[both] = relative_covariance(poses[both, 0], covariance[both, 0], covariance[both, 1])
    sigma[both] = landmark_sigmas(relative[both], covariance_relative[both], landmarks)
    return Tracks(
        frames=frames,
        T_world_upper=poses[:, 0],
        T_world_lower=poses[:, 1],
        T_upper_lower=relative,
        raw_T_world_upper=poses[:, 0].copy(),
        raw_T_world_lower=poses[:, 1].copy(),
        raw_T_upper_lower=relative.copy(),
        status=status,
        prior_aided=np.zeros(len(rows), bool),
        coverage_error=np.stack([r.coverage for r in rows]),
        covariance_upper=covariance[:, 0],
        covariance_lower=covariance[:, 1],
        covariance_relative=covariance_relative,
        sigma_mm=sigma,
        residual_px=residual,
        matched_px=np.stack([matched_px(r.solution) for r in rows]),
        camera_names=camera_names,
        meta={"tracking": asdict(config), "correlation_px": correlation, **notes},
    )


def _take_correlation_px(records: Sequence[FrameRecord], lost: NDArray[np.bool_], config: TrackingConfig) -> float:
    """Return the correlation length of the outline errors of a take, the median over its frames [px]."""
    values = np.stack([correlation_px(r.solution, config) for r in records])[~lost]
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else config.correlation_px
