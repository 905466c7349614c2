"""The subject's jaw model as a prior: uncertain frames are tracked again with it, or final poses weighted with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.notes import TracksMeta
from jawusd.formats.tracks import LOST, RECOVERED, TRACKED, Tracks
from jawusd.geometry import (
    Camera,
    mandible_metric,
    orthonormalise,
    relative_pose,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_left_jacobian,
    se3_log,
    transform_point,
    transform_points,
)
from jawusd.tracking.config import FOR_TAKES, TrackingConfig
from jawusd.tracking.contour.equations import NormalEquations, Solution, translation
from jawusd.tracking.contour.quality import (
    coverage_error,
    joint_covariance,
    landmark_sigmas,
    matched_px,
    residual_px,
    uncovered_px,
)
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews, View, present_masks
from jawusd.tracking.sequence.extrinsics import corrected_cameras
from jawusd.tracking.sequence.smoothing import smooth_poses

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
        about = [se3_adjoint(translation(centre)) for centre in state.centres]
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


def _model_spread_mm(jaw: JawRig, relative: Array) -> float:
    """Return the rms landmark distance of T_upper_lower (N, 4, 4) from a model [mm], including tracking noise."""
    return float(np.sqrt(np.mean(jaw.encode(relative)[1] ** 2)))


# Minimum number of poses for estimating their spread about the model.
_FEWEST_POSES = 15
_ROUNDS = 3  # number of linearisations: the model is nearly linear within the range of pose errors


def weigh_with_model(tracks: Tracks, jaw: JawRig) -> Tracks:
    """Return tracks whose final relative poses are the most likely ones given the raw poses and a model fitted to them.

    It is intended for tracks from colours, whose errors extend over whole teeth. The result is the mean of the product
    of two Gaussians, relinearised `_ROUNDS` times. Upper teeth, raw poses, covariances and sigmas remain as measured.
    The width of the prior is stored in the metadata as `prior_spread_mm`.
    """
    known = np.isfinite(tracks.raw_T_upper_lower).all((1, 2)) & np.isfinite(tracks.T_upper_lower).all((1, 2))
    known &= np.isfinite(tracks.covariance_relative).all((1, 2))
    if known.sum() < _FEWEST_POSES:
        return tracks
    prior = KinematicPrior(jaw, _model_spread_mm(jaw, tracks.raw_T_upper_lower[known]))
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


# Standard deviation of the worst landmark above which a frame is tracked again [mm]: about the error of a
# three-parameter jaw model. Below it, masks alone are more accurate.
_HARD_MM = 0.3


def hard_frames(tracks: Tracks) -> Mask:
    """Return which frames to refine with the model: lost, recovered, missing a camera, or uncertain; shape (F,)."""
    sigma = tracks.sigma_mm.max(1)
    return (tracks.status != TRACKED).any(1) | ~(sigma <= _HARD_MM)


def refine_tracks(
    tracks: Tracks,
    jaw: JawRig,
    capture: Capture,
    cameras: Sequence[Camera],
    offsets: Mapping[str, int],
    upper: Mesh,
    lower: Mesh,
    config: TrackingConfig | None = None,
    *,
    threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> Tracks:
    """Track the hard frames again with the fitted model as a prior on the relative pose.

    The function changes final poses, `prior_aided`, and the uncertainties of lost frames. It leaves raw poses
    unchanged, so that no model is fitted to poses influenced by its own prior. Arguments are as for `track_capture`;
    `progress` is called with the number of hard frames done and their total.

    Raises:
        CaptureError: a mask cannot be read.
    """
    config = config or FOR_TAKES
    hard = np.flatnonzero(hard_frames(tracks))
    measured = np.asarray(np.isfinite(tracks.raw_T_upper_lower).all((1, 2)))
    good = measured & ~hard_frames(tracks)
    if not len(hard) or good.sum() < _FEWEST_POSES:
        return tracks
    scans = (prepare_scan(upper, "upper"), prepare_scan(lower, "lower"))
    table = {camera.name: camera for camera in corrected_cameras(cameras, tracks.meta)}
    middle = np.mean([transform_point(tracks.T_world_upper[good][0], s.centre) for s in scans], axis=0)
    prior = KinematicPrior(jaw, _model_spread_mm(jaw, tracks.raw_T_upper_lower[good]))
    starts = _starts(tracks, jaw, measured)
    found: dict[int, _Refined] = {}
    with (
        MaskViews(capture.cameras, table, offsets, middle, config.working_px_per_mm) as masks,
        ThreadPoolExecutor(threads) as pool,
    ):
        solver = ContourSolver(scans, config, pool if threads > 1 else None)
        second = _SecondPass(solver, prior, tracks)
        for done, k in enumerate(hard.tolist(), start=1):
            views = _corrected_views(masks.at(int(tracks.frames[k])), tracks, k, starts)
            refined = second.align(k, starts[k], views)
            if refined is not None:
                found[k] = refined
            if progress:
                progress(done, len(hard))
    return _merged(tracks, jaw, found)


@dataclass(frozen=True, eq=False)
class _Refined:
    """Poses of both arches in a frame (2, 4, 4), and the joint covariance (12, 12) of their left twists (world)."""

    poses: Array
    covariance: Array


class _SecondPass:
    """Aligns single frames with the prior, and rejects results that do not fit the masks."""

    def __init__(self, solver: ContourSolver, prior: KinematicPrior, tracks: Tracks) -> None:
        self._solver, self._config, self._prior, self._tracks = solver, solver.config, prior, tracks
        self._usual_px = np.nanmedian(np.where(tracks.status == TRACKED, tracks.residual_px, np.nan), axis=0)
        self._correlation_px = float(tracks.meta["correlation_px"])
        self._outline_weight = 1.0 / (self._usual_px**2 * self._correlation_px)

    def align(self, k: int, start: Array, views: Sequence[View]) -> _Refined | None:
        """Return the poses of frame index k aligned with the prior, or None if they are unreliable."""
        present = present_masks(views)
        lost = self._tracks.status[k] == LOST
        use = present & (self._tracks.masks_used[k] | lost[:, None])
        gates = self._config.wide_gates_px if lost.any() else self._config.gates_from(0.0)
        solution = self._solver.solve(start, views, gates, use, (self._prior,), self._outline_weight)
        covariance = joint_covariance(solution, self._prior, residual_px(solution), self._correlation_px)
        if covariance is None or not self._fits(solution, views, use, covariance):
            return None
        return _Refined(solution.poses, covariance)

    def _fits(self, solution: Solution, views: Sequence[View], use: Mask, covariance: Array) -> bool:
        c, jaw = self._config, self._prior.jaw
        coverage = coverage_error(*uncovered_px(self._solver.scans, solution.poses, views))
        uncovered = np.where(use & np.isfinite(coverage), coverage, 0.0).max()
        rough = residual_px(solution) > c.lost_residual * c.suspect_residual * self._usual_px
        few = matched_px(solution) < c.least_matched_px
        relative = relative_pose(*solution.poses)
        sigma = landmark_sigmas(relative, _relative_covariance(solution.poses, covariance), jaw.landmarks)
        masks_fit = uncovered <= c.lost_coverage and not rough.any() and not few.any()
        return bool(masks_fit and sigma.max() <= c.lost_sigma_mm and jaw.validate(relative).valid)


def _starts(tracks: Tracks, jaw: JawRig, measured: Mask) -> Array:
    """Return start poses of every frame, T_world_upper and T_world_lower (F, 2, 4, 4), interpolated where lost."""
    frames = tracks.frames.astype(np.float64)
    d = jaw.interpolate(frames[measured], jaw.encode(tracks.raw_T_upper_lower[measured], inside=True)[0], frames)
    relative = jaw.pose(d)
    upper, lower = tracks.T_world_upper.copy(), tracks.T_world_lower.copy()
    known = np.isfinite(upper).all((1, 2))
    by_jaw = ~known & np.isfinite(lower).all((1, 2))
    upper[by_jaw] = lower[by_jaw] @ se3_inverse(relative[by_jaw])
    known |= by_jaw
    index = np.flatnonzero(known)
    for k in np.flatnonzero(~known).tolist():
        after = int(np.searchsorted(index, k))
        a, b = index[max(after - 1, 0)], index[min(after, len(index) - 1)]
        share = 0.0 if a == b else (frames[k] - frames[a]) / (frames[b] - frames[a])
        upper[k] = se3_exp(share * se3_log(upper[b] @ se3_inverse(upper[a]))) @ upper[a]
    gone = ~np.isfinite(lower).all((1, 2))
    lower[gone] = upper[gone] @ relative[gone]
    return np.stack([upper, lower], axis=1)


def _corrected_views(views: Sequence[View], tracks: Tracks, k: int, poses: Array) -> list[View]:
    """Return the views of frame index k, corrected by the whole-take estimates of the first pass."""
    before, after = poses[max(k - 1, 0)], poses[min(k + 1, len(poses) - 1)]
    span = max(1, min(k + 1, len(poses) - 1) - max(k - 1, 0))
    velocity = se3_log(after @ se3_inverse(before)) / span  # twist of the arch per frame
    meta, out = tracks.meta, []
    steady = poses[k] @ np.array(meta.get("steady_error", np.tile(np.eye(4), (2, 1, 1)))) @ se3_inverse(poses[k])
    for name, view in zip(tracks.camera_names, views, strict=True):
        T_delay = se3_exp(meta["delays_frames"][name] * velocity) @ steady
        habits = np.column_stack([meta["outline_bias_px"][name], meta["gum_bias_px"][name], meta["gum_line_mm"]])
        out.append(replace(view, T_delay=T_delay, habits=habits))
    return out


def _relative_covariance(poses: Array, covariance: Array) -> Array:
    """Return the covariance of T_upper_lower's left twist (6, 6), from the joint covariance of both arches."""
    A = se3_adjoint(se3_inverse(poses[0]))
    slope = np.hstack([-A, A])
    return slope @ covariance @ slope.T


