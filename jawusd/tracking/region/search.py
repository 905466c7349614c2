"""Alignment of both arches with colour borders: from predictions, from other starts, and by search; its effort."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import relative_pose, se3_exp, se3_inverse, transform_points
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution, translation
from jawusd.tracking.contour.quality import fitting_share, score_px
from jawusd.tracking.contour.scan import Scan, thinned
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View, present_masks
from jawusd.tracking.region.appearance import COARSE, CORRELATION_PX, InstantViews, LearnedColours, Picture
from jawusd.tracking.region.jaw_priors import BiteTerm, CondyleMotion, CondyleTerm
from jawusd.tracking.region.view import RegionView
from jawusd.tracking.sequence.history import MotionPredictor

_POINTS = 400  # number of scan points at which image colours are read to rank starts
# Candidate rotations of the jaw about the condyles, up and down and to the side [degrees].
_OPENED, _ASIDE = (-6.0, -4.5, -3.0, -1.5, 1.5, 3.0, 4.5, 6.0), (-4.0, -2.0, 2.0, 4.0)
# Candidate positions of the incisal point: left, down, and forward of the mean path of plain opening [mm]. The solver
# converges from about 1.7 mm. In a lateral excursion, the jaw rotates about the condyle of that side, so the point
# moves forward. Jaws of some subjects open 10 mm in front of the mean path. In three takes with 1,187 frames, 90 % of
# the frames have a candidate within 2.3, 3.1 and 2.9 mm, and all within 5.6 mm.
_DOWN = [*np.arange(0.0, 21.0, 2.5).tolist(), *np.arange(24.0, 45.0, 4.0).tolist()]
_PLACES_MM = [
    *((0.0, down, 0.0) for down in _DOWN),
    *((0.0, down, forward) for down in (2.0, 6.0) for forward in (3.5, 7.0)),
    *((0.0, down, forward) for down in (12.0, 17.0, 22.0, 27.0, 32.0) for forward in (5.0, 10.0)),
    (0.0, 37.0, 10.0),
    *((left, down, 0.5 * abs(left)) for left in (-9.0, -6.0, -3.0, 3.0, 6.0, 9.0) for down in (0.0, 4.0, 8.0)),
    *((left, down, 0.5 * abs(left)) for left in (-6.0, 6.0) for down in (13.0, 18.0)),
    *((left, down, 0.5 * abs(left)) for left, down in ((-12.0, 0.0), (12.0, 0.0), (-5.0, 24.0), (5.0, 24.0))),
]
# Candidate shifts of the head: left, up and forward [mm].
_NEAR_MM, _FAR_MM = (-3.0, 0.0, 3.0), (-6.0, 6.0)
_SHIFTS_MM = [
    *((left, up, front) for left in _NEAR_MM for up in _NEAR_MM for front in _NEAR_MM),
    *((far, 0.0, 0.0) for far in _FAR_MM),
    *((0.0, far, 0.0) for far in _FAR_MM),
]

# Residual gate of the final step, which uses all faces of the scans [px]. Spacing of contour samples [px]. Image motion
# after which the scans are rendered again [px].
LAST_GATES_PX, SAMPLE_STEP_PX, REDRAW_PX = (2.0,), 2.0, 2.0
# Parallax within a scan [px] and change of scale [-] up to which its rendering is warped; rendering takes most of the
# time.
_PARALLAX_PX, _ZOOM = 4.0, 1.04
# Number of crown faces of the scans before the final step, and in a search, in images of lower resolution.
FACES, _COARSE_FACES = 6_000, 2_000
# The usual matched contour is the median over the last `USUAL_FRAMES` frames, but at least `LEAST_USUAL` times that of
# the first frame, so that slowly closing lips do not redefine it. Below a fraction `AGAIN` of it, a lost arch stays
# lost.
USUAL_FRAMES, LEAST_USUAL, AGAIN = 15, 0.7, 0.5
# Border variance times correlation length that sets the weight of the condylar prior [px^3]: for a clearly visible jaw,
# and in uncertain frames, where a lower weight would let a hidden jaw drift.
_LOOSE_PX3, _FIRM_PX3 = 3.0, 15.0
BORDER_PX3 = 0.7**2 * CORRELATION_PX  # border variance times correlation length, as estimated from residuals
# Penalty per unit of the condyles' squared Mahalanobis distance, as length of matched contour [px]: Tukey's loss of a
# sample beyond the gate is 4.685^2 / 6, and neighbouring samples are correlated over `CORRELATION_PX`.
_STRAIN_PX = 0.5 * CORRELATION_PX * 6.0 / 4.685**2
# Minimum length of the contour in sight, as a fraction of the contour that the other arch does not hide [-]. Of a wrong
# pose, little may be in sight, and match by chance.
_LEAST_IN_SIGHT = 0.3
_FAST_MM = 1.0  # predicted motion per frame above which other starts are tried [mm]
# Number of starts that a search tries near the last poses, number of starts that it tries anywhere in the human range
# of motion, and number of starts that it aligns fully. Colours rank the correct start among the first 22 of 57.
_HOPEFUL_NEAR, _HOPEFUL, _FINALISTS = 12, 24, 3


#: Residual gates of an alignment that starts from the prediction, and of one that starts from a more distant pose [px].
NEAR_GATES_PX, FAR_GATES_PX = (6.0, 4.0, 3.0, 2.5, 2.0), (12.0, 8.0, 6.0, 4.0, 3.0, 2.5, 2.0)
#: Residual gates of the short alignments by which a search compares starts [px].
TRIAL_GATES_PX = (8.0, 6.0)
_Gates = tuple[float, ...]


@dataclass(frozen=True)
class Effort:
    """Steps of an alignment, conditions for starting searches, and their sizes; by default, for recorded images."""

    gates_px: _Gates = NEAR_GATES_PX  # residual gates of the steps of an alignment that starts from the prediction
    next_px: _Gates = NEAR_GATES_PX  # residual gates after one dropped frame
    far_px: _Gates = NEAR_GATES_PX  # residual gates after several dropped frames
    wide_px: _Gates | None = FAR_GATES_PX  # gates for other starts and at the end of a search; None: `gates_px`
    uncertain: float = 0.8  # fraction of the usual matched contour below which other starts are tried
    searched: float = 0.6  # fraction below which a search starts, provided that hardly any frames were dropped
    jaws: int = 16  # number of jaw poses tried by a search
    finalists: int = 3  # number of jaw poses aligned fully
    heads: int = 12  # number of head poses tried
    search_every: int = 1  # interval between searches, in failed frames
    searches: int = 8  # number of failed frames after which teeth count as not visible
    later_every: int = 8  # like `search_every`, once teeth count as not visible
    in_turn: bool = False  # whether jaw and head are then searched for in different frames, to limit the time per frame
    learn_every: int = 1  # interval between updates of the colours, in frames


#: Effort for recorded images.
THOROUGH = Effort()
#: Effort for live images; searches are less frequent, since frames are dropped during a search.
FAST = Effort(
    gates_px=(8.0, 3.0, 2.0),
    next_px=(16.0, 6.0, 2.5, 2.0),
    far_px=(24.0, 14.0, 8.0, 4.0, 2.0),
    wide_px=None,
    uncertain=0.6,
    searched=0.4,
    jaws=4,
    finalists=1,
    heads=3,
    search_every=2,
    searches=4,
    later_every=6,
    in_turn=True,
    learn_every=6,
)


def head_shifts(T_world_head: Array, axes: Array) -> Array:
    """Return candidate head motions in the world, shape (N, 4, 4); `axes` (3, 3) map scan axes to left, up, front."""
    to_world = T_world_head[:3, :3] @ axes.T
    return np.stack([translation(to_world @ shift) for shift in np.array(_SHIFTS_MM)])


def turned_starts(condyles: CondyleMotion, bases: Sequence[Array]) -> list[Array]:
    """Return poses T_upper_lower (4, 4): each base pose rotated about the condyles by candidate angles."""
    hinge, axes = condyles.hinge, condyles.axes
    turns = [np.deg2rad(a) * axes[0] for a in _OPENED] + [np.deg2rad(a) * axes[1] for a in _ASIDE]
    about = [translation(hinge) @ se3_exp(np.append(turn, np.zeros(3))) @ translation(-hinge) for turn in turns]
    return [base @ turn for turn in about for base in bases]


def rank_by_colour(
    places: Sequence[Array], views: Sequence[View], scans: Sequence[Scan], arch: int, taken: Sequence[Mask] = ()
) -> list[int]:
    """Return the indices of poses T_world_arch (4, 4), ranked by the tooth likelihood of the pixels at their crowns.

    `taken` has, for each view, the pixels (h, w) of the other arch, which are ignored; empty if unknown.
    """
    points = scans[arch].crown_vertices(_POINTS)
    scores = np.zeros(len(places))
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
            scores[k] += float(like[y[inside], x[inside]].sum())
    return [int(k) for k in np.argsort(-scores, kind="stable")]


class PoseSearch:
    """Alignment of both arches in the views of a video frame."""

    def __init__(
        self,
        scans: Sequence[Scan],
        landmarks: Array,
        axes: Array,
        executor: Executor | None,
    ) -> None:
        """Prepare the scans; for the arguments, see `RegionTracker`."""
        self.config = replace(
            TrackingConfig(),
            sample_step_px=SAMPLE_STEP_PX,
            redraw_px=REDRAW_PX,
            parallax_px=_PARALLAX_PX,
            largest_zoom=_ZOOM,
        )
        self.solver = ContourSolver([replace(scan, thin=None) for scan in scans], self.config, executor)
        quick = replace(self.config, smooth_errors=None)  # only refined alignments need the model of smooth errors
        self._thin = ContourSolver([thinned(scan, FACES) for scan in scans], quick, executor)
        self.condyles = CondyleMotion(landmarks, axes)
        self._loose, self._firm = (CondyleTerm(self.condyles, noise) for noise in (_LOOSE_PX3, _FIRM_PX3))
        self._bite, self._axes = BiteTerm(landmarks[:3], axes[1], BORDER_PX3), axes
        # A variance times a length scales with the third power [px^3].
        coarse = replace(
            quick.with_gates_scaled(COARSE),
            redraw_px=COARSE * REDRAW_PX,
            typical_noise_px3=COARSE**3 * self.config.typical_noise_px3,
        )
        self._coarse = ContourSolver([thinned(scan, _COARSE_FACES) for scan in scans], coarse, executor)
        self._coarse_terms = tuple(
            replace(term, noise_px3=COARSE**3 * term.noise_px3) for term in (self._firm, self._bite)
        )

    def near(self, start: Array, look: InstantViews, *, firm: bool = False) -> Solution:
        """Align from T_world_upper and T_world_lower (2, 4, 4) that are accurate to a few tenths of a millimetre.

        If `firm`, for uncertain frames, the condylar prior has a high weight.
        """
        return self._align(start, look, FAR_GATES_PX, firm)

    def best(self, starts: list[Array], look: InstantViews, last: Array) -> Solution:
        """Align from the first start, the prediction, and if the motion from the `last` poses is fast, from others."""
        solution = self._align(starts[0], look, NEAR_GATES_PX)
        if np.abs(starts[0][:, :3, 3] - last[:, :3, 3]).max() > _FAST_MM:
            carried = solution.poses[0] @ se3_inverse(last[0]) @ last[1]
            for start in (last, np.stack([solution.poses[0], carried])):
                solution = self._better(solution, self._align(start, look, FAR_GATES_PX))
        return solution

    def from_farther(self, solution: Solution, start: Array, last: Array, look: InstantViews) -> Solution:
        """Align from a start pose, using wide residual gates, and from the last poses; return the better solution."""
        solution = self._better(solution, self._align(start, look, FAR_GATES_PX))
        return self._better(solution, self._align(last, look, NEAR_GATES_PX))

    def with_jaw_searched(
        self,
        solution: Solution,
        predicted: Array,
        last: Array,
        look: InstantViews,
        motion: MotionPredictor,
        everywhere: bool,
    ) -> Solution:
        """Try earlier and rotated jaw poses, with `everywhere` also the full human range; keep the head pose."""
        near = [se3_inverse(poses[0]) @ poses[1] for poses in (last, *motion.pose_history())]
        near += turned_starts(self.condyles, (se3_inverse(predicted[0]) @ predicted[1], near[0]))
        anywhere = [self.condyles.placed(*place) for place in _PLACES_MM] if everywhere else []
        head, pairs = solution.poses[0], []
        for jaws, count in ((near, _HOPEFUL_NEAR if everywhere else _HOPEFUL), (anywhere, _HOPEFUL)):
            order = rank_by_colour([head @ jaw for jaw in jaws], look.views, self._thin.scans, 1)[:count]
            pairs += [np.stack([head, head @ jaws[k]]) for k in order]
        brief = [self._trial(pair, look) for pair in pairs]
        brief.sort(key=lambda trial: -self.objective_px(trial, 1.0 / COARSE))
        for trial in brief[:_FINALISTS]:
            solution = self._better(solution, self.near(trial.poses, look, firm=True))
        return solution

    def with_head_alone(self, solution: Solution, start: Array, look: InstantViews) -> Solution:
        """Align the head alone if that improves its fit; a wrong jaw pose biases the head in a joint fit."""
        alone = self._align(start, look, FAR_GATES_PX, use=_upper_alone(look.views))
        return max((solution, alone), key=lambda trial: float(fitting_share(trial)[0]))

    def with_head_searched(self, solution: Solution, predicted: Array, look: InstantViews, alone: bool) -> Solution:
        """Try shifted head poses with an unchanged jaw pose; with `alone`, the contour of the jaw is ignored."""
        shifts, use = head_shifts(predicted[0], self._axes), _upper_alone(look.views) if alone else None
        order = rank_by_colour(list(shifts @ predicted[0]), look.views, self._thin.scans, 0)[: _HOPEFUL // 2]
        brief = [self._trial(shifts[k] @ predicted, look, use) for k in order]
        brief.sort(key=lambda trial: -float(score_px(trial)[0].sum()))
        best = [self._align(trial.poses, look, FAR_GATES_PX, True, use) for trial in brief[:_FINALISTS]]
        if alone:
            return max((solution, *best), key=lambda trial: float(score_px(trial)[0].sum()))
        return max((solution, *best), key=self.objective_px)

    def with_jaw(self, solution: Solution, look: InstantViews, least: float) -> Solution:
        """Align both arches once more, since the head may have been aligned alone; return the better solution.

        The given solution is kept if less than the fraction `least` of the jaw's contour fits: a jaw that is not found
        biases the head.
        """
        both = self.near(solution.poses, look, firm=True)
        return self._better(solution, both) if fitting_share(both)[1] >= least else solution

    def look(self, colours: LearnedColours, pictures: Sequence[Picture | None], before: Array) -> InstantViews:
        """Return the views of a frame; arguments are as for `LearnedColours.views`."""
        return InstantViews(colours, pictures, before, (self._thin, self._coarse))

    def polished(self, solution: Solution, look: InstantViews, *, firm: bool = False) -> Solution:
        """Refine an alignment with all faces of the scans; visibility is not recomputed."""
        terms = (self._firm if firm else self._loose, self._bite)
        return self.solver.solve(solution.poses, look.counting, LAST_GATES_PX, None, terms, rendering=look.rendering)

    def objective_px(self, solution: Solution, px: float = 1.0) -> float:
        """Return the matched contour minus a penalty for implausible condyles [px], in px of the usual resolution.

        `px` is the size of the pixels of the solution in these px.
        """
        return px * float(score_px(solution).sum()) - _STRAIN_PX * self.condyles.strain(relative_pose(*solution.poses))

    def _better(self, one: Solution, other: Solution) -> Solution:
        """Return the solution with the higher objective."""
        return other if self.objective_px(other) > self.objective_px(one) else one

    def _trial(self, start: Array, look: InstantViews, use: Mask | None = None) -> Solution:
        """Align in a few steps at the resolution of a search."""
        gates_px = tuple(COARSE * gate for gate in TRIAL_GATES_PX)
        views, rendering = look.coarse
        return self._coarse.solve(start, views, gates_px, use, self._coarse_terms, rendering=rendering)

    def _align(
        self,
        start: Array,
        look: InstantViews,
        gates_px: Sequence[float],
        firm: bool = False,
        use: Mask | None = None,
    ) -> Solution:
        terms = (self._firm if firm else self._loose, self._bite)
        return self._thin.solve(start, look.views, gates_px, use, terms, rendering=look.rendering)


def _upper_alone(views: Sequence[View]) -> Mask:
    use = present_masks(views)
    use[1] = False
    return use


def fraction_in_sight(solution: Solution, views: Sequence[View]) -> Array:
    """Return the matched fraction of the contour in sight, per arch, shape (2,), from views with counts.

    Unlike `fitting_share`, it does not depend on how much of the teeth is hidden by the lips.
    """
    counts = [view.edges.counts for view in views if isinstance(view.edges, RegionView)]
    in_sight_px = np.sum([count.in_sight_px for count in counts if count is not None], axis=0)
    least_px = _LEAST_IN_SIGHT * solution.visible_px.sum(1)
    return np.asarray(score_px(solution).sum(1) / np.maximum(np.maximum(in_sight_px, least_px), 1.0), np.float64)
