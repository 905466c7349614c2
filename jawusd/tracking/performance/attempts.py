"""Attempts to align the scans in one video frame, and their acceptance."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.quality import (
    coverage_error,
    fitting_share,
    matched_px,
    penalised_score_px,
    residual_px,
    score_px,
    view_residual_px,
)
from jawusd.tracking.contour.rendering import Rendering
from jawusd.tracking.contour.scan import ARCHES, CROWN
from jawusd.tracking.contour.views import FEWEST_MASKS, View, present_masks
from jawusd.tracking.performance.coordinates import Pose
from jawusd.tracking.performance.instant import Expected, InstantSolver
from jawusd.tracking.performance.views import Growth

#: Upper bounds on the standard deviations of head rotation, head translation and jaw after many frames without visible
#: teeth [rad, mm, mm].
LARGEST_SIGMA = np.r_[[0.3] * 3, [30.0] * 3, [10.0] * 3]
_LEAST_MATCHED_PX = 15.0  # matched contour below which an arch is rejected [px]: 2 mm of tooth edge
_BEST_STARTS = 3  # number of starts, chosen after a few alignment steps, that are aligned fully
_TYPICAL_PX = 0.4  # typical residual of hand-drawn masks at the working resolution [px]
_TYPICAL_UNCOVERED = 0.01  # fraction of a mask that good poses leave uncovered [-]
_TYPICAL_SHARE = 0.5  # matched fraction of the visible contour at good poses [-]


@dataclass(frozen=True, eq=False)
class FrameFit:
    """Result of aligning one frame."""

    pose: Pose  # measured or extrapolated pose of head and jaw
    solution: Solution | None  # matched outlines at the pose; None without any mask
    use: Mask  # whether each mask is used, shape (2, C): true for available masks of arches that were found
    present: Mask  # whether each mask is available, shape (2, C)
    uncovered: Array  # fraction of every mask that is not covered by the scan, NaN without a mask, shape (2, C)
    growth: Growth | None = None  # derivatives of the outlines with respect to unknown focal lengths
    uncertain: bool = False  # whether less of the contour fits than usual, so that the pose may be wrong
    objective_px: float = 0.0  # score that ranks poses of this frame [px]; see `Trial.objective`

    @property
    def found(self) -> Mask:
        """Whether each arch was found, shape (2,)."""
        return np.asarray(self.use.any(1))

    @property
    def missed(self) -> Mask:
        """Whether each arch has masks but was not found, shape (2,)."""
        return np.asarray(self.present.any(1) & ~self.found)


@dataclass(frozen=True, eq=False)
class Trial:
    """An alignment attempt; uncovered and total pixels of the masks have shape (2, C)."""

    pose: Pose
    solution: Solution
    use: Mask
    uncovered_px: Array
    mask_px: Array

    def objective(self, price: float) -> float:
        """Return the score that ranks attempts: the matched contour minus the penalty for uncovered mask [px]."""
        return float(np.where(self.use, penalised_score_px(self.solution, self.uncovered_px, price), 0.0).sum())

    @property
    def uncovered(self) -> Array:
        """Return the uncovered fraction of every mask; NaN without a mask."""
        return coverage_error(self.uncovered_px, self.mask_px)


@dataclass(frozen=True, eq=False)
class Instant:
    """Views of one frame, and the rendering shared by all attempts on it."""

    views: Sequence[View]
    rendering: Rendering
    present: Mask  # whether each mask is available, shape (2, C)


class Usual(NamedTuple):
    """Usual quality of good alignments, per arch."""

    residual_px: Array  # standard deviation of the residuals [px], shape (2,)
    uncovered: Array  # mean uncovered fraction of the masks [-], shape (2,)
    share: Array  # matched fraction of the visible contour [-], shape (2,)


class Attempts:
    """Aligns single frames, and accepts or rejects results by comparison with the usual quality in the take."""

    def __init__(self, instants: InstantSolver, outline_weight: Array, usual: Usual | None = None) -> None:
        """Prepare with the `outline_weight` of `InstantSolver.align`, and the usual quality in the take, if known."""
        self.instants, self.config, self._weight = instants, instants.config, outline_weight
        self._aligned: deque[Usual] = deque(maxlen=self.config.history_frames)
        if usual is not None:
            self._aligned.append(usual)

    def instant(self, views: Sequence[View]) -> Instant:
        """Prepare the data shared by all attempts on the frame with these views."""
        return Instant(views, self.instants.solver.rendering(views), present_masks(views))

    def remember(self, fit: FrameFit) -> None:
        """Add a frame to the statistics of the usual quality."""
        if fit.solution is not None and fit.found.all():
            self._aligned.append(usual_of([fit]))

    def near(self, start: Pose, instant: Instant, sigma: Array = LARGEST_SIGMA) -> FrameFit:
        """Align a frame near a start pose with given standard deviations (9,); reject arches that do not fit."""
        if not instant.present.any():
            return empty_fit(start, instant)
        expected = Expected(start, sigma**-2.0)
        trial = self.attempt(start, expected, instant, instant.present, self.config.wide_gates_px)
        return self.judged(self.without_wrong_masks(trial, expected, instant), instant)

    def attempt(self, start: Pose, expected: Expected, instant: Instant, use: Mask, gates: Sequence[float]) -> Trial:
        """Align from a start pose with a subset of the masks, shape (2, C)."""
        views, rendering = instant.views, instant.rendering
        aligned = self.instants.align(start, views, use, gates, expected, self._weight, rendering)
        uncovered, total = np.zeros(use.shape), np.zeros(use.shape)
        for r, c in np.argwhere(use):
            mask = views[c].masks[r] > 127
            total[r, c] = mask.sum()
            uncovered[r, c] = (mask & (rendering.labels[c][r] != CROWN)).sum()
        return Trial(aligned.pose, aligned.solution, use, uncovered, total)

    def best_starts(self, starts: Sequence[Pose], precision: Array, instant: Instant) -> list[Pose]:
        """Return the few start poses that fit best after a few alignment steps, the best one first.

        `precision` (9,) is that of `Expected`, about each start.
        """
        config = self.config

        def score(start: Pose) -> float:
            expected = Expected(start, precision)
            trial = self.attempt(start, expected, instant, instant.present, config.trial_gates_px)
            return trial.objective(config.uncovered_price)

        return sorted(starts, key=score, reverse=True)[:_BEST_STARTS]

    def bad(self, trial: Trial) -> Mask:
        """Return which arches do not fit their masks, shape (2,)."""
        c = self.config
        usual = self._usual
        rough = ~(residual_px(trial.solution) <= self._largest_residual_px)
        wrong = self.wrong_masks(trial.solution, trial.use).any(1)
        uncovered = np.where(trial.use, trial.uncovered, 0.0).max(1) > c.lost_coverage
        few = matched_px(trial.solution) < _LEAST_MATCHED_PX
        # Pixels that are usually uncovered are exempt: errors of a long outline would outweigh a short matched contour.
        unusual_px = trial.uncovered_px - usual.uncovered[:, None] * trial.mask_px
        score = penalised_score_px(trial.solution, unusual_px, c.uncovered_price)
        outweighed = (trial.use & (score <= 0.0)).any(1)
        return np.asarray(trial.use.any(1) & (rough | wrong | uncovered | few | outweighed))

    def wrong_masks(self, solution: Solution, use: Mask) -> Mask:
        """Return which of the used masks fit far worse than is usual, and little of the contour, shape (2, C).

        Masks are judged one by one, since the others of the arch would conceal a wrong one.
        """
        rough = ~(view_residual_px(solution) <= self._largest_residual_px[:, None])
        shares = score_px(solution) / np.maximum(solution.visible_px, 1.0)
        return np.asarray(use & rough & (shares < self.config.alarming_score * self._usual.share[:, None]))

    @property
    def _largest_residual_px(self) -> Array:
        """Return the largest acceptable standard deviation of an arch's residuals [px], shape (2,)."""
        return self.config.lost_residual * self.config.suspect_residual * self._usual.residual_px

    @property
    def _usual(self) -> Usual:
        """Return the medians over recent alignments; before the first one, no residual is too large."""
        if not self._aligned:
            return Usual(np.full(2, np.inf), np.full(2, _TYPICAL_UNCOVERED), np.full(2, _TYPICAL_SHARE))
        return Usual(*(np.median(values, axis=0) for values in zip(*self._aligned, strict=True)))

    def without_wrong_masks(self, trial: Trial, expected: Expected, instant: Instant) -> Trial:
        """Leave out a single mask of each arch that does not fit, if the arch then fits its other masks.

        Each of two masks may fit without the other, so the result that is nearest to the expected pose is kept.
        """

        def distance(other: Trial) -> float:
            return float(expected.precision @ self.instants.coordinates.step(expected.pose, other.pose) ** 2)

        for r in ARCHES:
            masks = np.flatnonzero(trial.use[r])
            if not self.bad(trial)[r] or not self._spare(trial, r):
                continue  # a wrong pose is more likely than a wrong mask
            others = []
            for c in masks.tolist():
                use = trial.use.copy()
                use[r, c] = False
                others.append(self.attempt(expected.pose, expected, instant, use, self.config.wide_gates_px))
            fitting = [other for other in others if not self.bad(other)[r]]
            trial = min(fitting, key=distance, default=trial)
        return trial

    def _spare(self, trial: Trial, arch: int) -> bool:
        """Return whether an arch has a mask to spare: one of two does if the other arch and the past are known."""
        own, other = trial.use[arch].sum(), trial.use[1 - arch].sum()
        return bool(own > FEWEST_MASKS or (own == FEWEST_MASKS <= other and self._aligned))

    def judged(self, trial: Trial, instant: Instant) -> FrameFit:
        """Return the attempt as a frame fit, excluding arches that do not fit their masks."""
        use = trial.use & ~self.bad(trial)[:, None]
        objective_px = replace(trial, use=use).objective(self.config.uncovered_price)
        return FrameFit(trial.pose, trial.solution, use, instant.present, trial.uncovered, objective_px=objective_px)


def empty_fit(pose: Pose, instant: Instant) -> FrameFit:
    """Return the fit of a frame without masks, at the expected pose."""
    none = np.zeros_like(instant.present)
    return FrameFit(pose, None, none, instant.present, np.full(none.shape, np.nan))


def usual_of(fits: Iterable[FrameFit]) -> Usual:
    """Return the medians over the fits in which an arch was found; typical values if there is none."""
    listed = [
        (residual_px(fit.solution), _mean_uncovered(fit), fitting_share(fit.solution), fit.found)
        for fit in fits
        if fit.solution is not None
    ]

    def median(column: int, typical: float) -> Array:
        values = [[row[column][r] for row in listed if row[-1][r]] for r in ARCHES]
        return np.array([np.median(own) if own else typical for own in values])

    return Usual(*(median(k, typical) for k, typical in enumerate((_TYPICAL_PX, _TYPICAL_UNCOVERED, _TYPICAL_SHARE))))


def _mean_uncovered(fit: FrameFit) -> Array:
    """Return the mean uncovered fraction of the used masks of each arch [-], shape (2,); 0 without any."""
    return np.asarray(np.where(fit.use, fit.uncovered, 0.0).sum(1) / np.maximum(fit.use.sum(1), 1))
