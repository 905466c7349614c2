"""Priors on the jaw pose: condyles that follow the incisal point, and teeth that do not interpenetrate.

When the teeth touch, or lips hide most of them, the contour hardly constrains rotations of the jaw that raise the front
teeth and lower the condyles. For a given jaw, the position of the incisal point nearly determines the positions of both
condyles, since a mandible has about three degrees of freedom (Zoss et al. 2018). This relation is learned from earlier
frames.

While a take is tracked, the condylar prior has a low weight, since it was trained on few frames. Once all frames are
known, each pose is fused with the prediction at full weight, since wrong poses rarely fit the motion of the condyles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.tracks import Tracks
from jawusd.geometry import (
    hat,
    orthonormalise,
    relative_pose,
    rigid_fit,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    transform_point,
)
from jawusd.tracking.contour.equations import NormalEquations, Solution, translation
from jawusd.tracking.contour.quality import landmark_sigmas, widening

_UNIT_MM = (5.0, 20.0, 5.0)  # scale of the incisal point's motion to the left, upwards and forwards [mm]
# Mean motion of the left condyle to the left, upwards and forwards [mm], as a quadratic in the incisal point's motion
# x, y, z, in units of `_UNIT_MM` (coefficients of 1, x, y, z, xx, xy, xz, yy, yz, zz). It is averaged over 60 simulated
# joints of `jawusd.synthetic.person`, whose ranges come from the literature. The right condyle moves as a mirror image.
_USUAL_MM = np.array(
    [
        [0.0, 1.1, 0.0, 0.0, 0.0, 0.2, -0.4, 0.0, 0.0, 0.0],
        [0.0, 1.0, 5.1, -2.5, 0.0, -0.7, 0.4, -1.2, 0.2, 0.0],
        [0.0, -1.8, -7.1, 3.7, 0.0, -0.3, 0.0, 1.1, 0.5, 0.0],
    ]
)
_ODD = np.array([False, True, False, False, False, True, True, False, False, False])  # whether each term is odd in x
# Standard deviations of a subject's polynomial coefficients, sideways, upwards and forwards [mm]; factor on these for
# the quadratic terms; and standard deviation of the constant term, which is an error of the bite registration of the
# scans [mm].
_SPREAD_MM, _PRODUCTS, _CONSTANT_MM = (0.4, 1.5, 1.5), 0.5, 1.0
# Standard deviations of the condyles from the polynomials of their own jaw, sideways, upwards and forwards [mm].
_OFF_MM = (0.3, 0.8, 0.5)
_NEWS = 0.1  # weight of a frame in the regression: below 1, since neighbouring frames are correlated
# backward motion of the incisal point per mm of opening and per mm^2 of squared opening: averaged over the same joints
# as `_USUAL_MM`
_BACK = 0.25, 0.005
# squared Mahalanobis distance per coordinate at which the weight of a frame is halved, since its pose may be wrong [-]
_HALVING = 4.0

# Standard deviation of the height of lower teeth above their position in the occlusion of the scans [mm], due to errors
# of the bite registration; and the squared height in standard deviations [-] at which the weight of the penalty is
# halved, since the bite of the scans may be wrong instead of the pose.
_ABOVE_MM, _BITE_HALVING = 0.2, 4.0


class CondyleMotion:
    """Learned map from the position of the incisal point to the positions of both condyles.

    Bayesian linear regression (Bishop 2006, section 3.3) of the motion of both condyles on that of the incisal point,
    all relative to the skull, by polynomials of the second degree.
    """

    def __init__(self, landmarks: Array, axes: Array) -> None:
        """Start from the population prior, which is the same for all subjects.

        Args:
            landmarks: as in `geometry.LANDMARKS`, in scan coordinates [mm], shape (5, 3).
            axes: rotation from scan to anatomical axes: left, up, front; shape (3, 3).
        """
        self._points, self.axes = landmarks[[0, -2, -1]], axes
        self.hinge = np.asarray(landmarks[-2:].mean(0), np.float64)  # midpoint of the condyles, shape (3,)
        spread = np.tile(_SPREAD_MM, 2)
        self._off = np.square(np.tile(_OFF_MM, 2))
        mean = np.concatenate([_USUAL_MM, np.where(_ODD, [[1.0], [-1.0], [-1.0]], [[-1.0], [1.0], [1.0]]) * _USUAL_MM])
        first = np.repeat(1.0 / spread[:, None] ** 2, mean.shape[1], axis=1)
        first[:, 0] = 1.0 / _CONSTANT_MM**2
        first[:, 4:] /= _PRODUCTS**2
        self._precision = first[:, :, None] * np.eye(mean.shape[1])  # precision of the coefficients, shape (6, K, K)
        self._sums = first * mean  # precision times mean of the coefficients, shape (6, K)

    def learn(self, relative: Array, covariance: Array) -> None:
        """Learn from T_upper_lower (4, 4), and the covariance (6, 6) of its left twist about the skull origin."""
        incisor, condyles = self._shifts(relative)
        features = _features(incisor)[0]
        known = self._off + np.repeat(landmark_sigmas(relative, covariance, self._points[1:]) ** 2, 3)
        if not np.isfinite(known).all():
            return
        trust = _HALVING / (_HALVING + self.strain(relative) / len(known))
        weight = _NEWS * trust / known
        self._precision += weight[:, None, None] * np.outer(features, features)
        self._sums += (weight * condyles)[:, None] * features

    def expected(self, incisor: Array) -> tuple[Array, Array, Array]:
        """Predict the condyles' motion from that of the incisal point: mean (6,), derivative (6, 3), variance (6,).

        Motions are in anatomical axes [mm], left condyle first; `incisor`, the motion of the incisal point, has shape
        (3,).
        """
        features, slopes = _features(incisor)
        means = np.linalg.solve(self._precision, self._sums[..., None])[..., 0]
        uncertain = np.linalg.solve(self._precision, np.broadcast_to(features, means.shape)[..., None])[..., 0]
        return means @ features, means @ slopes, self._off + uncertain @ features

    def strain(self, relative: Array) -> float:
        """Return the squared Mahalanobis distance of the condyles at T_upper_lower (4, 4) from their prediction."""
        incisor, condyles = self._shifts(relative)
        mean, _, variance = self.expected(incisor)
        return float((np.square(condyles - mean) / variance).sum())

    def placed(self, left_mm: float, down_mm: float, forward_mm: float) -> Array:
        """Return T_upper_lower (4, 4) at a position of the incisal point; `forward_mm` is relative to plain opening."""
        back = _BACK[0] * down_mm + _BACK[1] * down_mm**2
        incisor = np.array([left_mm, -down_mm, forward_mm - back])
        moves = np.concatenate([incisor, self.expected(incisor)[0]]).reshape(3, 3)
        return rigid_fit(self._points, self._points + moves @ self.axes)

    def _shifts(self, relative: Array) -> tuple[Array, Array]:
        """Return displacements of incisal point (3,) and condyles (6,) from occlusion, in anatomical axes [mm]."""
        moved = (transform_point(relative, self._points) - self._points) @ self.axes.T
        return moved[0], moved[1:].ravel()

    def residual(self, relative: Array) -> tuple[Array, Array, Array]:
        """Return the residuals of the condyles [mm], their derivatives and variances [mm^2]; shapes (6,), (6, 6), (6,).

        `relative` is T_upper_lower (4, 4); the derivatives are with respect to its left twist about the skull origin.
        """
        points = transform_point(relative, self._points)
        slopes = [self.axes @ np.hstack([-hat(point), np.eye(3)]) for point in points]
        incisor, condyles = self._shifts(relative)
        mean, along, variance = self.expected(incisor)
        return condyles - mean, np.concatenate(slopes[1:]) - along @ slopes[0], variance


@dataclass(frozen=True, eq=False)
class CondyleTerm:
    """Penalises the distances of both condyles from their predicted positions."""

    motion: CondyleMotion
    noise_px3: float  # variance of colour borders times correlation length [px^3]

    def accumulate(self, state: Solution, equations: NormalEquations) -> None:
        """Add the squared deviations of the condyles from their prediction, weighted to match the outline's squares."""
        residual, slope, variance = self.motion.residual(relative_pose(state.poses[0], state.poses[1]))
        to_skull = se3_adjoint(se3_inverse(state.poses[0]))
        upper, lower = (slope @ to_skull @ se3_adjoint(translation(centre)) for centre in state.centres)
        slope = np.hstack([-upper, lower])
        weights = self.noise_px3 * float(equations.outline_weight.mean()) / variance
        equations.add_joint(slope.T @ (weights[:, None] * slope), -slope.T @ (weights * residual))


