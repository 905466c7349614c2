"""Smooth poses over time, weighted by each frame's covariance and the process noise of the motion nearby."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.ndimage import uniform_filter1d

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import make_transform, orthonormalise, se3_adjoint, se3_exp, se3_inverse, se3_log

# Frames on either side over which process noise is estimated: a third of a second at 24 fps.
_WINDOW = 4
# Least acceleration variance, as a share of what noise independent from frame to frame would show: part of the outline
# errors is the same in neighbouring frames and cancels in second differences.
_FLOOR = 0.5
_SHORTEST = 5  # frames; shorter runs do not show their process noise


def smooth_poses(frames: NDArray[np.int64], poses: Array, covariance: Array, centre: Array) -> Array:
    """Return the poses that balance the measured ones against even motion.

    Minimises sum x_k^T C_k^-1 x_k + sum a_k^T Q_k^-1 a_k over left twists x_k about a fixed point, with the second
    differences a_k of the poses: the smoother of a random walk in velocity (Rauch, Tung & Striebel 1965), with Q_k
    taken from the raw second differences nearby less the share of noise, so that a sudden stop stays sudden.

    Lost frames stay NaN, runs of fewer than five frames stay as they are.

    Args:
        frames: frame numbers, shape (F,).
        poses: measured poses, NaN where lost, shape (F, 4, 4).
        covariance: of their left twists about the world origin, shape (F, 6, 6).
        centre: the fixed point, amid the motion [mm], shape (3,).
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
    """Return the twists that take one run of poses to the smooth ones, shape (N, 6)."""
    count = len(poses)
    steps = se3_log(poses[1:] @ se3_inverse(poses[:-1]))
    bend = np.diff(steps, axis=0)  # of frames 1 .. N-2
    variance = np.einsum("nii->ni", covariance)
    noise = variance[:-2] + 4 * variance[1:-1] + variance[2:]
    process_noise = uniform_filter1d(bend**2 - noise, 2 * _WINDOW + 1, axis=0, mode="nearest")
    weight = 1.0 / np.maximum(process_noise, _FLOOR * noise)
    # Band storage: diagonal d of the upper triangle in arch 17 - d; twists of three neighbours reach 17 entries.
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
