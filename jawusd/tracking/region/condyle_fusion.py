"""Fusion of each pose with the condylar motion learned from all frames of a take.

The covariances of frames with implausible condylar motion are inflated first.

Masks generated around a wrong pose confirm that pose, and colours may favour it, but wrong poses rarely fit the
condylar motion of the subject's jaw. While a take is tracked, the condylar prior has a low weight, since it was trained
on few frames. Once all frames are known, each pose is fused with the prediction at full weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.tracks import Tracks
from jawusd.geometry import orthonormalise, relative_pose, se3_adjoint, se3_exp
from jawusd.tracking.contour.quality import landmark_sigmas, widening
from jawusd.tracking.region.jaw_priors import CondyleMotion

_STRAINED = 2.0  # squared Mahalanobis distance of the condyles, per coordinate, above which a frame is implausible
# Quantile of a take's squared condyle distances that counts as usual, and lower bound of the usual squared distance.
_USUAL, _LEAST = 0.9, 0.25


def strain_factors(motion: CondyleMotion, relative: Array, covariance: Array) -> Array:
    """Train a condylar motion on all frames; return factors on their covariances (F,), 1 for plausible frames.

    The factor is the squared distance of the condyles from their prediction, relative to its usual value (Birge 1932).

    Args:
        motion: untrained condylar motion, which is trained in place.
        relative: T_upper_lower, shape (F, 4, 4).
        covariance: covariance of the left twists of T_upper_lower about the skull origin, shape (F, 6, 6).
    """
    for pose, spread in zip(relative, covariance, strict=True):
        motion.learn(pose, spread)
    strain = np.array([motion.strain(pose) / 6 for pose in relative])
    usual = max(float(np.quantile(strain, _USUAL)), _LEAST)
    return np.where(strain > _STRAINED, np.maximum(strain / usual, 1.0), 1.0)


def widen_strained(tracks: Tracks, landmarks: Array, axes: Array) -> Tracks:
    """Return tracks in which the covariances of implausible frames are inflated; see `strain_factors`.

    Args:
        landmarks, axes: as in `CondyleMotion`.
    """
    relative, between = tracks.raw_T_upper_lower, tracks.covariance_relative
    known = np.asarray(np.isfinite(relative).all((1, 2)) & np.isfinite(between).all((1, 2)))
    if not known.any():
        return tracks
    wider = np.ones((len(known), 1, 1))
    wider[known, 0, 0] = strain_factors(CondyleMotion(landmarks, axes), relative[known], between[known])
    between = wider * between
    return replace(
        tracks,
        covariance_upper=wider * tracks.covariance_upper,
        covariance_lower=wider * tracks.covariance_lower,
        covariance_relative=between,
        sigma_mm=landmark_sigmas(relative, between, landmarks),
    )


@dataclass(frozen=True, eq=False)
class CondyleFusion:
    """Fuses all poses of a take with the condylar motion learned from them; see `results.Fusion`."""

    landmarks: Array  # as in `CondyleMotion`
    axes: Array  # as in `CondyleMotion`
    least_mm: Array | None = None  # minimum standard deviations of the incisal point after the fusion [mm], shape (F,)

    def __call__(self, poses: Array, covariance: Array, between: Array) -> tuple[Array, Array, Array]:
        """Return the fused poses and covariances; covariances of implausible frames are inflated first.

        Frames with a lost arch are not changed.

        Args:
            poses: T_world_upper and T_world_lower, NaN where lost, shape (F, 2, 4, 4).
            covariance: covariance of the poses' left twists about the world origin, shape (F, 2, 6, 6).
            between: covariance of the left twist of T_upper_lower about the skull origin, shape (F, 6, 6).
        """
        poses, covariance, between = poses.copy(), covariance.copy(), between.copy()
        known = np.flatnonzero(np.isfinite(poses).all((1, 2, 3)) & np.isfinite(between).all((1, 2)))
        if not len(known):
            return poses, covariance, between
        relative = relative_pose(poses[known, 0], poses[known, 1])
        motion = CondyleMotion(self.landmarks, self.axes)
        factors = strain_factors(motion, relative, between[known])[:, None, None]
        between[known] *= factors
        covariance[known] *= factors[:, None]
        for k, T_upper_lower in zip(known.tolist(), relative, strict=True):
            twist, left = _fused(motion, T_upper_lower, between[k])
            poses[k], covariance[k] = _shared(poses[k], covariance[k], twist, between[k] - left)
            between[k] = left
        if self.least_mm is not None:
            relative = relative_pose(poses[known, 0], poses[known, 1])
            wider = widening(relative, between[known], self.landmarks[0], self.least_mm[known])
            between[known] *= wider[:, None, None]
            covariance[known] *= wider[:, None, None, None]
        return poses, covariance, between


def _fused(motion: CondyleMotion, relative: Array, covariance: Array) -> tuple[Array, Array]:
    """Return the left twist (6,) from a measured to the fused T_upper_lower, and its covariance.

    A single step suffices, since the prediction is nearly linear within the range of pose errors.
    """
    residual, slope, variance = motion.residual(relative)
    pull = slope.T / variance
    left = np.linalg.inv(np.linalg.inv(covariance) + pull @ slope)
    return -left @ pull @ residual, 0.5 * (left + left.T)


def _shared(poses: Array, covariance: Array, twist: Array, gained: Array) -> tuple[Array, Array]:
    """Distribute a twist of T_upper_lower over both arches by their covariances; return new poses and covariances.

    Args:
        poses: T_world_upper and T_world_lower, shape (2, 4, 4).
        covariance: covariance of the poses' left twists about the world origin, shape (2, 6, 6).
        twist: left twist about the skull origin, shape (6,).
        gained: reduction of the covariance of T_upper_lower's left twist by the fusion, shape (6, 6).
    """
    to_world = se3_adjoint(poses[0])
    gains = covariance @ np.linalg.inv(covariance.sum(0))  # the fusion adds `twist` to x_lower - x_upper
    moves = gains @ to_world @ twist * np.array([[-1.0], [1.0]])
    less = gains @ (to_world @ gained @ to_world.T) @ np.swapaxes(gains, 1, 2)
    return orthonormalise(se3_exp(moves) @ poses), covariance - less
