"""Final poses: smoothing over time, and combination with a second measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.ndimage import uniform_filter1d

from jawusd.base.arrays import Array, Mask
from jawusd.formats.tracks import LOST, RECOVERED, Tracks
from jawusd.geometry import (
    make_transform,
    orthonormalise,
    relative_pose,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_log,
    transform_points,
)
from jawusd.tracking.contour.quality import landmark_sigmas, relative_covariance
from jawusd.tracking.contour.scan import ARCH_NAMES, ARCHES

_WINDOW = 4  # frames on either side over which process noise is estimated: a third of a second in all at 24 fps
# Minimum variance of second differences, relative to the variance expected from independent noise [-]: outline errors
# common to neighbouring frames cancel in second differences.
_FLOOR = 0.5
_SHORTEST = 5  # minimum number of frames for estimating process noise


def smooth_poses(frames: NDArray[np.int64], poses: Array, covariance: Array, centre: Array) -> Array:
    """Return poses smoothed over time by a fixed-interval smoother.

    The smoother minimises sum x_k^T C_k^-1 x_k + sum a_k^T Q_k^-1 a_k over left twists x_k about a fixed point, with
    pose covariances C_k and second differences a_k of the poses (Rauch, Tung & Striebel 1965). The process noise Q_k is
    estimated from nearby second differences less their measurement noise, so that sudden stops are preserved.

    Lost frames remain NaN, and runs of fewer than five frames remain unchanged.

    Args:
        frames, poses: frame numbers (F,), and measured poses (F, 4, 4), NaN where lost.
        covariance: covariance of the poses' left twists about the world origin, shape (F, 6, 6).
        centre: the fixed point, near the moving points [mm], shape (3,).
    """
    to = make_transform(np.eye(3), -np.asarray(centre))
    A, back = se3_adjoint(to), se3_inverse(to)
    out = poses.copy()
    known = np.asarray(np.isfinite(poses).all((1, 2)) & np.isfinite(covariance).all((1, 2)))
    for run in _runs(frames, known):
        if len(run) >= _SHORTEST:
            twists = _corrections(to @ poses[run] @ back, A @ covariance[run] @ A.T)
            out[run] = orthonormalise(back @ se3_exp(twists) @ to @ poses[run])
    return out


def _runs(frames: NDArray[np.int64], known: Mask) -> list[NDArray[np.int64]]:
    index = np.flatnonzero(known)
    if not len(index):
        return []
    breaks = np.flatnonzero((np.diff(frames[index]) != 1) | (np.diff(index) != 1)) + 1
    return np.split(index, breaks)


def _corrections(poses: Array, covariance: Array) -> Array:
    """Return the twists from a run of poses to the smooth poses, shape (N, 6)."""
    count = len(poses)
    steps = se3_log(poses[1:] @ se3_inverse(poses[:-1]))
    bend = np.diff(steps, axis=0)  # second differences at frames 1 .. N-2
    variance = np.einsum("nii->ni", covariance)
    noise = variance[:-2] + 4 * variance[1:-1] + variance[2:]
    process_noise = uniform_filter1d(bend**2 - noise, 2 * _WINDOW + 1, axis=0, mode="nearest")
    weight = 1.0 / np.maximum(process_noise, _FLOOR * noise)
    # Band storage has diagonal d of the upper triangle in row 17 - d; each twist is coupled with the next two, up to 17
    # entries away.
    bands = np.zeros((18, 6 * count))
    right = np.zeros(6 * count)
    information = np.linalg.inv(covariance)
    for i in range(6):
        for j in range(i, 6):
            bands[17 - (j - i), j::6] += information[:, i, j]
    for a, ca in enumerate((1.0, -2.0, 1.0)):
        for b, cb in enumerate((1.0, -2.0, 1.0)):
            if b >= a:
                columns = np.arange(6 * b, 6 * (b + len(bend)))
                bands[17 - 6 * (b - a), columns] += ca * cb * weight.ravel()
        arches = np.arange(6 * a, 6 * (a + len(bend)))
        right[arches] -= ca * (weight * bend).ravel()
    return solveh_banded(bands, right, overwrite_ab=True, overwrite_b=True).reshape(count, 6)


def combine(tracks: Tracks, poses: Array, covariance: Array, landmarks: Array) -> Tracks:
    """Return tracks combined with a second measurement of their poses, each weighted by its covariance.

    If the two measurements contradict each other, the covariance is scaled by the Birge ratio (Birge 1932). For lost
    arches, the second measurement is used. The combined poses are smoothed again.

    Poses (F, 2, 4, 4), NaN where lost, and covariances (F, 2, 6, 6) are as in `results.Fusion`; landmarks (5, 3) are in
    mandible coordinates [mm].
    """
    raw, spread, status = np.empty_like(poses), np.empty_like(covariance), tracks.status.copy()
    for r, name in enumerate(ARCH_NAMES):
        own, own_covariance = getattr(tracks, f"raw_T_world_{name}"), getattr(tracks, f"covariance_{name}")
        raw[:, r], spread[:, r] = _weighted(own, own_covariance, poses[:, r], covariance[:, r])
        found = np.isfinite(raw[:, r]).all((1, 2))
        status[found & (status[:, r] == LOST), r] = RECOVERED
    both = np.isfinite(raw).all((1, 2, 3))
    if not both.any():
        return tracks
    middle = np.median(transform_points(raw[both, 1], landmarks[:3]).reshape(-1, 3), axis=0)
    final = np.stack([smooth_poses(tracks.frames, raw[:, r], spread[:, r], middle) for r in ARCHES], axis=1)
    raw_relative, between = relative_poses(raw), relative_covariances(raw, spread)
    return replace(
        tracks,
        T_world_upper=final[:, 0],
        T_world_lower=final[:, 1],
        T_upper_lower=relative_poses(final),
        raw_T_world_upper=raw[:, 0],
        raw_T_world_lower=raw[:, 1],
        raw_T_upper_lower=raw_relative,
        status=status,
        covariance_upper=spread[:, 0],
        covariance_lower=spread[:, 1],
        covariance_relative=between,
        sigma_mm=landmark_sigmas(raw_relative, between, landmarks),
    )


def relative_poses(poses: Array) -> Array:
    """Return T_upper_lower (F, 4, 4) of poses of both arches (F, 2, 4, 4), NaN where an arch is lost."""
    out = np.full((len(poses), 4, 4), np.nan)
    both = np.isfinite(poses).all((1, 2, 3))
    out[both] = relative_pose(poses[both, 0], poses[both, 1])
    return out


def relative_covariances(poses: Array, covariance: Array) -> Array:
    """Return the covariance of T_upper_lower's left twist, NaN where an arch is lost, shape (F, 6, 6)."""
    out = np.full((len(poses), 6, 6), np.nan)
    both = np.isfinite(poses).all((1, 2, 3))
    out[both] = relative_covariance(poses[both, 0], covariance[both, 0], covariance[both, 1])
    return out


def _weighted(one: Array, one_covariance: Array, other: Array, other_covariance: Array) -> tuple[Array, Array]:
    """Return weighted means of poses (F, 4, 4) and covariances (F, 6, 6); use `other` where `one` is missing."""
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
    solved = np.linalg.solve(one_covariance[k] + other_covariance[k], apart[..., None])[..., 0]
    square = np.einsum("ni,ni->n", apart, solved)
    birge = np.maximum(1.0, square / apart.shape[1])
    covariance[k] = 0.5 * birge[:, None, None] * (remaining + np.swapaxes(remaining, 1, 2))
    return pose, covariance
