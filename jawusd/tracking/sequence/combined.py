"""Poses measured twice, by masks and by colours, in one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.tracks import LOST, RECOVERED, Tracks
from jawusd.geometry import orthonormalise, relative_pose, se3_exp, se3_inverse, se3_log, transform_points
from jawusd.tracking.contour.quality import landmark_sigmas, relative_covariance
from jawusd.tracking.sequence.smoothing import smooth_poses


def combine(tracks: Tracks, poses: Array, covariance: Array, landmarks: Array) -> Tracks:
    """Return tracks with a second measurement of their poses taken in, each weighted by its covariance.

    Where the two contradict each other, the covariance grows with the distance: by the Birge ratio (Birge 1932), as
    covariances that are too small by the same factor explain it. Arches that are lost take the second measurement.

    Args:
        tracks: the first measurement; their raw poses are combined and smoothed anew.
        poses: T_world_upper and T_world_lower, NaN where they were not found, shape (F, 2, 4, 4).
        covariance: of their left world twists, shape (F, 2, 6, 6).
        landmarks: points whose uncertainty is reported, mandible coordinates [mm], shape (5, 3).
    """
    raw, spread, status = [], [], tracks.status.copy()
    for r, name in enumerate(("upper", "lower")):
        own, own_covariance = getattr(tracks, f"raw_T_world_{name}"), getattr(tracks, f"covariance_{name}")
        pose, variance = _weighted(own, own_covariance, poses[:, r], covariance[:, r])
        found = np.isfinite(pose).all((1, 2))
        status[found & (status[:, r] == LOST), r] = RECOVERED
        raw.append(pose)
        spread.append(variance)
    both = np.asarray(np.isfinite(raw).all((0, 2, 3)))
    if not both.any():
        return tracks
    middle = np.median(transform_points(raw[1][both], landmarks[:3]).reshape(-1, 3), axis=0)
    final = [smooth_poses(tracks.frames, pose, variance, middle) for pose, variance in zip(raw, spread, strict=True)]
    raw_relative, relative, between = (np.full((len(both), n, n), np.nan) for n in (4, 4, 6))
    raw_relative[both], relative[both] = (
        relative_pose(raw[0][both], raw[1][both]),
        relative_pose(*(f[both] for f in final)),
    )
    between[both] = relative_covariance(raw[0][both], spread[0][both], spread[1][both])
    return replace(
        tracks,
        T_world_upper=final[0],
        T_world_lower=final[1],
        T_upper_lower=relative,
        raw_T_world_upper=raw[0],
        raw_T_world_lower=raw[1],
        raw_T_upper_lower=raw_relative,
        status=status,
        covariance_upper=spread[0],
        covariance_lower=spread[1],
        covariance_relative=between,
        sigma_mm=landmark_sigmas(raw_relative, between, landmarks),
    )


def _weighted(one: Array, one_covariance: Array, other: Array, other_covariance: Array) -> tuple[Array, Array]:
    """Return the means of poses (F, 4, 4) and their covariances (F, 6, 6); the other's where only that is known."""
    known, also = (
        np.isfinite(pose).all((1, 2)) & np.isfinite(covariance).all((1, 2))
        for pose, covariance in ((one, one_covariance), (other, other_covariance))
    )
    pose, covariance = one.copy(), one_covariance.copy()
    pose[also & ~known], covariance[also & ~known] = other[also & ~known], other_covariance[also & ~known]
    k = known & also
    apart = se3_log(other[k] @ se3_inverse(one[k]))
    gain = one_covariance[k] @ np.linalg.inv(one_covariance[k] + other_covariance[k])
    pose[k] = orthonormalise(se3_exp(np.einsum("nij,nj->ni", gain, apart)) @ one[k])
    remaining = one_covariance[k] - gain @ one_covariance[k]
    square = np.einsum(
        "ni,ni->n", apart, np.linalg.solve(one_covariance[k] + other_covariance[k], apart[..., None])[..., 0]
    )
    birge = np.maximum(1.0, square / apart.shape[1])
    covariance[k] = 0.5 * birge[:, None, None] * (remaining + np.swapaxes(remaining, 1, 2))
    return pose, covariance
