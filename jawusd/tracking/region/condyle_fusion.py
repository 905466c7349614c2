"""Poses of a take weighed against the motion of the condyles that all its frames show.

While a take is followed, expected condyles pull little: few frames have taught them yet. Once all are known, the mean
of two Gaussians by full weight is nearer to the truth. Weights from none to threefold were looked at on five takes (a
rendered person, four path-traced mouths): with the full one raw condyles were off by 0.24 to 0.44 mm in place of 0.35
to 0.75, incisal points by 0.10 to 0.18 in place of 0.11 to 0.21, no largest error grew, and squared errors were as
large beside the covariances as before (0.32 to 0.82 of these; at threefold weight 0.38 to 0.98).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import orthonormalise, relative_pose, se3_adjoint, se3_exp
from jawusd.tracking.region.condyles import CondyleMotion
from jawusd.tracking.region.strained import strain_factors


@dataclass(frozen=True, eq=False)
class CondyleFusion:
    """Weigh all poses of a take against where its own frames have the condyles; see `results.Fusion`.

    Attributes:
        landmarks, axes: as in `CondyleMotion`.
    """

    landmarks: Array
    axes: Array

    def __call__(self, poses: Array, covariance: Array, between: Array) -> tuple[Array, Array, Array]:
        """Return likelier poses with their covariances, which are wider first where condyles are out of the way.

        Frames with a lost arch stay as they are.

        Args:
            poses: T_world_upper and T_world_lower, NaN where lost, shape (F, 2, 4, 4).
            covariance: of their left twists about the world origin, shape (F, 2, 6, 6).
            between: of the left twist of T_upper_lower about the skull origin, shape (F, 6, 6).
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
        return poses, covariance, between


def _fused(motion: CondyleMotion, relative: Array, covariance: Array) -> tuple[Array, Array]:
    """Return the left twist (6,) to the likeliest T_upper_lower by a measured one and the condyles, and its covariance.

    One step: expected condyles bend little over what poses are off.
    """
    residual, slope, variance = motion.residual(relative)
    pull = slope.T / variance
    left = np.linalg.inv(np.linalg.inv(covariance) + pull @ slope)
    return -left @ pull @ residual, 0.5 * (left + left.T)


def _shared(poses: Array, covariance: Array, twist: Array, gained: Array) -> tuple[Array, Array]:
    """Return the poses of both arches and their covariances after a twist of T_upper_lower, shared by their doubts.

    Args:
        poses: T_world_upper and T_world_lower, shape (2, 4, 4).
        covariance: of their left twists about the world origin, shape (2, 6, 6).
        twist: left twist about the skull origin, shape (6,).
        gained: by how much the covariance of that twist is less now, shape (6, 6).
    """
    to_world = se3_adjoint(poses[0])
    gains = covariance @ np.linalg.inv(covariance.sum(0))  # x_lower - x_upper is what the twist changes
    moves = gains @ to_world @ twist * np.array([[-1.0], [1.0]])
    less = gains @ (to_world @ gained @ to_world.T) @ np.swapaxes(gains, 1, 2)
    return orthonormalise(se3_exp(moves) @ poses), covariance - less
