"""Follow both arches by the colours of the pictures alone, frame after frame."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from jawusd.geometry import Camera, se3_exp, se3_inverse
from jawusd.geometry.arrays import Array, Mask
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution, translation
from jawusd.tracking.contour.quality import matched_px, residual_px, score_px, twist_covariance
from jawusd.tracking.contour.scan import ARCHES, Scan, probe_points
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View
from jawusd.tracking.region.condyles import CondyleTerm
from jawusd.tracking.region.learned import FIRST_RATES, RATES, LearnedColours, Picture
from jawusd.tracking.sequence.history import MotionPredictor

# Gates of an alignment, of the brief trial of a start, distance of contour samples, motion that redraws scans [px].
_GATES_PX, _TRIAL_GATES_PX, _SAMPLE_STEP_PX, _REDRAW_PX = (12.0, 8.0, 6.0, 4.0, 3.0, 2.5, 2.0), (8.0, 6.0), 2.0, 2.0
# Contour length over which borders of colours err alike: lips and shadows move those of whole teeth [px]. With the
# length of drawn masks, 18, the NEES of the relative pose was 3.8 and 9.4 on a path-traced and a rasterised take.
_CORRELATION_PX = 110.0
_FIRST_ROUNDS = 3  # picks are a few tenths of a millimetre off; each round takes most of the rest
_FAST_MM = 1.0  # predicted motion from which other starts are tried as well
_SUSPECT, _LOST = 0.6, 0.33  # of the usual share of contour that fits, below which poses are doubted, and given up
_USUAL_FRAMES = 15  # over which the usual contour is measured
_FINALISTS = 3  # starts of a search that are followed to the end
_OPENED, _ASIDE = (
    (-6.0, -4.5, -3.0, -1.5, 1.5, 3.0, 4.5, 6.0),
    (-4.0, -2.0, 2.0, 4.0),
)  # turns of the jaw tried [degrees]


#: Cuts the pictures of an instant, one per camera or None, around T_world_upper and T_world_lower, shape (2, 4, 4).
Cut = Callable[[Array], Sequence[Picture | None]]


@dataclass(frozen=True, eq=False)
class RegionPose:
    """Hold where the teeth were found in a frame."""

    poses: Array  # T_world_upper and T_world_lower, shape (2, 4, 4); predictions for arches not found
    found: Mask  # shape (2,)
    covariance: Array  # of their left twists about the world origin, NaN for arches not found, shape (2, 6, 6)
    worth_px: float = 0.0  # contour of both arches that fits, closeness counted


class RegionTracker:
    """Follow both arches through pictures of several cameras; colours are learned on the way."""

    def __init__(
        self,
        scans: Sequence[Scan],
        cameras: Sequence[Camera],
        condyles: Array,
        axes: Array,
        config: TrackingConfig | None = None,
        executor: Executor | None = None,
    ) -> None:
        """Prepare the scans.

        Args:
            scans: upper and lower, in one frame, in occlusion.
            cameras: in the order of the pictures.
            condyles, axes: as in `CondyleTerm`.
        """
        config = replace(config or TrackingConfig(), sample_step_px=_SAMPLE_STEP_PX, redraw_px=_REDRAW_PX)
        self._solver = ContourSolver(scans, config, executor)
        self._least_px = config.least_matched_px
        self._terms = (CondyleTerm(condyles, axes),)
        self._hinge = np.mean(condyles, axis=0)
        self._axes = axes
        self._colours = LearnedColours(scans, cameras, axes)

    def begin(self, cut: Cut, poses: Array) -> RegionPose:
        """Learn the colours of a first frame from poses of a few tenths of a millimetre; return better poses."""
        self._colours.begin(cut(poses), poses)
        for _ in range(_FIRST_ROUNDS):
            pictures = cut(poses)
            solution = self._align(poses, self._colours.views(pictures, poses))
            poses = solution.poses
            self._learn(pictures, poses, poses, FIRST_RATES)
        return RegionPose(poses, np.ones(2, bool), self._covariance(solution), float(score_px(solution).sum()))

    def follow(self, cuts: Iterator[Cut], poses: Array) -> Iterator[RegionPose]:
        """Yield poses frame after frame, away from the first one, whose poses are given.

        Every call starts from what is known after `begin`.
        """
        known, self._colours = self._colours, self._colours.copy()
        try:
            yield from self._followed(cuts, poses)
        finally:
            self._colours = known

    def _followed(self, cuts: Iterator[Cut], poses: Array) -> Iterator[RegionPose]:
        motion = MotionPredictor(poses, probe_points(self._solver.scans))
        motion.remember(poses, np.ones(2, bool))
        usual: deque[Array] = deque(maxlen=_USUAL_FRAMES)
        for cut in cuts:
            starts = motion.starts()
            pictures = cut(starts[0])
            views = self._colours.views(pictures, poses)
            solution = self._best(starts, views, poses, motion, usual)
            share = _share(solution)
            least = _LOST * np.median(usual, axis=0) if usual else np.zeros(2)
            found = (share >= least) & (matched_px(solution) >= self._least_px)
            before, poses = poses, np.where(found[:, None, None], solution.poses, motion.predict())
            if found.all():
                self._learn(pictures, poses, before, RATES)
                usual.append(share)
            seen = np.full(2, any(picture is not None for picture in pictures))
            motion.update(poses, found, seen)
            covariance = np.where(found[:, None, None], self._covariance(solution), np.nan)
            yield RegionPose(poses, found, covariance, float(score_px(solution).sum()))

    def _covariance(self, solution: Solution) -> Array:
        """Return the covariance of both arches' left world twists, shape (2, 6, 6)."""
        sigma = residual_px(solution)
        return np.stack([twist_covariance(solution, r, float(sigma[r]), _CORRELATION_PX) for r in ARCHES])

    def _best(
        self, starts: list[Array], views: list[View], last: Array, motion: MotionPredictor, usual: deque[Array]
    ) -> Solution:
        """Align from the prediction, and from other starts where that may fail."""
        solution = self._align(starts[0], views)
        if np.abs(starts[0][:, :3, 3] - last[:, :3, 3]).max() > _FAST_MM:
            carried = solution.poses[0] @ se3_inverse(last[0]) @ last[1]
            for start in (last, np.stack([solution.poses[0], carried])):
                solution = _better(solution, self._align(start, views))
        if not usual:
            return solution
        wanted = _SUSPECT * np.median(usual, axis=0)
        if (_share(solution) < wanted).any() and motion.search_is_due():
            solution = self._searched(solution, starts[0], last, views, motion)
        return solution

    def _searched(
        self, solution: Solution, predicted: Array, last: Array, views: list[View], motion: MotionPredictor
    ) -> Solution:
        """Try earlier poses of the jaw, and turned ones, with the head as it was found."""
        jaws = [se3_inverse(poses[0]) @ poses[1] for poses in (last, *motion.pose_history())]
        bases = (se3_inverse(predicted[0]) @ predicted[1], jaws[0])
        turns = [np.deg2rad(a) * self._axes[0] for a in _OPENED] + [np.deg2rad(a) * self._axes[1] for a in _ASIDE]
        for turn in turns:
            about = translation(self._hinge) @ se3_exp(np.append(turn, np.zeros(3))) @ translation(-self._hinge)
            jaws += [base @ about for base in bases]
        head = solution.poses[0]
        brief = [self._align(np.stack([head, head @ jaw]), views, _TRIAL_GATES_PX) for jaw in jaws]
        brief.sort(key=lambda trial: -float(score_px(trial)[1].sum()))
        for trial in brief[:_FINALISTS]:
            solution = _better(solution, self._align(trial.poses, views))
        return solution

    def _align(self, start: Array, views: Sequence[View], gates_px: Sequence[float] = _GATES_PX) -> Solution:
        return self._solver.solve(start, views, gates_px, None, self._terms)

    def _learn(
        self, pictures: Sequence[Picture | None], poses: Array, before: Array, rates: tuple[float, float]
    ) -> None:
        views = self._colours.counting(self._colours.views(pictures, before))
        self._solver.solve(poses, views, ())
        self._colours.learn(views, pictures, poses, rates)


def _share(solution: Solution) -> Array:
    """Return how much of the contour in sight fits, per arch, shape (2,)."""
    return np.asarray(score_px(solution).sum(1) / np.maximum(solution.visible_px.sum(1), 1.0), np.float64)


def _better(one: Solution, other: Solution) -> Solution:
    """Return the one with more contour that fits."""
    return other if score_px(other).sum() > score_px(one).sum() else one
