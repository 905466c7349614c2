"""Assemble the tracks of a take from the records of its frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.formats.notes import TracksMeta
from jawusd.formats.tracks import LOST, Tracks
from jawusd.geometry import se3_adjoint
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import translation
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import (
    landmark_sigmas,
    matched_px,
    outline_errors,
    residual_px,
    twist_covariance,
)
from jawusd.tracking.contour.scan import ARCHES
from jawusd.tracking.sequence.closed_bite import (
    STEADY,
    ClosedBite,
    RestFrames,
    check_registration,
    closed_bite,
    registration_findings,
    registration_unknown,
)
from jawusd.tracking.sequence.extrinsics import Extrinsics
from jawusd.tracking.sequence.nuisance import Nuisances, interpolation_covariance, pose_response
from jawusd.tracking.sequence.smoothing import relative_covariances, relative_poses, smooth_poses

#: Refines all measured poses with further information. Arguments and results are poses (F, 2, 4, 4), NaN where lost,
#: the covariances of their left twists about the world origin (F, 2, 6, 6), and those of T_upper_lower's left twists
#: about the skull origin (F, 6, 6).
Fusion = Callable[[Array, Array, Array], tuple[Array, Array, Array]]


def assemble(
    records: Mapping[int, FrameRecord],
    camera_names: tuple[str, ...],
    landmarks: Array,
    nuisances: Nuisances,
    extrinsics: Extrinsics,
    config: TrackingConfig,
    rest: RestFrames,
    notes: TracksMeta,
    fuse: Fusion | None = None,
) -> Tracks:
    """Return the tracks of a take: raw poses as aligned or refined by `fuse`, and final poses smoothed over time.

    The covariances are those of the raw poses: outline errors change slowly, so smoothing reduces them little.
    `landmarks` are in mandible coordinates [mm], shape (5, 3).

    Raises:
        TrackingError: the registration of the scans is to be corrected, but the teeth are never closed.
    """
    frames = np.array(sorted(records), np.int64)
    raw, status, losses, centres, coverage, used, residual, matched = _columns(records, frames)
    raw[status == LOST] = np.nan
    _, correlation = outline_errors(((r.solution, r.found) for r in records.values()), config)
    raw, covariance, covariance_relative, bite = _measured(raw, records, nuisances, extrinsics, correlation, rest)
    if fuse is not None:
        raw, covariance, covariance_relative = fuse(raw, covariance, covariance_relative)
    known = status != LOST
    middle = np.median(centres[known.all(1)] if known.all(1).any() else centres, axis=(0, 1))
    final = np.stack([smooth_poses(frames, raw[:, r], covariance[:, r], middle) for r in ARCHES], axis=1)
    raw_relative = relative_poses(raw)
    meta: TracksMeta = {
        "tracking": asdict(config),
        "correlation_px": correlation,
        "delays_frames": dict(zip(camera_names, nuisances.delays.tolist(), strict=True)),
        "delays_sigma_frames": dict(zip(camera_names, nuisances.sigma_delays.tolist(), strict=True)),
        **_habits_report(nuisances, camera_names),
        "extrinsics": extrinsics.report(camera_names),
        **notes,
    }
    meta |= _bite_report(bite, rest, meta.get("findings", []))
    return Tracks(
        frames=frames,
        T_world_upper=final[:, 0],
        T_world_lower=final[:, 1],
        T_upper_lower=relative_poses(final),
        raw_T_world_upper=raw[:, 0],
        raw_T_world_lower=raw[:, 1],
        raw_T_upper_lower=raw_relative,
        status=status.astype(np.int8),
        prior_aided=np.zeros(len(frames), bool),
        coverage_error=coverage,
        masks_used=used.astype(bool),
        covariance_upper=covariance[:, 0],
        covariance_lower=covariance[:, 1],
        covariance_relative=covariance_relative,
        sigma_mm=landmark_sigmas(raw_relative, covariance_relative, landmarks),
        residual_px=residual,
        matched_px=matched,
        camera_names=camera_names,
        meta=meta,
        lost_reason=losses[..., 0].astype(np.uint8),
        lost_value=losses[..., 1],
        lost_limit=losses[..., 2],
    )


def _columns(records: Mapping[int, FrameRecord], frames: NDArray[np.int64]) -> list[Array]:
    """Return each value of `_figures` as an array over all frames."""
    rows = (_figures(records[frame]) for frame in frames.tolist())
    first = next(rows)
    columns = [np.empty((len(frames), *value.shape)) for value in first]
    # records are read one at a time, since all records of a long take would need much memory
    for k, row in enumerate(chain([first], rows)):
        for column, value in zip(columns, row, strict=True):
            column[k] = value
    return columns


def _figures(record: FrameRecord) -> tuple[Array | Mask | NDArray[np.int8], ...]:
    """Return the values of a frame that are stored in tracks; the third lists reason, value and limit of each loss."""
    solution, losses = record.solution, np.array(record.losses, np.float64)
    quality = (residual_px(solution), matched_px(solution))
    return (solution.poses, record.status, losses, solution.centres, record.coverage, record.used, *quality)


def _measured(
    raw: Array,
    records: Mapping[int, FrameRecord],
    nuisances: Nuisances,
    extrinsics: Extrinsics,
    correlation: float,
    rest: RestFrames,
) -> tuple[Array, Array, Array, ClosedBite | None]:
    """Return poses (F, 2, 4, 4), their covariances, those of relative poses (F, 6, 6), and the closed bite."""
    frames = np.array(sorted(records), np.int64)
    outline, habits = _covariances(records, correlation, nuisances, extrinsics)
    bite = closed_bite(frames, raw, outline, habits, rest)
    covariance, steady = outline + habits, STEADY * outline + habits
    del outline, habits  # free arrays that are as large as the tracks themselves
    relative = relative_covariances(raw, covariance)
    if bite is None:
        return raw, covariance, relative, None
    still = np.broadcast_to(np.eye(4), (len(frames), 4, 4))
    relative = bite.reduce(relative, relative_covariances(raw, steady), still, 2)
    for r in ARCHES:
        covariance[:, r] = bite.reduce(covariance[:, r], steady[:, r], raw[:, r], r)
    return bite.correct(raw, rest.apply), covariance, relative, bite


def _bite_report(bite: ClosedBite | None, rest: RestFrames, findings: list[dict[str, str | float | int]]) -> TracksMeta:
    """Return the metadata about the frames with closed teeth, including the given findings and those about the bite."""
    if bite is None:
        return {"findings": [*findings, registration_unknown(rest).as_json()]}
    registration = bite.report(rest)
    check_registration(registration)
    return {
        "registration": registration,
        "steady_error": bite.steady_motions(rest.apply).tolist(),
        "findings": [*findings, *(found.as_json() for found in registration_findings(registration))],
    }


def _habits_report(nuisances: Nuisances, camera_names: tuple[str, ...]) -> TracksMeta:
    """Return the metadata about annotator bias."""

    def by_camera(values: Array) -> dict[str, list[float]]:
        return dict(zip(camera_names, values.T.tolist(), strict=True))

    habits, sigma = nuisances.habits, nuisances.sigma_habits
    return {
        "outline_bias_px": by_camera(habits[..., 0]),
        "outline_bias_sigma_px": by_camera(sigma[..., 0]),
        "gum_bias_px": by_camera(habits[..., 1]),
        "gum_bias_sigma_px": by_camera(sigma[..., 1]),
        "gum_line_mm": habits[:, 0, 2].tolist(),
        "gum_line_sigma_mm": sigma[:, 0, 2].tolist(),
    }


def outline_variance(records: Mapping[int, FrameRecord], config: TrackingConfig) -> Array:
    """Return the variance times correlation length of the outline errors per arch [px^3], shape (2,)."""
    return outline_errors(((r.solution, r.found) for r in records.values()), config)[0]


def _covariances(
    records: Mapping[int, FrameRecord], correlation: float, nuisances: Nuisances, extrinsics: Extrinsics
) -> tuple[Array, Array]:
    """Return the covariances (F, 2, 6, 6) of left twists by outline errors of frames, and by nuisance parameters."""
    outline, habits = np.full((2, len(records), 2, 6, 6), np.nan)
    for k, frame in enumerate(sorted(records)):
        record = records[frame]
        sigma = residual_px(record.solution)
        for r in np.flatnonzero(record.found).tolist():
            A = se3_adjoint(translation(record.solution.centres[r]))
            response = A @ pose_response(records, frame, r, extrinsics)
            between = A @ interpolation_covariance(records, frame, r, nuisances.delays) @ A.T
            outline[k, r] = twist_covariance(record.solution, r, sigma[r], correlation) + between
            habits[k, r] = response @ nuisances.covariance @ response.T
    return outline, habits
