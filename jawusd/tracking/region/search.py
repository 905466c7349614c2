"""Align both arches with the borders of colours: from predictions, from other starts, and where they are lost."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import relative_pose, se3_inverse
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.quality import score_px
from jawusd.tracking.contour.rendering import Rendering
from jawusd.tracking.contour.scan import Scan, thinned
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View
from jawusd.tracking.region.bite import BiteTerm
from jawusd.tracking.region.condyles import CondyleMotion, CondyleTerm
from jawusd.tracking.region.learned import CORRELATION_PX
from jawusd.tracking.region.starts import head_shifts, likeliest, starts_everywhere, turned_starts
from jawusd.tracking.sequence.history import MotionPredictor

# Gates of an alignment from the prediction, from farther, of the brief trial of a start, and with all faces at last;
# distance of contour samples, motion that redraws scans [px].
_NEAR_GATES_PX, _FAR_GATES_PX = (6.0, 4.0, 3.0, 2.5, 2.0), (12.0, 8.0, 6.0, 4.0, 3.0, 2.5, 2.0)
_TRIAL_GATES_PX, _LAST_GATES_PX, _SAMPLE_STEP_PX, _REDRAW_PX = (8.0, 6.0), (2.0,), 2.0, 2.0
_FACES = 6_000  # of the crowns until the last steps: with no more at all, incisal points were 0.02 mm worse
# Variance of borders times the length over which they err alike, against which expected condyles are weighed [px^3]:
# where the jaw is well seen, and in doubtful frames. With the greater one everywhere, the incisal points of two takes
# were 0.006 mm worse; with the lesser one a jaw drifted whose edges front teeth and lips hid.
_LOOSE_PX3, _FIRM_PX3 = 3.0, 15.0
_BORDER_PX3 = 0.7**2 * CORRELATION_PX  # the same as residuals show it
# Contour that fits worth as much as a standard deviation squared of the condyles [px]: a sample beyond the gate costs
# Tukey's loss of 4.685^2 / 6, and samples err alike over the length above.
_STRAIN_PX = 0.5 * CORRELATION_PX * 6.0 / 4.685**2
_FAST_MM = 1.0  # predicted motion from which other starts are tried
_HOPEFUL, _FINALISTS = 24, 3  # starts of a search that are tried, and that are followed to the end


class Look(NamedTuple):
    """Hold the views of an instant, and the rendering that all alignments there share."""

    views: Sequence[View]
    rendering: Rendering


class PoseSearch:
    """Align both arches in the views of an instant."""

    def __init__(
        self,
        scans: Sequence[Scan],
        landmarks: Array,
        axes: Array,
        config: TrackingConfig | None,
        executor: Executor | None,
    ) -> None:
        """Prepare the scans; see `RegionTracker`."""
        self.config = replace(
            config or TrackingConfig(),
            sample_step_px=_SAMPLE_STEP_PX,
            redraw_px=_REDRAW_PX,
        )
        self.solver = ContourSolver([replace(scan, thin=None) for scan in scans], self.config, executor)
        self._thin = ContourSolver([thinned(scan, _FACES) for scan in scans], self.config, executor)
        self.condyles = CondyleMotion(landmarks, axes)
        self._loose, self._firm = (CondyleTerm(self.condyles, noise) for noise in (_LOOSE_PX3, _FIRM_PX3))
        self._bite, self._axes = BiteTerm(landmarks[:3], axes[1], _BORDER_PX3), axes

    def near(self, start: Array, look: Look, *, firm: bool = False) -> Solution:
        """Return an alignment from a start some tenths of a millimetre off, T_world_upper and T_world_lower (2, 4, 4).

        Args:
            firm: hold the condyles where they are expected, as doubtful frames need it.
        """
        return self._align(start, look, _FAR_GATES_PX, firm)

    def best(self, starts: list[Array], look: Look, last: Array) -> Solution:
        """Return an alignment from the prediction; of teeth that are fast from other starts as well.

        Args:
            starts: poses, the prediction first.
            last: poses of the frame before.
        """
        solution = self._align(starts[0], look, _NEAR_GATES_PX)
        if np.abs(starts[0][:, :3, 3] - last[:, :3, 3]).max() > _FAST_MM:
            carried = solution.poses[0] @ se3_inverse(last[0]) @ last[1]
            for start in (last, np.stack([solution.poses[0], carried])):
                solution = self._better(solution, self._align(start, look, _FAR_GATES_PX))
        return solution

    def from_farther(self, solution: Solution, start: Array, last: Array, look: Look) -> Solution:
        """Return a better alignment from farther away, or from the poses of the frame before; else the one given."""
        solution = self._better(solution, self._align(start, look, _FAR_GATES_PX))
        return self._better(solution, self._align(last, look, _NEAR_GATES_PX))

    def with_jaw_searched(
        self,
        solution: Solution,
        predicted: Array,
        last: Array,
        look: Look,
        motion: MotionPredictor,
        everywhere: bool,
    ) -> Solution:
        """Try earlier poses of the jaw, turned ones, and if asked for any, with the head as it was found."""
        jaws = [se3_inverse(poses[0]) @ poses[1] for poses in (last, *motion.pose_history())]
        bases = (se3_inverse(predicted[0]) @ predicted[1], jaws[0])
        jaws += turned_starts(self.condyles, bases)
        if everywhere:
            jaws += starts_everywhere(self.condyles)
        head = solution.poses[0]
        order = likeliest([head @ jaw for jaw in jaws], look.views, self._thin.scans, 1)[:_HOPEFUL]
        pairs = (np.stack([head, head @ jaws[k]]) for k in order)
        brief = [self._align(pair, look, _TRIAL_GATES_PX, True) for pair in pairs]
        brief.sort(key=lambda trial: -self.worth_px(trial))
        for trial in brief[:_FINALISTS]:
            solution = self._better(solution, self.near(trial.poses, look, firm=True))
        return solution

    def with_head_searched(self, solution: Solution, predicted: Array, look: Look) -> Solution:
        """Try shifted poses of the head, which the jaw goes with."""
        shifts = head_shifts(predicted[0], self._axes)
        order = likeliest(list(shifts @ predicted[0]), look.views, self._thin.scans, 0)[: _HOPEFUL // 2]
        brief = [self._align(shifts[k] @ predicted, look, _TRIAL_GATES_PX, True) for k in order]
        brief.sort(key=lambda trial: -float(score_px(trial)[0].sum()))
        best = [self.near(trial.poses, look, firm=True) for trial in brief[:_FINALISTS]]
        return max((solution, *best), key=lambda trial: float(score_px(trial)[0].sum()))

    def look(self, views: Sequence[View]) -> Look:
        """Return the views of an instant with a rendering to share."""
        return Look(views, self._thin.rendering(views))

    def polished(self, solution: Solution, views: Sequence[View], look: Look, *, firm: bool) -> Solution:
        """Return the alignment with all faces of the scans, in views of its instant; hidden parts are as before."""
        terms = (self._firm if firm else self._loose, self._bite)
        return self.solver.solve(solution.poses, views, _LAST_GATES_PX, None, terms, rendering=look.rendering)

    def worth_px(self, solution: Solution) -> float:
        """Return how much contour fits, less what it costs to have the condyles where they are not expected [px]."""
        return float(score_px(solution).sum()) - _STRAIN_PX * self.condyles.strain(relative_pose(*solution.poses))

    def _better(self, one: Solution, other: Solution) -> Solution:
        """Return the likelier one."""
        return other if self.worth_px(other) > self.worth_px(one) else one

    def _align(self, start: Array, look: Look, gates_px: Sequence[float], firm: bool = False) -> Solution:
        terms = (self._firm if firm else self._loose, self._bite)
        return self._thin.solve(start, look.views, gates_px, None, terms, rendering=look.rendering)


def fitting_share(solution: Solution) -> Array:
    """Return how much of the contour in sight fits, per arch, shape (2,)."""
    return np.asarray(score_px(solution).sum(1) / np.maximum(solution.visible_px.sum(1), 1.0), np.float64)
