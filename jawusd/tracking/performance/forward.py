"""The first pass: alignment frame by frame from predictions, with re-acquisition of arches whose tracking was lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import transform_points
from jawusd.tracking.contour.equations import translation
from jawusd.tracking.contour.views import View
from jawusd.tracking.initialization.pose_search import shift_to_masks
from jawusd.tracking.performance.attempts import Attempts, FrameFit, Instant, empty_fit
from jawusd.tracking.performance.coordinates import Pose
from jawusd.tracking.performance.instant import Expected
from jawusd.tracking.performance.motion import STEADY, Prediction

_KEPT_JAWS = 12  # maximum number of jaw poses remembered as starts after a loss
# minimum distance of the lower incisal point between remembered poses: the solver converges from this distance
_APART_MM = 3.0
_FINALISTS = 3


class ForwardPass:
    """Aligns frame by frame in one temporal direction."""

    def __init__(self, attempts: Attempts, begin: FrameFit, *, fixed_head: bool = False) -> None:
        """Continue from the fit of a frame; with a fixed head, only the jaw moves."""
        self._attempts, self._coordinates = attempts, attempts.instants.coordinates
        self._motion = Prediction(self._coordinates, begin.pose, begin.found, head=STEADY if fixed_head else 1.0)
        self._jaws: list[Array] = []
        self._remember(begin)

    def step(self, views: Sequence[View]) -> FrameFit:
        """Align the next frame."""
        fit = self._fit(self._motion.expected(), self._attempts.instant(views))
        self._motion.take(fit.pose, fit.found)
        self._remember(fit)
        return fit

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
        for start in self._other_starts(expected, instant):
            around = replace(expected, pose=start)
            other = attempts.attempt(start, around, instant, instant.present, config.wide_gates_px)
            if other.objective(config.uncovered_price) > trial.objective(config.uncovered_price):
                trial = other
        fit = attempts.judged(trial, instant)
        if not fit.found.any():
            return replace(fit, pose=expected.pose)
        if fit.found.all() or not fit.missed.any():
            return fit
        # Align again without the arch that does not fit, since it would bias the other one.
        alone = attempts.attempt(expected.pose, expected, instant, fit.use, config.wide_gates_px)
        return attempts.judged(alone, instant)

    def _other_starts(self, expected: Expected, instant: Instant) -> list[Pose]:
        """Return further starts: the prediction, the last pose, and earlier jaw poses moved onto the masks."""
        jaws = [expected.pose.d, *(self._jaws if self._motion.blind.any() else ())]
        arch = 0 if instant.present[0].any() else 1
        scan, shifted = self._attempts.instants.solver.scans[arch], []
        for d in jaws:
            pose = replace(expected.pose, d=d)
            shift = shift_to_masks(scan, self._coordinates.arches(pose)[arch], arch, instant.views, instant.present)
            shifted.append(replace(pose, head=translation(shift) @ pose.head))
        if len(shifted) > _FINALISTS:
            scores = [self._score(pose, expected, instant) for pose in shifted]
            shifted = [shifted[k] for k in np.argsort(scores)[::-1][:_FINALISTS]]
        return [expected.pose, self._motion.last, *shifted]

    def _score(self, start: Pose, expected: Expected, instant: Instant) -> float:
        """Return the objective of a start pose after a few alignment steps [px]."""
        config, around = self._attempts.config, replace(expected, pose=start)
        trial = self._attempts.attempt(start, around, instant, instant.present, config.trial_gates_px)
        return trial.objective(config.uncovered_price)

    def _remember(self, fit: FrameFit) -> None:
        """Update the usual residual; keep the jaw pose as a later start if it differs from the poses kept so far."""
        self._attempts.remember(fit)
        if not fit.found.all():
            return
        jaw = self._coordinates.jaw
        place, *known = (transform_points(jaw.pose(d), jaw.landmarks[:1]) for d in (fit.pose.d, *self._jaws))
        if all(np.linalg.norm(place - other) > _APART_MM for other in known):
            self._jaws = [*self._jaws[-_KEPT_JAWS + 1 :], fit.pose.d]
