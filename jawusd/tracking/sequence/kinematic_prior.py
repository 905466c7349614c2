"""The subject's jaw model as a prior on the pose of the lower arch relative to the upper one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.formats.notes import TracksMeta
from jawusd.formats.tracks import Tracks
from jawusd.geometry import (
    make_transform,
    mandible_metric,
    orthonormalise,
    relative_pose,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_left_jacobian,
    se3_log,
    transform_points,
)
from jawusd.tracking.contour.equations import NormalEquations, Solution

_NORMAL_DIRECTIONS = 3  # number of directions off the model: six degrees of freedom of a pose minus three of the model


@dataclass(frozen=True, eq=False)
class KinematicPrior:
    """A prior that penalises the distance of relative poses from a jaw model, but not motion along the model.

    The deviation of a pose from the model is the left twist xi with T_upper_lower = exp(xi) pose(d). Its cost,
    minimised over d, is xi^T P xi with P = 3 / s^2 (M - M J (J^T M J)^-1 J^T M) where M is the landmark metric (xi^T M
    xi = mean squared displacement), J the model's Jacobian, and s the rms distance of captured poses from the model,
    which is spread over three directions. This is the prior of Zoss et al. 2018 (an empirical rig) with a width
    estimated from the capture.
    """

    jaw: JawRig  # the subject's jaw model
    spread_mm: float  # rms landmark distance s of good tracked poses from the model [mm]

    def accumulate(self, state: Solution, equations: NormalEquations) -> None:
        """Add the linearised log-likelihood of the deviation from the model."""
        poses = state.poses
        relative = relative_pose(poses[0], poses[1])
        deviation, precision = self.deviation(relative)
        to_skull = se3_adjoint(se3_inverse(poses[0]))
        about = [se3_adjoint(make_transform(np.eye(3), centre)) for centre in state.centres]
        # To first order, exp(xi') = exp(Ad(T_u^-1) (x_l - x_u)) exp(xi) for twists x_u and x_l of both arches.
        slope = np.hstack([-to_skull @ about[0], to_skull @ about[1]])
        equations.add_joint(slope.T @ precision @ slope, -slope.T @ precision @ deviation)

    def deviation(self, relative: Array) -> tuple[Array, Array]:
        """Return the twist (6,) from the nearest model pose to T_upper_lower (4, 4), and its precision P (6, 6)."""
        d = self.jaw.encode(relative)[0]
        pose = self.jaw.pose(d)
        M = mandible_metric(transform_points(pose, self.jaw.landmarks))
        # The left Jacobian converts the derivative of the logarithm to that of the pose (Barfoot 2017, eq. 7.85).
        J = se3_left_jacobian(self.jaw.twist(d)) @ self.jaw.jacobian(d)
        along = M @ J
        normal = M - along @ np.linalg.solve(J.T @ along, along.T)
        return se3_log(relative @ se3_inverse(pose)), _NORMAL_DIRECTIONS / self.spread_mm**2 * normal


def model_spread_mm(jaw: JawRig, relative: Array) -> float:
    """Return the rms landmark distance of T_upper_lower (N, 4, 4) from a model [mm], including tracking noise."""
    return float(np.sqrt(np.mean(jaw.encode(relative)[1] ** 2)))


#: Minimum number of poses for estimating their spread about the model.
FEWEST_POSES = 15
_ROUNDS = 3  # number of linearisations: the model is nearly linear within the range of pose errors


def weigh_with_model(tracks: Tracks, jaw: JawRig) -> Tracks:
    """Return tracks whose final relative poses are the most likely ones given the raw poses and a model fitted to them.

    It is intended for tracks from colours, whose errors extend over whole teeth. The result is the mean of the product
    of two Gaussians, relinearised `_ROUNDS` times. Upper teeth, raw poses, covariances and sigmas remain as measured.
    The width of the prior is stored in the metadata as `prior_spread_mm`.
    """
    known = np.isfinite(tracks.raw_T_upper_lower).all((1, 2)) & np.isfinite(tracks.T_upper_lower).all((1, 2))
    known &= np.isfinite(tracks.covariance_relative).all((1, 2))
    if known.sum() < FEWEST_POSES:
        return tracks
    prior = KinematicPrior(jaw, model_spread_mm(jaw, tracks.raw_T_upper_lower[known]))
    relative, lower = tracks.T_upper_lower.copy(), tracks.T_world_lower.copy()
    for k in np.flatnonzero(known).tolist():
        relative[k] = _likeliest(relative[k], tracks.covariance_relative[k], prior)
        lower[k] = tracks.T_world_upper[k] @ relative[k]
    meta: TracksMeta = {**tracks.meta, "prior_spread_mm": prior.spread_mm}
    return replace(tracks, T_upper_lower=relative, T_world_lower=lower, meta=meta)


def _likeliest(measured: Array, covariance: Array, prior: KinematicPrior) -> Array:
    """Return the most likely T_upper_lower (4, 4), given a model, a measurement, and its left twist's covariance."""
    information, pose = np.linalg.inv(covariance), measured
    for _ in range(_ROUNDS):
        deviation, precision = prior.deviation(pose)
        away = se3_log(pose @ se3_inverse(measured))
        step = np.linalg.solve(information + precision, precision @ deviation + information @ away)
        pose = orthonormalise(se3_exp(-step) @ pose)
    return pose
