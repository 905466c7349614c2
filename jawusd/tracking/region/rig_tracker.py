"""Colour-based tracker of head and jaw of a subject with a known rig; it re-acquires teeth after a loss."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from copy import copy
from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import transform_point, transform_points
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import translation
from jawusd.tracking.contour.quality import fitting_share, matched_px, score_px
from jawusd.tracking.initialization.first_frame import FIRST_ROUNDS
from jawusd.tracking.performance.attempts import LARGEST_SIGMA, FrameFit
from jawusd.tracking.performance.coordinates import JAW, Pose
from jawusd.tracking.performance.instant import Aligned, Expected, InstantSolver
from jawusd.tracking.performance.motion import Prediction
from jawusd.tracking.performance.single_start import spread_out
from jawusd.tracking.region.appearance import FIRST_RATES, RATES, Cut, LearnedColours
from jawusd.tracking.region.instant_images import Begun, InstantImages
from jawusd.tracking.region.search import (
    AGAIN,
    FAR_GATES_PX,
    LEAST_USUAL,
    THOROUGH,
    TRIAL_GATES_PX,
    USUAL_FRAMES,
    Effort,
    head_shifts,
    rank_by_colour,
)

# Longest intervals between steps [frames] that count as no dropped frame, and as one dropped frame.
_NEXT_FRAMES, _STEADY_FRAMES = 1.5, 2.5
_LOST = 0.33  # fraction of the usual matched contour length below which an arch becomes lost
# number of frames since the last step above which an arch must fit as well as after a loss
_UNSURE_FRAMES = 3.0
_JAWS = 96  # number of jaw poses that a search ranks by colour
#: Settings of solvers that follow a rig in images: the variances of their edges were chosen without a model of smooth
#: errors.
FOR_RIGS = replace(TrackingConfig(), smooth_errors=None)
# With one camera, a jaw that is too far in front may fit a first frame as well as the true one. The frame is therefore
# also aligned from the middle, without laterotrusion and protrusion, with standard deviations of the jaw that are
# smaller by the first factor, and that pose is kept unless the other one fits better by the second factor. In 86 views
# of 18 rendered subjects (`tests/benchmarks/looks.py`), aligned from true poses, 5 jaws were off by 2.5 to 6.7 mm; with
# this choice, the largest error is 1.95 mm.
_NEAR_MIDDLE, _CLEARER = 1.0 / 3.0, 1.2
# With one camera, both arches may fit about the width of a tooth beside their true places, or at a wrong distance from
# the camera. First frames in which they fit less than the last value [-] are also aligned from poses moved so far [mm].
_TOOTH_MM, _DEEPER_MM, _CLEAR_ALONE = 8.0, 7.0, 0.6
# With one camera, teeth that are nearly closed may match the image at several poses. Opening below which other poses
# are aligned [mm], distance from which they differ [mm], and ratio of matched contour above which they fit as well.
_CLOSED_MM, _APART_MM, _SIMILAR = 2.0, 1.0, 0.75


class RigTracker:
    """Frame-by-frame tracker of head and jaw of a known subject.

    Attributes:
        expected: pose prior of the last step.
        first_fit: matched fraction of the contour in sight in the first frame, 0 .. 1, of the worse arch.
    """

    def __init__(
        self,
        instants: InstantSolver,
        colours: LearnedColours,
        *,
        head: float = 1.0,
        free_focal: bool = False,
        effort: Effort = THOROUGH,
        whole: InstantSolver | None = None,
    ) -> None:
        """Configure the tracker; call `begin` first.

        Args:
            head: factor on the head's standard deviations; see `Prediction`.
            free_focal: whether to compute derivatives with respect to focal lengths.
            effort: computational effort per frame.
            whole: solver whose scans have more faces, for the last step; None skips that step.
        """
        self._whole = whole
        self._instants, self._coordinates, self._colours = instants, instants.coordinates, colours
        self._head, self._free_focal, self._effort = head, free_focal, effort
        self._jaws = spread_out(instants.coordinates.jaw, _JAWS)
        places = instants.coordinates.jaw.pose(self._jaws)
        self._widest = places[np.argmax(np.linalg.norm(places[:, :3, 3], axis=1))]
        self._usual: deque[Array] = deque(maxlen=USUAL_FRAMES)
        self._least_px = instants.config.least_matched_px
        self._failed = self._frame = 0

    def begin(self, cut: Cut, pose: Pose, *, searched: bool = False) -> FrameFit:
        """Learn colours from a first frame near a pose; return the frame fit.

        With one camera, other poses are tried as well if the pose was `searched` and hardly fits.
        """
        begun = self._begun(cut, pose, 1.0)
        alone = begun.look.use.any(axis=0).sum() == 1
        if alone:
            middle = replace(pose, d=pose.d * [1.0, 0.0, 0.0])
            usual = self._begun(cut, middle, _NEAR_MIDDLE)
            if begun.share <= _CLEARER * usual.share:
                begun = usual
            if searched and begun.fit < _CLEAR_ALONE:
                others = [replace(middle, head=head) for head in self._other_heads(begun)]
                begun = max(begun, *(self._begun(cut, other, 1.0) for other in others), key=lambda other: other.fit)
        self._colours, self.expected = begun.colours, begun.expected
        fit = begun.look.fit(begun.found, np.ones(2, bool), self._free_focal)
        self._motion = Prediction(self._coordinates, begun.found.pose, fit.found, head=self._head)
        self._first = fitting_share(begun.rough.solution)
        self.first_fit = begun.fit
        self._usual.append(self._first)
        return fit

    def _other_heads(self, begun: Begun) -> list[Array]:
        """Return head poses (4, 4) to either side of that of a first frame of one camera, in front of and behind it."""
        head = begun.found.pose.head
        (camera,) = np.flatnonzero(begun.look.use.any(axis=0))
        away = transform_point(head, self._coordinates.pivot) - begun.look.views[camera].eye
        ways = (_TOOTH_MM * head[:3, :3] @ self._colours.axes[0], _DEEPER_MM * away / np.linalg.norm(away))
        return [translation(sign * way) @ head for way in ways for sign in (-1.0, 1.0)]

    def _begun(self, cut: Cut, pose: Pose, jaw: float) -> Begun:
        """Return a first frame aligned near a pose, with colours learned in it; `jaw` scales the sigmas of d."""
        sigma = LARGEST_SIGMA * np.r_[[min(1.0, self._head)] * 6, [jaw] * 3]
        colours, arches = self._colours.copy(), self._coordinates.arches(pose)
        colours.begin(cut(arches), arches)
        for _ in range(FIRST_ROUNDS):
            arches = self._coordinates.arches(pose)
            look = InstantImages(self._instants, colours, cut(arches), arches, self._whole)
            rough = look.align(pose, Expected(pose, sigma**-2.0), FAR_GATES_PX)
            found = look.polished(rough)
            pose = found.pose
            look.learn(pose, FIRST_RATES)
        return Begun(colours, look, rough, found, Expected(pose, sigma**-2.0))

    def reversed_from(self, begin: FrameFit) -> RigTracker:
        """Return an independent tracker that starts again from the first frame with the colours learned so far."""
        out = copy(self)
        out._colours, out._usual = self._colours.copy(), self._usual.copy()
        out._motion = Prediction(self._coordinates, begin.pose, begin.found, head=self._head)
        return out

    def step(self, cut: Cut, frames: float = 1.0) -> FrameFit:
        """Align the images taken `frames` frames after the previous ones."""
        self.expected = expected = self._motion.expected(frames)
        look = self._look(cut, self._coordinates.arches(expected.pose))
        if not look.use.any():
            self._motion.take(expected.pose, np.zeros(2, bool))
            return FrameFit(expected.pose, None, look.use, look.use, np.full(look.use.shape, np.nan))
        unsure = (self._motion.blind > 0) | (frames > _UNSURE_FRAMES)
        usual = self._usual_share()
        least = np.where(unsure, AGAIN, _LOST) * usual
        rough, look = self._best(expected, look, cut, frames, least)
        rough, found = self._with_habitual_starts(expected, look, rough, look.polished(rough))
        return self._judged(look, rough, found, least, expected.pose)

    def again(self, cut: Cut, fit: FrameFit) -> FrameFit:
        """Align the images of a frame once more from a pose that is better than the prediction, without a search.

        If an arch was not found in the given fit, both arches must fit as well as after a loss.
        """
        look = self._look(cut, self._coordinates.arches(fit.pose))
        if not look.use.any():
            return fit
        expected = self._motion.around(fit.pose)
        rough = look.align(fit.pose, expected, self._effort.gates_px)
        found, least = look.polished(rough), np.where(fit.found.all(), _LOST, AGAIN) * self._usual_share()
        if found.pose.d[0] < _CLOSED_MM and self._is_ambiguous(expected, look, found):
            least[1] = np.inf
        return self._judged(look, rough, found, least, fit.pose)

    def _is_ambiguous(self, expected: Expected, look: InstantImages, found: Aligned) -> bool:
        """Return whether another jaw pose, aligned from a habitual one, fits nearly as well."""
        points = self._instants.solver.scans[1].probes
        place, score = transform_points(self._coordinates.jaw.pose(found.pose.d), points), _matched_score(found)
        for trial in self._habitual(expected, look):
            other = transform_points(self._coordinates.jaw.pose(trial.pose.d), points)
            if np.linalg.norm(other - place, axis=1).mean() > _APART_MM and _matched_score(trial) > _SIMILAR * score:
                return True
        return False

    def _judged(self, look: InstantImages, rough: Aligned, found: Aligned, least: Array, otherwise: Pose) -> FrameFit:
        """Return the fit of a frame, and learn its colours and usual fit if both arches are found.

        An arch is found from the matched fraction `least` (2,) on; `otherwise` is the pose if neither is found.
        """
        usual = self._usual_share()
        share, fine = fitting_share(rough.solution), fitting_share(found.solution)
        trusted = (share >= least) & (matched_px(found.solution) >= self._least_px)
        if not trusted.any():
            found = replace(found, pose=otherwise)
        self._frame += 1
        if trusted.all():
            self._failed = 0
            if self._frame % self._effort.learn_every == 0:
                look.learn(found.pose, RATES)
            self._remember(share)
        self._motion.take(found.pose, trusted)
        fit = look.fit(found, trusted, self._free_focal)
        return replace(fit, uncertain=bool((np.minimum(share, fine) < THOROUGH.uncertain * usual).any()))

    def carry(self, d: Array, variance_mm2: Array) -> None:
        """Predict the next frame from d of another source; see `Prediction.carry`."""
        self._motion.carry(d, variance_mm2)

    def _remember(self, share: Array) -> None:
        """Add the matched fractions of both arches (2,) to the statistics, except uncertain ones."""
        usual = self._usual_share()
        self._usual.append(np.where(share >= THOROUGH.searched * usual, share, usual))

    def _usual_share(self) -> Array:
        return np.maximum(np.median(self._usual, axis=0), LEAST_USUAL * self._first)

    def _look(self, cut: Cut, around: Array) -> InstantImages:
        """Return the images cropped around both arches at poses (2, 4, 4)."""
        before = self._coordinates.arches(self._motion.last)
        return InstantImages(self._instants, self._colours, cut(around), before, self._whole)

    def _wide_look(self, found: Aligned, cut: Cut) -> InstantImages:
        """Return the images cropped around the full range of the jaw for a head pose."""
        return self._look(cut, np.stack([found.pose.head, found.pose.head @ self._widest]))

    def _best(
        self, expected: Expected, look: InstantImages, cut: Cut, frames: float, least: Array
    ) -> tuple[Aligned, InstantImages]:
        """Align from the prediction; if this may have failed, from other starts, and then by a search in larger crops.

        Results of a search are accepted only if the matched fraction reaches `least`, shape (2,).
        """
        effort, usual = self._effort, self._usual_share()
        in_turn, far = effort.in_turn and self._failed > effort.searches, frames > _STEADY_FRAMES
        gates = effort.gates_px if in_turn or frames <= _NEXT_FRAMES else effort.far_px if far else effort.next_px
        # After dropped frames, partial fits are not trusted, since the motion prior is weak.
        limits = THOROUGH if far else effort
        found = look.align(expected.pose, expected, gates)
        if not (fitting_share(found.solution) < limits.uncertain * usual).any():
            return found, look
        if not in_turn:
            for start in (self._motion.last,) if effort.wide_px is None else (expected.pose, self._motion.last):
                found = _better(found, look.align(start, expected, effort.wide_px or gates))
        if not (fitting_share(found.solution) < limits.searched * usual).any():
            return found, look
        self._failed += 1
        if in_turn:
            return self._best_in_turn(found, expected, look, cut)
        if (self._failed - 1) % (effort.search_every if self._failed <= effort.searches else effort.later_every):
            return found, look
        look = self._wide_look(found, cut)
        found = look.align(found.pose, expected, gates)
        if self._head == 1.0 and fitting_share(found.solution)[0] < THOROUGH.searched * usual[0]:
            found = self._with_head_searched(found, expected, look)
        far_away = self._searched(found, expected, look)
        return far_away if (fitting_share(far_away.solution) >= least).all() else found, look

    def _with_habitual_starts(
        self, expected: Expected, look: InstantImages, rough: Aligned, found: Aligned
    ) -> tuple[Aligned, Aligned]:
        """Return a rough alignment and its refinement; with one camera, also align from poses nearer to habitual ones.

        One camera hardly shows the distance of the jaw, so a wrong distance can persist although teeth are visible.
        """
        alone = look.use.any(axis=0).sum() == 1 and not (self._effort.in_turn and self._failed > self._effort.searches)
        if not alone or not (fitting_share(found.solution) < THOROUGH.uncertain * self._usual_share()).any():
            return rough, found
        for trial in self._habitual(expected, look):
            fine = look.polished(trial)
            if _better(found, fine) is fine:
                rough, found = trial, fine
        return rough, found

    def _habitual(self, expected: Expected, look: InstantImages) -> Iterator[Aligned]:
        """Yield alignments from the expected pose without laterotrusion, and without protrusion."""
        for kept in ([1.0, 0.0, 1.0], [1.0, 1.0, 0.0]):
            start = replace(expected.pose, d=expected.pose.d * kept)
            yield look.align(start, Expected(start, _loose(expected)), self._effort.wide_px or self._effort.gates_px)

    def _best_in_turn(
        self, found: Aligned, expected: Expected, look: InstantImages, cut: Cut
    ) -> tuple[Aligned, InstantImages]:
        """Search for jaw and head in different frames, to limit the time per frame while teeth are not visible."""
        turn = self._failed % self._effort.later_every
        if turn == 0:
            look = self._wide_look(found, cut)
            return self._searched(found, expected, look), look
        if turn == self._effort.later_every // 2 and self._head == 1.0:
            return self._with_head_searched(found, expected, look), look
        return found, look

    def _with_head_searched(self, found: Aligned, expected: Expected, look: InstantImages) -> Aligned:
        """Try shifted head poses with an unchanged jaw pose."""
        shifts = head_shifts(expected.pose.head, self._colours.axes)
        order = rank_by_colour(list(shifts @ expected.pose.head), look.views, self._instants.solver.scans, 0)
        order = order[: self._effort.heads]
        for head in (shifts[k] @ expected.pose.head for k in order):
            start = replace(expected.pose, head=head)
            around = Expected(start, LARGEST_SIGMA**-2.0)
            found = _better(found, look.align(start, around, TRIAL_GATES_PX))
        gates = self._effort.wide_px or self._effort.gates_px
        return look.align(found.pose, Expected(found.pose, LARGEST_SIGMA**-2.0), gates)

    def _searched(self, found: Aligned, expected: Expected, look: InstantImages) -> Aligned:
        """Try jaw poses over the whole range of motion, ranked by the image colours at the projected teeth."""
        head, jaw = found.pose.head, self._coordinates.jaw
        places = [head @ jaw.pose(d) for d in self._jaws]
        order = rank_by_colour(places, look.views, self._instants.solver.scans, 1, look.upper_crowns(found.pose))
        brief, loose = [], _loose(expected)
        for k in order[: self._effort.jaws]:
            start = replace(found.pose, d=self._jaws[k])
            brief.append(look.align(start, Expected(start, loose), TRIAL_GATES_PX))
        brief.sort(key=lambda trial: -float(score_px(trial.solution).sum()))
        for trial in brief[: self._effort.finalists]:
            around = Expected(trial.pose, loose)
            found = _better(found, look.align(trial.pose, around, self._effort.wide_px or self._effort.gates_px))
        return found


def _loose(expected: Expected) -> Array:
    """Return the precisions (9,) of a prior without knowledge of the jaw."""
    out = expected.precision.copy()
    out[JAW] = LARGEST_SIGMA[JAW] ** -2.0
    return out


def _better(one: Aligned, other: Aligned) -> Aligned:
    """Return the alignment with more matched contour."""
    return other if _matched_score(other) > _matched_score(one) else one


def _matched_score(found: Aligned) -> float:
    return float(score_px(found.solution).sum())
