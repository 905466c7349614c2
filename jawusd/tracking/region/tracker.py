"""Follow both arches by the colours of the pictures alone, frame after frame."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from jawusd.geometry import Camera, se3_inverse
from jawusd.geometry.arrays import Array, Mask
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.quality import (
    matched_px,
    relative_covariance,
    residual_px,
    score_px,
    twist_covariance,
)
from jawusd.tracking.contour.scan import ARCHES, Scan, probe_points
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View
from jawusd.tracking.region.condyles import CondyleMotion, CondyleTerm
from jawusd.tracking.region.learned import CORRELATION_PX, FIRST_RATES, RATES, LearnedColours
from jawusd.tracking.region.picture import Cut, Picture
from jawusd.tracking.region.starts import head_shifts, likeliest, starts_everywhere, turned_starts
from jawusd.tracking.sequence.history import MotionPredictor

# Gates of an alignment, of the brief trial of a start, distance of contour samples, motion that redraws scans [px].
_GATES_PX, _TRIAL_GATES_PX, _SAMPLE_STEP_PX, _REDRAW_PX = (12.0, 8.0, 6.0, 4.0, 3.0, 2.5, 2.0), (8.0, 6.0), 2.0, 2.0
# Variance of borders times the length over which they err alike, against which expected condyles are weighed [px^3]:
# where the jaw is well seen, and in doubtful frames. With the greater one everywhere, the incisal points of two takes
# were 0.006 mm worse; with the lesser one a jaw drifted whose edges front teeth and lips hid.
_LOOSE_PX3, _FIRM_PX3 = 3.0, 15.0
# Contour that fits worth as much as a standard deviation squared of the condyles [px]: a sample beyond the gate costs
# Tukey's loss of 4.685^2 / 6, and samples err alike over the length above.
_STRAIN_PX = 0.5 * CORRELATION_PX * 6.0 / 4.685**2
_FIRST_ROUNDS = 3  # picks are a few tenths of a millimetre off; each round takes most of the rest
_FAST_MM = 1.0  # predicted motion from which other starts are tried as well
# Of the usual share of contour that fits, below which a jaw is searched, what was lost is not trusted again, and poses
# are given up. Wrong poses under closed lips had 0.25 at most, a jaw whose edges front teeth and lips hide 0.28. The
# usual share is that of the last frames, but no less than the last number times that of the first: lips that close
# slowly must not get to be usual.
_SUSPECT, _AGAIN, _LOST, _LEAST_USUAL = 0.6, 0.5, 0.25, 0.7
_USUAL_FRAMES = 15  # over which the usual contour is measured
# A lost jaw is searched on so many frames each once the head is found, then on every so-many-th, as a lost head always.
_EAGER, _OFTEN = 6, 4
_WIDE_MM = 40.0  # how far open a jaw is expected at most that was out of sight
_HOPEFUL, _FINALISTS = 24, 3  # starts of a search that are tried, and that are followed to the end


@dataclass(frozen=True, eq=False)
class RegionPose:
    """Hold where the teeth were found in a frame."""

    poses: Array  # T_world_upper and T_world_lower, shape (2, 4, 4); predictions for arches not found
    found: Mask  # shape (2,)
    covariance: Array  # of their left twists about the world origin, NaN for arches not found, shape (2, 6, 6)
    worth_px: float = 0.0  # contour of both arches that fits, closeness counted, less the strain of the condyles


class RegionTracker:
    """Follow both arches through pictures of several cameras; colours are learned on the way."""

    def __init__(
        self,
        scans: Sequence[Scan],
        cameras: Sequence[Camera],
        landmarks: Array,
        axes: Array,
        config: TrackingConfig | None = None,
        executor: Executor | None = None,
    ) -> None:
        """Prepare the scans.

        Args:
            scans: upper and lower, in one frame, in occlusion.
            cameras: in the order of the pictures.
            landmarks, axes: as in `CondyleMotion`.
        """
        config = replace(config or TrackingConfig(), sample_step_px=_SAMPLE_STEP_PX, redraw_px=_REDRAW_PX)
        self._solver = ContourSolver(scans, config, executor)
        self._least_px = config.least_matched_px
        self._condyles = CondyleMotion(landmarks, axes)
        self._loose, self._firm = (CondyleTerm(self._condyles, noise) for noise in (_LOOSE_PX3, _FIRM_PX3))
        self._axes = axes
        self._colours = LearnedColours(scans, cameras, axes)
        self._first_share = np.zeros(2)

    def begin(self, cut: Cut, poses: Array) -> RegionPose:
        """Learn the colours of a first frame from poses of a few tenths of a millimetre; return better poses."""
        self._colours.begin(cut(poses), poses)
        for _ in range(_FIRST_ROUNDS):
            pictures = cut(poses)
            solution = self._align(poses, self._colours.views(pictures, poses))
            poses = solution.poses
            self._learn(pictures, poses, poses, FIRST_RATES)
        self._first_share = _share(solution)
        return RegionPose(poses, np.ones(2, bool), self._covariance(solution), self._worth_px(solution))

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
        found, missed, absent = np.ones(2, bool), 0, 0
        for cut in cuts:
            starts = motion.starts()
            head, wide = starts[0][0], self._condyles.placed(0.0, _WIDE_MM, 0.0)
            pictures = cut(starts[0] if found[1] else np.stack([head, head @ wide]))
            views = self._colours.views(pictures, poses)
            wanted = np.median([*usual] or [self._first_share], axis=0)
            wanted = np.maximum(wanted, _LEAST_USUAL * self._first_share)
            solution = self._best(starts, views, poses)
            share = _share(solution)
            absent = absent + 1 if share[0] < _SUSPECT * wanted[0] and not found[0] else 0
            if absent % _OFTEN == 1:
                solution = self._with_head_searched(solution, starts[0], views)
                share = _share(solution)
            elif share[1] < _SUSPECT * wanted[1]:
                solution = self._align(starts[0], views, firm=True)
                share = _share(solution)
            missed = missed + 1 if share[0] >= _SUSPECT * wanted[0] and share[1] < _SUSPECT * wanted[1] else 0
            due = missed & (missed - 1) == 0 if found[1] else missed <= _EAGER or missed % _OFTEN == 0
            if missed and due:
                solution = self._searched(solution, starts[0], poses, views, motion, not found[1])
                share = _share(solution)
            least = np.where(found, _LOST, _AGAIN) * wanted
            found = (share >= least) & (matched_px(solution) >= self._least_px)
            before, poses = poses, np.where(found[:, None, None], solution.poses, motion.predict())
            covariance = np.where(found[:, None, None], self._covariance(solution), np.nan)
            if found.all():
                self._learn(pictures, poses, before, RATES)
                self._condyles.learn(poses, relative_covariance(poses[0], *covariance))
                usual.append(share)
            seen = np.full(2, any(picture is not None for picture in pictures))
            motion.update(poses, found, seen)
            yield RegionPose(poses, found, covariance, self._worth_px(solution))

    def _covariance(self, solution: Solution) -> Array:
        """Return the covariance of both arches' left world twists, shape (2, 6, 6)."""
        sigma = residual_px(solution)
        return np.stack([twist_covariance(solution, r, float(sigma[r]), CORRELATION_PX) for r in ARCHES])

    def _best(self, starts: list[Array], views: list[View], last: Array) -> Solution:
        """Align from the prediction, and from other starts where the teeth are fast."""
        solution = self._align(starts[0], views)
        if np.abs(starts[0][:, :3, 3] - last[:, :3, 3]).max() > _FAST_MM:
            carried = solution.poses[0] @ se3_inverse(last[0]) @ last[1]
            for start in (last, np.stack([solution.poses[0], carried])):
                solution = self._better(solution, self._align(start, views))
        return solution

    def _searched(
        self,
        solution: Solution,
        predicted: Array,
        last: Array,
        views: list[View],
        motion: MotionPredictor,
        everywhere: bool,
    ) -> Solution:
        """Try earlier poses of the jaw, turned ones, and if asked for any, with the head as it was found."""
        jaws = [se3_inverse(poses[0]) @ poses[1] for poses in (last, *motion.pose_history())]
        bases = (se3_inverse(predicted[0]) @ predicted[1], jaws[0])
        jaws += turned_starts(self._condyles, bases)
        if everywhere:
            jaws += starts_everywhere(self._condyles)
        head = solution.poses[0]
        order = likeliest([head @ jaw for jaw in jaws], views, self._solver.scans, 1)[:_HOPEFUL]
        pairs = (np.stack([head, head @ jaws[k]]) for k in order)
        brief = [self._align(pair, views, _TRIAL_GATES_PX, firm=True) for pair in pairs]
        brief.sort(key=lambda trial: -self._worth_px(trial))
        for trial in brief[:_FINALISTS]:
            solution = self._better(solution, self._align(trial.poses, views, firm=True))
        return solution

    def _with_head_searched(self, solution: Solution, predicted: Array, views: list[View]) -> Solution:
        """Try shifted poses of the head, which the jaw goes with."""
        shifts = head_shifts(predicted[0], self._axes)
        order = likeliest(list(shifts @ predicted[0]), views, self._solver.scans, 0)[: _HOPEFUL // 2]
        brief = [self._align(shifts[k] @ predicted, views, _TRIAL_GATES_PX, firm=True) for k in order]
        brief.sort(key=lambda trial: -float(score_px(trial)[0].sum()))
        best = [self._align(trial.poses, views, firm=True) for trial in brief[:_FINALISTS]]
        return max((solution, *best), key=lambda trial: float(score_px(trial)[0].sum()))

    def _worth_px(self, solution: Solution) -> float:
        """Return how much contour fits, less what it costs to have the condyles where they are not expected [px]."""
        return float(score_px(solution).sum()) - _STRAIN_PX * self._condyles.strain(solution.poses)

    def _better(self, one: Solution, other: Solution) -> Solution:
        """Return the likelier one."""
        return other if self._worth_px(other) > self._worth_px(one) else one

    def _align(
        self, start: Array, views: Sequence[View], gates_px: Sequence[float] = _GATES_PX, firm: bool = False
    ) -> Solution:
        return self._solver.solve(start, views, gates_px, None, (self._firm if firm else self._loose,))

    def _learn(
        self, pictures: Sequence[Picture | None], poses: Array, before: Array, rates: tuple[float, float]
    ) -> None:
        views = self._colours.counting(self._colours.views(pictures, before))
        self._solver.solve(poses, views, ())
        self._colours.learn(views, pictures, poses, rates)


def _share(solution: Solution) -> Array:
    """Return how much of the contour in sight fits, per arch, shape (2,)."""
    return np.asarray(score_px(solution).sum(1) / np.maximum(solution.visible_px.sum(1), 1.0), np.float64)