def _features(incisor: Array) -> tuple[Array, Array]:
    """Return the monomials (K,) of a point up to degree two, and their derivatives with respect to the point (K, 3)."""
    x, unit = incisor / _UNIT_MM, np.diag(1.0 / np.array(_UNIT_MM))
    i, j = np.triu_indices(3)
    products = x[i, None] * unit[j] + x[j, None] * unit[i]
    return np.concatenate([[1.0], x, x[i] * x[j]]), np.concatenate([np.zeros((1, 3)), unit, products])


@dataclass(frozen=True, eq=False)
class BiteTerm:
    """Penalises lower teeth that lie above their position in the occlusion of the scans."""

    points: Array  # points on the lower teeth, in scan coordinates [mm], shape (N, 3)
    up: Array  # normal of the occlusal plane in scan coordinates, shape (3,)
    noise_px3: float  # variance of border errors times their correlation length

    def accumulate(self, state: Solution, equations: NormalEquations) -> None:
        """Add the squared heights above occlusion at the solution's poses, in units of the outline's sum of squares."""
        skull = state.poses[0]
        up = skull[:3, :3] @ self.up
        for point in self.points:
            here, closed = transform_point(state.poses[1], point), transform_point(skull, point)
            height = float(up @ (here - closed))
            if height <= 0:
                continue
            # The point on the lower teeth moves with the lower arch, and its upper limit with the upper arch.
            moves = [up @ np.hstack([-hat(here - centre), np.eye(3)]) for centre in state.centres]
            slope = np.concatenate([-moves[0], moves[1]])
            trust = _BITE_HALVING / (_BITE_HALVING + (height / _ABOVE_MM) ** 2)
            weight = trust * self.noise_px3 * float(equations.outline_weight.mean()) / _ABOVE_MM**2
            equations.add_joint(weight * np.outer(slope, slope), -weight * height * slope)


