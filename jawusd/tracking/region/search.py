"""Where to look for teeth that moved faster than expected, or were out of sight."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import relative_pose, se3_exp, se3_inverse, transform_points
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution, translation
from jawusd.tracking.contour.quality import score_px
from jawusd.tracking.contour.rendering import Rendering
from jawusd.tracking.contour.scan import Scan, thinned
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View
from jawusd.tracking.region.appearance import CORRELATION_PX
from jawusd.tracking.region.jaw_priors import BiteTerm, CondyleMotion, CondyleTerm
from jawusd.tracking.region.view import RegionView
from jawusd.tracking.sequence.history import MotionPredictor

_POINTS = 400  # of a scan, in the colours of which a start is judged
# Turns of the jaw tried, of opening and to the side [degrees].
_OPENED, _ASIDE = (-6.0, -4.5, -3.0, -1.5, 1.5, 3.0, 4.5, 6.0), (-4.0, -2.0, 2.0, 4.0)
# Places of the incisal point: to the left, down, and before where opening takes it [mm]. Contours are caught from some
# 1.7 mm. A jaw that goes aside turns about the condyle on that side, half as far beside the middle as behind the teeth.
_DOWN = np.arange(0.0, 46.0, 2.5).tolist()
_LEFT = (-12.0, -9.0, -6.0, -3.0, 3.0, 6.0, 9.0, 12.0)
_PLACES_MM = [
    *((0.0, down, 0.0) for down in _DOWN),
    *((left, down, 0.5 * abs(left)) for left in _LEFT for down in (0.0, 2.5, 5.0, 8.0)),
    *((0.0, down, forward) for down in (2.0, 4.5, 7.0) for forward in (3.5, 7.0)),
]
# Shifts of the head: to the left, up and forwards [mm].
_NEAR_MM, _FAR_MM = (-3.0, 0.0, 3.0), (-6.0, 6.0)
_SHIFTS_MM = [
    *((left, up, front) for left in _NEAR_MM for up in _NEAR_MM for front in _NEAR_MM),
    *((far, 0.0, 0.0) for far in _FAR_MM),
    *((0.0, far, 0.0) for far in _FAR_MM),
]

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


def head_shifts(T_world_head: Array, axes: Array) -> Array:
    """Return motions of the head in the world, shape (N, 4, 4); `axes` rotate from scan to left, up, front (3, 3)."""
    to_world = T_world_head[:3, :3] @ axes.T
    return np.stack([translation(to_world @ shift) for shift in np.array(_SHIFTS_MM)])


def turned_starts(condyles: CondyleMotion, bases: Sequence[Array]) -> list[Array]:
    """Return poses T_upper_lower (4, 4) near each of some, turned about the condyles."""
    hinge, axes = condyles.hinge, condyles.axes
    turns = [np.deg2rad(a) * axes[0] for a in _OPENED] + [np.deg2rad(a) * axes[1] for a in _ASIDE]
    about = [translation(hinge) @ se3_exp(np.append(turn, np.zeros(3))) @ translation(-hinge) for turn in turns]
    return [base @ turn for turn in about for base in bases]


def starts_everywhere(condyles: CondyleMotion) -> list[Array]:
    """Return poses T_upper_lower (4, 4) all over what jaws do."""
    return [condyles.placed(*place) for place in _PLACES_MM]


def likeliest(
    places: Sequence[Array], views: Sequence[View], scans: Sequence[Scan], arch: int, taken: Sequence[Mask] = ()
) -> list[int]:
    """Return the order of poses T_world_arch (4, 4) by how much the pixels under their crowns look like teeth.

    Args:
        places, views, scans, arch: the poses, and what they are judged by.
        taken: by view, pixels (h, w) that show the other arch and count for nothing; empty if that is not known.
    """
    points = scans[arch].crown_vertices(_POINTS)
    worth = np.zeros(len(places))
    for c, view in enumerate(views):
        if not isinstance(view.edges, RegionView):
            continue
        like = view.edges.likeness(arch)
        if taken:
            like = np.where(taken[c], 0.0, like)
        for k, pose in enumerate(places):
            h = transform_points(pose, points) @ view.matrix[:, :3].T + view.matrix[:, 3]
            x, y = np.rint(h[:, :2] / h[:, 2:]).astype(int).T
            inside = (x >= 0) & (y >= 0) & (x < like.shape[1]) & (y < like.shape[0])
            worth[k] += float(like[y[inside], x[inside]].sum())
    return [int(k) for k in np.argsort(-worth, kind="stable")]


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
