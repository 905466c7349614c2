"""Attempts at one instant, and whether the pictures bear them out."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.quality import matched_px, residual_px, score_px
from jawusd.tracking.contour.rendering import Rendering
from jawusd.tracking.contour.scan import ARCHES, CROWN
from jawusd.tracking.contour.views import View, present_masks
from jawusd.tracking.performance.coordinates import Pose
from jawusd.tracking.performance.instant import Expected, InstantSolver
from jawusd.tracking.performance.views import Growth

#: How unsure head and jaw are at most, standard deviations [rad, mm, mm]: after many frames without teeth.
MOST_UNSURE = np.r_[[0.3] * 3, [30.0] * 3, [10.0] * 3]
# Matched contour below which an arch tells nothing [px]: 2 mm of tooth edge. Without a rig more is needed.
_LEAST_MATCHED_PX = 15.0
_TYPICAL_PX = 0.4  # residual of masks by hand at the working size


@dataclass(frozen=True, eq=False)
class FrameFit:
    """Hold what is known about a frame.

    Attributes:
        pose: where head and jaw are, found or carried on.
        solution: the outlines there, None without any mask.
        use: the masks whose outlines count, shape (2, C): present ones of arches that were found.
        present: the masks there are, shape (2, C).
        uncovered: share of every mask the scan leaves uncovered, NaN without one, shape (2, C).
        growth: how the outlines grow with focal lengths, where these are unknown.
        doubtful: less of the contour fits than usual, so that another pose may be right.
    """

    pose: Pose
    solution: Solution | None
    use: Mask
    present: Mask
    uncovered: Array
    growth: Growth | None = None
    doubtful: bool = False

    @property
    def found(self) -> Mask:
        """Which arches were found, shape (2,)."""
        return np.asarray(self.use.any(1))

    @property
    def missed(self) -> Mask:
        """Which arches have masks that nothing fits, shape (2,)."""
        return np.asarray(self.present.any(1) & ~self.found)


@dataclass(frozen=True, eq=False)
class Trial:
    """Hold an attempt at an instant; uncovered pixels and all pixels of the masks have shape (2, C)."""

    pose: Pose
    solution: Solution
    use: Mask
    uncovered_px: Array
    mask_px: Array

    def objective(self, price: float) -> float:
        """Return what ranks attempts: contour that fits less the price of uncovered mask [px]."""
        return float((score_px(self.solution) - price * self.uncovered_px)[self.use].sum())

    @property
    def uncovered(self) -> Array:
        """Return the uncovered share of every mask, NaN without one."""
        return np.where(self.mask_px > 0, self.uncovered_px / np.maximum(self.mask_px, 1), np.nan)


@dataclass(frozen=True, eq=False)
class Instant:
    """Hold the pictures of one instant, drawn into by all attempts."""

    views: Sequence[View]
    rendering: Rendering
    present: Mask  # the masks there are, shape (2, C)


class Attempts:
    """Align instants, and judge by what is usual in the take."""

    def __init__(self, instants: InstantSolver, outline_weight: Array, usual_px: Array | None = None) -> None:
        """Start with a known residual of good frames per arch, shape (2,), or none.

        The outline weight is that of `InstantSolver.align`.
        """
        self.instants, self.config, self._weight = instants, instants.config, outline_weight
        self._residuals: deque[Array] = deque(maxlen=self.config.history_frames)
        if usual_px is not None:
            self._residuals.append(usual_px)

    def instant(self, views: Sequence[View]) -> Instant:
        """Return what attempts at these pictures share."""
        return Instant(views, self.instants.solver.rendering(views), present_masks(views))

    def remember(self, fit: FrameFit) -> None:
        """Take a frame as an example of what is usual."""
        if fit.solution is not None and fit.found.all():
            self._residuals.append(residual_px(fit.solution))

    def near(self, start: Pose, instant: Instant, sigma: Array = MOST_UNSURE) -> FrameFit:
        """Align an instant near a start that is off by standard deviations of shape (9,), and judge."""
        if not instant.present.any():
            return nothing_seen(start, instant)
        expected = Expected(start, sigma**-2.0)
        return self.judged(self.attempt(start, expected, instant, instant.present, self.config.wide_gates_px), instant)

    def attempt(self, start: Pose, expected: Expected, instant: Instant, use: Mask, gates: Sequence[float]) -> Trial:
        """Align with some masks, shape (2, C), from a start."""
        views, rendering = instant.views, instant.rendering
        aligned = self.instants.align(start, views, use, gates, expected, self._weight, rendering)
        uncovered, total = np.zeros(use.shape), np.zeros(use.shape)
        for r, c in np.argwhere(use):
            mask = views[c].masks[r] > 127
            total[r, c] = mask.sum()
            uncovered[r, c] = (mask & (rendering.labels[c][r] != CROWN)).sum()
        return Trial(aligned.pose, aligned.solution, use, uncovered, total)

    def bad(self, trial: Trial) -> Mask:
        """Tell which arches have masks that the pose does not fit, shape (2,)."""
        c = self.config
        usual = np.median(self._residuals, axis=0) if self._residuals else np.full(2, np.inf)
        rough = ~(residual_px(trial.solution) <= c.lost_residual * c.suspect_residual * usual)
        uncovered = np.where(trial.use, trial.uncovered, 0.0).max(1) > c.lost_coverage
        few = matched_px(trial.solution) < _LEAST_MATCHED_PX
        return np.asarray(trial.use.any(1) & (rough | uncovered | few))

    def judged(self, trial: Trial, instant: Instant) -> FrameFit:
        """Return the attempt without the arches that it does not fit."""
        use = trial.use & ~self.bad(trial)[:, None]
        return FrameFit(trial.pose, trial.solution, use, instant.present, trial.uncovered)


def nothing_seen(pose: Pose, instant: Instant) -> FrameFit:
    """Return the fit of an instant that shows nothing, at the pose that is expected."""
    none = np.zeros_like(instant.present)
    return FrameFit(pose, None, none, instant.present, np.full(none.shape, np.nan))


def usual_residual_px(fits: Iterable[FrameFit]) -> Array:
    """Return the median residual of the arches that were found [px], shape (2,)."""
    listed = [(residual_px(fit.solution), fit.found) for fit in fits if fit.solution is not None]
    values = [[residual[r] for residual, found in listed if found[r]] for r in ARCHES]
    return np.array([np.median(own) if own else _TYPICAL_PX for own in values])
