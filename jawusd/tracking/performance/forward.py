"""The first pass: frame after frame from predictions, lost and found again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jawusd.geometry import transform_points
from jawusd.geometry.arrays import Array
from jawusd.tracking.contour.equations import translation
from jawusd.tracking.contour.views import View
from jawusd.tracking.initialization.reacquire import shift_to_masks
from jawusd.tracking.performance.attempts import MOST_UNSURE, Attempts, FrameFit, Instant, nothing_seen
from jawusd.tracking.performance.coordinates import LOCAL, Pose
from jawusd.tracking.performance.instant import Expected

# How far a prediction may be off, standard deviations [rad, mm, mm]: that of fast chewing at 24 frames a second. It
# only has to keep finite what the pictures leave free; the smoother knows better.
_MISS = np.r_[[0.01] * 3, [0.7] * 3, [0.7] * 3]
_FIXED = np.r_[[0.05] * 6, [1.0] * 3]  # share of it with a head that does not move before the cameras
_DAMPING = 0.8  # of the velocity: a stroke ends sooner than it goes on
_KEPT_JAWS = 12  # jaw parameters kept to start from after a loss
_APART_MM = 3.0  # of the lower incisal point between two of them: within the solver's basin of each other
_FINALISTS = 3


class ForwardPass:
    """Align frame after frame in one direction."""

    def __init__(self, attempts: Attempts, begin: FrameFit, *, fixed_head: bool = False) -> None:
        """Go on from a frame; with a fixed head only the jaw moves."""
        self._miss = _MISS * (_FIXED if fixed_head else 1.0)
        self._attempts, self._coordinates = attempts, attempts.instants.coordinates
        self._last, self._velocity = begin.pose, np.zeros(LOCAL)
        self._blind = np.where(begin.found, 0, 1)  # frames since each arch was found
        self._jaws: list[Array] = []
        self._remember(begin)

    def step(self, views: Sequence[View]) -> FrameFit:
        """Align the next frame."""
        fit = self._fit(self._expected(), self._attempts.instant(views))
        moved = self._coordinates.step(self._last, fit.pose)
        self._velocity = moved if fit.found.all() and not self._blind.any() else np.zeros(LOCAL)
        self._blind = np.where(fit.found, 0, self._blind + 1)
        self._last = fit.pose
        self._remember(fit)
        return fit

    def _expected(self) -> Expected:
        """Return the prediction, the less sure the longer the teeth were out of sight."""
        sigma = self._miss * np.sqrt(1.0 + np.r_[[self._blind[0]] * 6, [self._blind.max()] * 3])
        pose = self._coordinates.moved(self._last, _DAMPING * self._velocity)
        return Expected(pose, np.minimum(sigma, MOST_UNSURE) ** -2.0)

    def _fit(self, expected: Expected, instant: Instant) -> FrameFit:
        attempts, config = self._attempts, self._attempts.config
        if not instant.present.any():
            return nothing_seen(expected.pose, instant)
        gates = config.gates_from(config.first_gate_px)
        trial = attempts.attempt(expected.pose, expected, instant, instant.present, gates)
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
        # What does not fit must not pull at the rest.
        alone = attempts.attempt(expected.pose, expected, instant, fit.use, config.wide_gates_px)
        return attempts.judged(alone, instant)

    def _other_starts(self, expected: Expected, instant: Instant) -> list[Pose]:
        """Return where else to look: the prediction, the last pose, and known jaws with the head on its masks."""
        jaws = [expected.pose.d, *(self._jaws if self._blind.any() else ())]
        arch = 0 if instant.present[0].any() else 1
        scan, shifted = self._attempts.instants.solver.scans[arch], []
        for d in jaws:
            pose = replace(expected.pose, d=d)
            shift = shift_to_masks(scan, self._coordinates.arches(pose)[arch], arch, instant.views, instant.present)
            shifted.append(replace(pose, head=translation(shift) @ pose.head))
        if len(shifted) > _FINALISTS:
            worth = [self._worth(pose, expected, instant) for pose in shifted]
            shifted = [shifted[k] for k in np.argsort(worth)[::-1][:_FINALISTS]]
        return [expected.pose, self._last, *shifted]

    def _worth(self, start: Pose, expected: Expected, instant: Instant) -> float:
        """Return how well a start does after a few steps [px]."""
        config, around = self._attempts.config, replace(expected, pose=start)
        trial = self._attempts.attempt(start, around, instant, instant.present, config.trial_gates_px)
        return trial.objective(config.uncovered_price)

    def _remember(self, fit: FrameFit) -> None:
        """Keep what the next frames are judged by, and jaws unlike those kept to start from after a loss."""
        self._attempts.remember(fit)
        if not fit.found.all():
            return
        jaw = self._coordinates.jaw
        place, *known = (transform_points(jaw.pose(d), jaw.landmarks[:1]) for d in (fit.pose.d, *self._jaws))
        if all(np.linalg.norm(place - other) > _APART_MM for other in known):
            self._jaws = [*self._jaws[-_KEPT_JAWS + 1 :], fit.pose.d]