_STRAINED = 2.0  # squared Mahalanobis distance of the condyles, per coordinate, above which a frame is implausible
# Quantile of a take's squared condyle distances that counts as usual, and lower bound of the usual squared distance.
_USUAL, _LEAST = 0.9, 0.25


def strain_factors(motion: CondyleMotion, relative: Array, covariance: Array) -> Array:
    """Train a condylar motion on all frames; return factors on their covariances (F,), 1 for plausible frames.

    The factor is the squared distance of the condyles from their prediction, relative to its usual value (Birge 1932).

    `covariance` (F, 6, 6) is that of the left twists of T_upper_lower (F, 4, 4) about the skull origin.
    """
    for pose, spread in zip(relative, covariance, strict=True):
        motion.learn(pose, spread)
    strain = np.array([motion.strain(pose) / 6 for pose in relative])
    usual = max(float(np.quantile(strain, _USUAL)), _LEAST)
    return np.where(strain > _STRAINED, np.maximum(strain / usual, 1.0), 1.0)


def widen_strained(tracks: Tracks, landmarks: Array, axes: Array) -> Tracks:
    """Return tracks with inflated covariances of implausible frames; see `strain_factors` and `CondyleMotion`."""
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
        """Return the fused poses and covariances, as in `results.Fusion`; frames with a lost arch are not changed."""
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

    Poses (2, 4, 4) and covariances (2, 6, 6) are as in `results.Fusion`; the left twist (6,) is about the skull origin,
    and `gained` (6, 6) is the reduction of its covariance by the fusion.
    """
    to_world = se3_adjoint(poses[0])
    gains = covariance @ np.linalg.inv(covariance.sum(0))  # the fusion adds `twist` to x_lower - x_upper
    moves = gains @ to_world @ twist * np.array([[-1.0], [1.0]])
    less = gains @ (to_world @ gained @ to_world.T) @ np.swapaxes(gains, 1, 2)
    return orthonormalise(se3_exp(moves) @ poses), covariance - less