def _merged(tracks: Tracks, jaw: JawRig, found: Mapping[int, _Refined]) -> Tracks:
    """Return the tracks with the refined frames, smoothed again; the relative pose is smoothed separately."""
    upper, relative = tracks.raw_T_world_upper.copy(), tracks.raw_T_upper_lower.copy()
    covariance = {name: getattr(tracks, name).copy() for name in ("covariance_upper", "covariance_lower")}
    spread, smoothing = tracks.covariance_relative.copy(), tracks.covariance_relative.copy()
    sigma, status = tracks.sigma_mm.copy(), tracks.status.copy()
    lost = (tracks.status == LOST).any(1)
    for k, refined in found.items():
        upper[k], relative[k] = refined.poses[0], relative_pose(*refined.poses)
        smoothing[k] = _relative_covariance(refined.poses, refined.covariance)
        if lost[k]:
            covariance["covariance_upper"][k] = refined.covariance[:6, :6]
            covariance["covariance_lower"][k] = refined.covariance[6:, 6:]
            spread[k] = smoothing[k]
            sigma[k] = landmark_sigmas(relative[k], spread[k], jaw.landmarks)
            status[k] = np.where(status[k] == LOST, RECOVERED, status[k])
    head = np.nanmedian(upper[:, :3, 3], axis=0)
    upper = smooth_poses(tracks.frames, upper, covariance["covariance_upper"], head)
    relative = smooth_poses(tracks.frames, relative, smoothing, jaw.landmarks.mean(0))
    lower = tracks.T_world_lower.copy()
    both = np.isfinite(upper).all((1, 2)) & np.isfinite(relative).all((1, 2))
    lower[both] = upper[both] @ relative[both]
    return replace(
        tracks,
        T_world_upper=upper,
        T_world_lower=lower,
        T_upper_lower=relative,
        status=status,
        prior_aided=np.isin(np.arange(len(tracks.frames)), list(found)),
        covariance_relative=spread,
        sigma_mm=sigma,
        **covariance,
    )
