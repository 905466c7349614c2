"""The first pass: alignment frame by frame from predictions, with re-acquisition of arches whose tracking was lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from jawusd.base.arrays import Array
from jawusd.tracking.contour.equations import translation
from jawusd.tracking.contour.views import View
from jawusd.tracking.initialization.pose_search import shift_to_masks
from jawusd.tracking.performance.attempts import Attempts, FrameFit, Instant, Trial, empty_fit
from jawusd.tracking.performance.coordinates import Pose
from jawusd.tracking.performance.instant import Expected
from jawusd.tracking.performance.motion import STEADY, Prediction
from jawusd.tracking.performance.single_start import JAWS, spread_out


class ForwardPass:
    """Aligns frame by frame in one temporal direction."""

    def __init__(self, attempts: Attempts, begin: FrameFit, *, fixed_head: bool = False) -> None:
        """Continue from the fit of a frame; with a fixed head, only the jaw moves."""
        self._attempts, self._coordinates = attempts, attempts.instants.coordinates
        self._motion = Prediction(self._coordinates, begin.pose, begin.found, head=STEADY if fixed_head else 1.0)
        attempts.remember(begin)

    def step(self, views: Sequence[View]) -> FrameFit:
        """Align the next frame."""
        fit = self._fit(self._motion.expected(), self._attempts.instant(views))
        self._motion.take(fit.pose, fit.found)
        self._attempts.remember(fit)
        return fit

    @cached_property
    def _jaws(self) -> Array:
        """Jaw parameters over the whole range [mm], shape (n, 3); few walks need them."""
        return spread_out(self._coordinates.jaw, JAWS)

    def _fit(self, expected: Expected, instant: Instant) -> FrameFit:
        attempts, config = self._attempts, self._attempts.config
        if not instant.present.any():
            return empty_fit(expected.pose, instant)
        gates = config.gates_from(config.first_gate_px)
        trial = attempts.attempt(expected.pose, expected, instant, instant.present, gates)
        if not attempts.bad(trial).any():
            return attempts.judged(trial, instant)
        trial = attempts.without_wrong_masks(trial, expected, instant)
        if not attempts.bad(trial).any():
            return attempts.judged(trial, instant)
        trial = self._best_of([expected.pose, self._motion.last], trial, expected, instant)
        if attempts.bad(trial).any():
            trial = self._best_of(self._far_starts(trial, expected, instant), trial, expected, instant)
        fit = attempts.judged(trial, instant)
        if not fit.found.any():
            return replace(fit, pose=expected.pose)
        if fit.found.all() or not fit.missed.any():
            return fit
        # Align again without the arch that does not fit, since it would bias the other one.
        alone = attempts.attempt(expected.pose, expected, instant, fit.use, config.wide_gates_px)
        return attempts.judged(alone, instant)

    def _best_of(self, starts: Sequence[Pose], trial: Trial, expected: Expected, instant: Instant) -> Trial:
        """Return the best alignment from the start poses, or the given one if it is better."""
        attempts, config = self._attempts, self._attempts.config
        others = [
            attempts.attempt(start, replace(expected, pose=start), instant, instant.present, config.wide_gates_px)
            for start in starts
        ]
        return max(trial, *others, key=lambda one: one.objective(config.uncovered_price))

    def _far_starts(self, trial: Trial, expected: Expected, instant: Instant) -> list[Pose]:
        """Return the best of start poses with the jaw over its whole range.

        An arch of the trial that fits stays in place; else the expected head is moved onto the masks.
        """
        jaws = [expected.pose.d, *self._jaws]
        fitting = np.flatnonzero(trial.use.any(1) & ~self._attempts.bad(trial))
        if len(fitting):
            poses = [self._coordinates.with_jaw(trial.pose, d, int(fitting[0])) for d in jaws]
        else:
            poses = [self._onto_masks(replace(expected.pose, d=d), instant) for d in jaws]
        return self._attempts.best_starts(poses, expected.precision, instant)

    def _onto_masks(self, pose: Pose, instant: Instant) -> Pose:
        """Return the pose, moved in the image so that an arch is centred on its masks."""
        arch = 0 if instant.present[0].any() else 1
        scan, at = self._attempts.instants.solver.scans[arch], self._coordinates.arches(pose)[arch]
        shift = shift_to_masks(scan, at, arch, instant.views, instant.present)
        return replace(pose, head=translation(shift) @ pose.head)
