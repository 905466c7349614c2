"""The jaw model of the person as a prior on the pose of the lower arch relative to the upper one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.geometry import (
    make_transform,
    mandible_metric,
    relative_pose,
    se3_adjoint,
    se3_inverse,
    se3_left_jacobian,
    se3_log,
    transform_points,
)
from jawusd.tracking.contour.equations import NormalEquations, Solution

_NORMAL_DIRECTIONS = 3  # six motions of a rigid body less the three the model allows


@dataclass(frozen=True, eq=False)
class KinematicPrior:
    """Pull relative poses towards the poses of a jaw model, and leave motion along the model free.

    The deviation of a pose from the model, the left twist xi with T_upper_lower = exp(xi) pose(d), costs
    xi^T P xi after the best change of d: P = 3 / s^2 (M - M J (J^T M J)^-1 J^T M) with the landmark metric M
    (xi^T M xi = mean squared displacement), the model's Jacobian J, and the rms distance s of captured poses from the
    model, spread over three directions. The prior of Zoss et al. 2018 (an empirical rig), with the width taken from
    the capture.
    """

    jaw: JawRig  # the person's model
    spread_mm: float  # rms landmark distance s of good tracked poses from the model [mm]

    def accumulate(self, state: Solution, equations: NormalEquations) -> None:
        """Add the log-likelihood of the deviation from the model, linearised."""
        poses = state.poses
        relative = relative_pose(poses[0], poses[1])
        deviation, precision = self.deviation(relative)
        to_skull = se3_adjoint(se3_inverse(poses[0]))
        about = [se3_adjoint(make_transform(np.eye(3), centre)) for centre in state.centres]
        # To first order exp(xi') = exp(Ad(T_u^-1) (x_l - x_u)) exp(xi).
        slope = np.hstack([-to_skull @ about[0], to_skull @ about[1]])
        equations.add_joint(slope.T @ precision @ slope, -slope.T @ precision @ deviation)

    def deviation(self, relative: Array) -> tuple[Array, Array]:
        """Return the twist (6,) of T_upper_lower (4, 4) from the model, at its nearest pose, and P there (6, 6)."""
        d = self.jaw.encode(relative)[0]
        pose = self.jaw.pose(d)
        return se3_log(relative @ se3_inverse(pose)), self._precision(d, pose)

    def _precision(self, d: Array, pose: Array) -> Array:
        """Return P at a model pose, shape (6, 6)."""
        M = mandible_metric(transform_points(pose, self.jaw.landmarks))
        # The derivative of the logarithm becomes that of the pose by the left Jacobian (Barfoot 2017, eq. 7.85).
        J = se3_left_jacobian(self.jaw.twist(d)) @ self.jaw.jacobian(d)
        along = M @ J
        normal = M - along @ np.linalg.solve(J.T @ along, along.T)
        return _NORMAL_DIRECTIONS / self.spread_mm**2 * normal
