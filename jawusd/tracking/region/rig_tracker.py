"""Follow head and jaw of a person whose rig exists by the colours of the pictures, lost and found again."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from jawusd.geometry.arrays import Array, Mask
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.quality import matched_px, score_px
from jawusd.tracking.contour.scan import CROWN
from jawusd.tracking.contour.solver import Matched, Rendering
from jawusd.tracking.contour.views import present_masks
from jawusd.tracking.performance.attempts import MOST_UNSURE, FrameFit
from jawusd.tracking.performance.coordinates import JAW, Pose
from jawusd.tracking.performance.focal import growth_of
from jawusd.tracking.performance.instant import Aligned, Expected, InstantSolver
from jawusd.tracking.performance.prediction import Prediction
from jawusd.tracking.performance.single_start import spread_out
from jawusd.tracking.region.learned import CORRELATION_PX, FIRST_RATES, RATES, LearnedColours
from jawusd.tracking.region.picture import Cut, Picture
from jawusd.tracking.region.starts import head_shifts, likeliest

# Variance of the borders of colours times the length over which they err alike [px^3]: as for both arches alone.
_BORDER_PX3 = 0.7**2 * CORRELATION_PX
_GATES_PX, _WIDE_GATES_PX, _BRIEF_GATES_PX = (6.0, 4.0, 3.0, 2.5, 2.0), (12.0, 8.0, 6.0, 4.0, 3.0, 2.5, 2.0), (8.0, 6.0)
# The same with few steps, and after how many frames colours are taken up then.
_FEW_GATES_PX, _LEARN_EVERY, _FEW_JAWS, _FEW_HEADS = (8.0, 3.0, 2.0), 6, 4, 3
_FAR_GATES_PX, _STEADY_FRAMES = (24.0, 14.0, 8.0, 4.0, 2.0), 1.5  # after frames that were left out
_BRIEF_PAUSE = 2  # failed frames per one that is searched
# Failed frames after which teeth are out of sight, and how many then share one search of the jaw and one of the head.
_BRIEF_SEARCHES, _BRIEF_TURNS = 4, 6
_FIRST_ROUNDS = 3  # picks are a few tenths of a millimetre off; each round takes most of the rest
# Share of the usual contour that fits, below which a pose is doubted, others are searched, an arch is given up,
# and one that was lost is not trusted again.
_DOUBTED, _SEARCHED, _LOST, _AGAIN = 0.8, 0.6, 0.33, 0.5
_BRIEF_DOUBTED, _BRIEF_SEARCHED = 0.6, 0.4  # the first two where few steps are taken
_UNSURE_FRAMES = 3.0  # left out, after which an arch counts as lost
_USUAL_FRAMES = 15  # over which the usual contour is measured; it is no less than a share of that of the first frame
_LEAST_USUAL = 0.7
# Poses of the jaw among which a search looks, that it tries, and follows to the end, and of the head.
_JAWS, _TRIED_JAWS, _FINALISTS, _HEADS = 96, 16, 3, 12
_SEARCHES = 8  # frames in a row that are searched; then every so many


class RigTracker:
    """Follow head and jaw of a known person from picture to picture.

    Attributes:
        expected: where they were expected in the last step.
    """

    def __init__(
        self,
        instants: InstantSolver,
        colours: LearnedColours,
        *,
        head: float = 1.0,
        free_focal: bool = False,
        brief: bool = False,
    ) -> None:
        """Take what aligns instants and where the colours are kept; `begin` comes first.

        Args:
            head: how far the head moves, see `Prediction`.
            free_focal: tell how outlines grow with focal lengths.
            brief: take fewer steps, and up colours less often, for pictures that wait for nobody.
        """
        self._instants, self._coordinates, self._colours = instants, instants.coordinates, colours
        self._head, self._free_focal, self._brief = head, free_focal, brief
        self._jaws = spread_out(instants.coordinates.jaw, _JAWS)
        places = instants.coordinates.jaw.pose(self._jaws)
        self._widest = places[np.argmax(np.linalg.norm(places[:, :3, 3], axis=1))]
        self._usual: deque[Array] = deque(maxlen=_USUAL_FRAMES)
        self._least_px = instants.config.least_matched_px
        self._failed = self._frame = 0

    def begin(self, cut: Cut, pose: Pose) -> FrameFit:
        """Learn the colours of a first frame from a pose of a few tenths of a millimetre; return the better pose."""
        arches = self._coordinates.arches(pose)
        self._colours.begin(cut(arches), arches)
        sigma = MOST_UNSURE * np.r_[[min(1.0, self._head)] * 6, [1.0] * 3]
        for _ in range(_FIRST_ROUNDS):
            arches = self._coordinates.arches(pose)
            look = _Look(self._instants, self._colours, cut(arches), arches)
            found = look.align(pose, Expected(pose, sigma**-2.0), _WIDE_GATES_PX)
            pose = found.pose
            look.learn(pose, FIRST_RATES)
        self.expected = Expected(pose, sigma**-2.0)
        fit = look.fit(found, np.ones(2, bool), self._free_focal)
        self._motion = Prediction(self._coordinates, pose, fit.found, head=self._head)
        self._first = _share(found.solution)
        self._usual.append(self._first)
        return fit

    def other_way(self, begin: FrameFit) -> RigTracker:
        """Return a tracker that goes on from the first frame with what is known now, and learns on its own."""
        out = copy(self)
        out._colours, out._usual = self._colours.copy(), self._usual.copy()
        out._motion = Prediction(self._coordinates, begin.pose, begin.found, head=self._head)
        return out

    def step(self, cut: Cut, frames: float = 1.0) -> FrameFit:
        """Align the next frame, or one some frames on."""
        self.expected = expected = self._motion.expected(frames)
        look = self._look(cut, self._coordinates.arches(expected.pose))
        if not look.use.any():
            self._motion.take(expected.pose, np.zeros(2, bool))
            return FrameFit(expected.pose, None, look.use, look.use, np.full(look.use.shape, np.nan))
        found, look = self._best(expected, look, cut, frames)
        share = _share(found.solution)
        unsure = (self._motion.blind > 0) | (frames > _UNSURE_FRAMES)
        least = np.where(unsure, _AGAIN, _LOST) * self._usual_share()
        trusted = (share >= least) & (matched_px(found.solution) >= self._least_px)
        if not trusted.any():
            found = replace(found, pose=expected.pose)
        self._frame += 1
        if trusted.all():
            self._failed = 0
            if not self._brief or self._frame % _LEARN_EVERY == 0:
                look.learn(found.pose, RATES)
            self._usual.append(share)
        self._motion.take(found.pose, trusted)
        return look.fit(found, trusted, self._free_focal)

    def _usual_share(self) -> Array:
        return np.maximum(np.median(self._usual, axis=0), _LEAST_USUAL * self._first)

    def _look(self, cut: Cut, around: Array) -> _Look:
        """Return the pictures around both arches at poses (2, 4, 4)."""
        before = self._coordinates.arches(self._motion.last)
        return _Look(self._instants, self._colours, cut(around), before)

    def _best(self, expected: Expected, look: _Look, cut: Cut, frames: float) -> tuple[Aligned, _Look]:
        """Align from the prediction, and from other starts where that may have failed; then in more of the pictures."""
        gates = _FEW_GATES_PX if self._brief else _GATES_PX
        blind = self._brief and self._failed > _BRIEF_SEARCHES
        if self._brief and frames > _STEADY_FRAMES and not blind:
            gates = _FAR_GATES_PX
        found, usual = look.align(expected.pose, expected, gates), self._usual_share()
        doubted, searched = (_BRIEF_DOUBTED, _BRIEF_SEARCHED) if self._brief else (_DOUBTED, _SEARCHED)
        if not (_share(found.solution) < doubted * usual).any():
            return found, look
        others = (self._motion.last,) if self._brief else (expected.pose, self._motion.last)
        for start in () if blind else others:
            found = _better(found, look.align(start, expected, gates if self._brief else _WIDE_GATES_PX))
        if not (_share(found.solution) < searched * usual).any():
            return found, look
        self._failed += 1
        if blind:
            return self._best_in_turn(found, expected, look, cut)
        pause = _BRIEF_PAUSE if self._brief else 1 if self._failed <= _SEARCHES else _SEARCHES
        if (self._failed - 1) % pause:
            return found, look
        look = self._look(cut, np.stack([found.pose.head, found.pose.head @ self._widest]))
        found = look.align(found.pose, expected, gates)
        if self._head == 1.0 and _share(found.solution)[0] < _SEARCHED * usual[0]:
            found = self._with_head_searched(found, expected, look)
        return self._searched(found, expected, look), look

    def _best_in_turn(self, found: Aligned, expected: Expected, look: _Look, cut: Cut) -> tuple[Aligned, _Look]:
        """Search the jaw in one frame and the head in a later one: teeth out of sight hold up no pictures."""
        turn = self._failed % _BRIEF_TURNS
        if turn == 0:
            look = self._look(cut, np.stack([found.pose.head, found.pose.head @ self._widest]))
            return self._searched(found, expected, look), look
        if turn == _BRIEF_TURNS // 2 and self._head == 1.0:
            return self._with_head_searched(found, expected, look), look
        return found, look

    def _with_head_searched(self, found: Aligned, expected: Expected, look: _Look) -> Aligned:
        """Try shifted poses of the head, which the jaw goes with."""
        shifts = head_shifts(expected.pose.head, self._colours.axes)
        order = likeliest(list(shifts @ expected.pose.head), look.views, self._instants.solver.scans, 0)
        order = order[: _FEW_HEADS if self._brief else _HEADS]
        for head in (shifts[k] @ expected.pose.head for k in order):
            start = replace(expected.pose, head=head)
            around = Expected(start, MOST_UNSURE**-2.0)
            found = _better(found, look.align(start, around, _BRIEF_GATES_PX))
        gates = _FEW_GATES_PX if self._brief else _WIDE_GATES_PX
        return look.align(found.pose, Expected(found.pose, MOST_UNSURE**-2.0), gates)

    def _searched(self, found: Aligned, expected: Expected, look: _Look) -> Aligned:
        """Try poses of the jaw all over its range, those first whose teeth lie where it looks like teeth."""
        head, jaw = found.pose.head, self._coordinates.jaw
        places = [head @ jaw.pose(d) for d in self._jaws]
        order = likeliest(places, look.views, self._instants.solver.scans, 1, look.upper_crowns(found.pose))
        brief, loose = [], expected.precision.copy()
        loose[JAW] = MOST_UNSURE[JAW] ** -2.0
        for k in order[: _FEW_JAWS if self._brief else _TRIED_JAWS]:
            start = replace(found.pose, d=self._jaws[k])
            brief.append(look.align(start, Expected(start, loose), _BRIEF_GATES_PX))
        brief.sort(key=lambda trial: -float(score_px(trial.solution).sum()))
        for trial in brief[: 1 if self._brief else _FINALISTS]:
            around = Expected(trial.pose, loose)
            found = _better(found, look.align(trial.pose, around, _FEW_GATES_PX if self._brief else _WIDE_GATES_PX))
        return found


class _Look:
    """Hold the pictures of one instant, drawn into by all attempts."""

    def __init__(
        self, instants: InstantSolver, colours: LearnedColours, pictures: Sequence[Picture | None], before: Array
    ) -> None:
        self._instants, self._colours, self._pictures = instants, colours, pictures
        self.views = colours.views(pictures, before)
        self._rendering = Rendering(instants.solver, self.views)
        self.use = present_masks(self.views)

    def align(self, start: Pose, expected: Expected, gates_px: Sequence[float]) -> Aligned:
        """Return the likeliest pose near a start."""
        weight = np.full(2, 1.0 / _BORDER_PX3)
        return self._instants.align(start, self.views, self.use, gates_px, expected, weight, self._rendering)

    def upper_crowns(self, pose: Pose) -> list[Mask]:
        """Return the pixels of each view that show upper crowns at a pose."""
        self._instants.linearise(pose, self.views, self.use, self._rendering, self._instants.config.final_gate_px[1])
        return [labels[0] == CROWN for labels in self._rendering.labels]

    def learn(self, pose: Pose, rates: tuple[float, float]) -> None:
        """Take up the colours beside the borders found at a pose."""
        counting, gate = self._colours.counting(self.views), self._instants.config.final_gate_px[1]
        self._instants.linearise(pose, counting, self.use, self._rendering, gate)
        self._colours.learn(counting, self._pictures, self._instants.coordinates.arches(pose), rates)

    def fit(self, found: Aligned, trusted: Mask, free_focal: bool) -> FrameFit:
        """Return what is known of the frame, with the arches that are trusted, shape (2,)."""
        use = self.use & trusted[:, None]
        unknown = np.full(use.shape, np.nan)
        if not free_focal or not trusted.any():
            return FrameFit(found.pose, found.solution, use, use, unknown)
        matched: list[Matched] = []
        gate = self._instants.config.final_gate_px[1]
        solution = self._instants.linearise(found.pose, self.views, use, self._rendering, gate, True, matched)
        growth = growth_of(matched, solution.poses, solution.centres, self.views)
        return FrameFit(found.pose, solution, use, use, unknown, growth)


def _share(solution: Solution) -> Array:
    """Return how much of the contour in sight fits, per arch, shape (2,)."""
    return np.asarray(score_px(solution).sum(1) / np.maximum(solution.visible_px.sum(1), 1.0), np.float64)


def _better(one: Aligned, other: Aligned) -> Aligned:
    """Return the one with more contour that fits."""
    return other if score_px(other.solution).sum() > score_px(one.solution).sum() else one
