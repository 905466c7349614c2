"""Frame-by-frame tracker of both arches by colour, without masks or a rig."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import Camera, relative_pose
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.quality import (
    fitting_share,
    matched_px,
    relative_covariance,
    residual_px,
    twist_covariance,
    widening,
)
from jawusd.tracking.contour.scan import ARCHES, Scan, probe_points
from jawusd.tracking.contour.views import View
from jawusd.tracking.initialization.first_frame import FIRST_ROUNDS
from jawusd.tracking.region.appearance import (
    CORRELATION_PX,
    FIRST_RATES,
    RATES,
    Cut,
    InstantViews,
    LearnedColours,
    Picture,
)
from jawusd.tracking.region.search import (
    AGAIN,
    LEAST_USUAL,
    THOROUGH,
    USUAL_FRAMES,
    PoseSearch,
    fraction_in_sight,
)
from jawusd.tracking.sequence.history import MotionPredictor

# Fractions of the usual matched contour length below which, in this order, wider residual gates are tried, the jaw is
# searched for, and an arch becomes lost.
_UNCERTAIN, _SUSPECT, _LOST = THOROUGH.uncertain, THOROUGH.searched, 0.25
_EAGER, _OFTEN = 6, 4  # a lost arch is searched for in each of the first frames, then in every n-th one; see `_is_due`
# number of frames in which wide residual gates are not tried again after a failure: lips stay closed for a while
_RESTING = 4
_WIDE_MM = 40.0  # maximum expected opening of a jaw that was not visible [mm]


@dataclass(frozen=True, eq=False)
class RegionPose:
    """Poses of both arches in one video frame."""

    # T_world_upper and T_world_lower, shape (2, 4, 4); of an arch not found, the pose that the next frame starts from
    poses: Array
    found: Mask  # whether each arch was found, shape (2,)
    covariance: Array  # covariance of the poses' left twists about the world origin, NaN if not found, shape (2, 6, 6)
    objective_px: float = 0.0  # objective [px]: matched contour of both arches minus a penalty for implausible condyles
    solution: Solution | None = None  # the alignment; None for poses read from a file
    # matched fraction of the contour relative to the usual one, shape (2,)
    usual: Array = field(default_factory=lambda: np.ones(2))
    # minimum of `usual` for an arch to count as found, shape (2,)
    least: Array = field(default_factory=lambda: np.zeros(2))
    least_mm: float = 0.0  # minimum standard deviation of the incisal point, where nothing confirms the poses [mm]

    @property
    def uncertain(self) -> bool:
        """Whether less of the contour fits than usual, so that the poses may be wrong."""
        return bool((self.usual < _UNCERTAIN).any())

    @property
    def fit(self) -> float:
        """Matched fraction of the visible contour, 0 .. 1; the smaller value of both arches."""
        return 0.0 if self.solution is None else float(fitting_share(self.solution).min())

    def unconfirmed(self, least_mm: float, incisor: Array) -> RegionPose:
        """Return the poses with a standard deviation of at least `least_mm` at a point of the lower teeth, (3,)."""
        between = relative_covariance(self.poses[0], *self.covariance)
        wider = widening(relative_pose(*self.poses), between, incisor, least_mm)
        return replace(self, covariance=wider * self.covariance, least_mm=least_mm)


class RegionTracker:
    """Tracker of both arches in images of several cameras; colours are learned while tracking.

    Attributes:
        first_fit: matched fraction of the contour in sight in the first frame, 0 .. 1, of the worse arch.
    """

    def __init__(
        self,
        scans: Sequence[Scan],
        cameras: Sequence[Camera],
        landmarks: Array,
        axes: Array,
        executor: Executor | None = None,
    ) -> None:
        """Prepare both scans, in one frame and in occlusion; `landmarks` and `axes` are as in `CondyleMotion`."""
        self._search = PoseSearch(scans, landmarks, axes, executor)
        self._colours = self._latest = LearnedColours(scans, cameras, axes)
        self._first_share, self.first_fit = np.zeros(2), 0.0

    def begin(self, cut: Cut, poses: Array) -> RegionPose:
        """Learn the colours of a first frame at poses accurate to a few tenths of a millimetre, and refine them."""
        self._colours.begin(cut(poses), poses)
        for _ in range(FIRST_ROUNDS):
            look = self._search.look(self._colours, cut(poses), poses)
            rough = self._search.near(poses, look)
            solution = self._search.polished(rough, look)
            poses = solution.poses
            look.learn(poses, FIRST_RATES)
        self._first_share = fitting_share(rough)
        self.first_fit = float(fraction_in_sight(solution, look.counting).min())
        objective_px = self._search.objective_px(solution)
        return RegionPose(poses, np.ones(2, bool), _covariance(solution), objective_px, solution)

    def views(self, pictures: Sequence[Picture | None], poses: Array) -> list[View]:
        """Return the views of a frame with poses (2, 4, 4), with the colours of the last frame that was followed."""
        return self._latest.views(pictures, poses)

    def follow(self, cuts: Iterator[Cut], poses: Array) -> Iterator[RegionPose]:
        """Yield the poses of consecutive frames, forwards or backwards from a first frame with given poses.

        Every call starts from the colours learned in `begin`.
        """
        colours = self._colours.copy()
        for found in _DirectionTracker(self._search, colours, self._first_share, poses).follow(cuts):
            self._latest = colours
            yield found


class _DirectionTracker:
    """Tracker that follows the teeth in one temporal direction."""

    def __init__(self, search: PoseSearch, colours: LearnedColours, first_share: Array, poses: Array) -> None:
        self._search, self._colours, self._first_share, self._poses = search, colours, first_share, poses
        self._motion = MotionPredictor(poses, probe_points(search.solver.scans))
        self._motion.remember(poses, np.ones(2, bool))
        self._usual: deque[Array] = deque(maxlen=USUAL_FRAMES)
        self._found, self._missed, self._absent, self._rest = np.ones(2, bool), 0, 0, 0

    def follow(self, cuts: Iterator[Cut]) -> Iterator[RegionPose]:
        """Yield the poses of consecutive frames."""
        for cut in cuts:
            starts = self._motion.starts()
            head, wide = starts[0][0], self._search.condyles.placed(0.0, _WIDE_MM, 0.0)
            pictures = cut(starts[0] if self._found[1] else np.stack([head, head @ wide]))
            look = self._search.look(self._colours, pictures, self._poses)
            usual = np.median([*self._usual] or [self._first_share], axis=0)
            usual = np.maximum(usual, LEAST_USUAL * self._first_share)
            rough, searched = self._located(starts, look, usual)
            yield self._taken(look, rough, searched, usual, any(picture is not None for picture in pictures))

    def _located(self, starts: list[Array], look: InstantViews, usual: Array) -> tuple[Solution, bool]:
        """Return a rough alignment, and whether it came from a search."""
        search, searched = self._search, False
        solution = search.best(starts, look, self._poses)
        share = fitting_share(solution)
        self._rest = max(self._rest - 1, 0)
        if (share < _UNCERTAIN * usual).any() and not self._rest:
            near, solution = solution, search.from_farther(solution, starts[0], self._poses, look)
            share, self._rest = fitting_share(solution), _RESTING if solution is near else 0
        if share[1] < _SUSPECT * usual[1]:
            solution, searched = search.near(starts[0], look, firm=True), True
            solution = search.with_head_alone(solution, starts[0], look)
            share = fitting_share(solution)
        self._absent = self._absent + 1 if share[0] < _SUSPECT * usual[0] else 0
        if _is_due(self._absent, self._found[0]):
            solution = search.with_head_searched(solution, starts[0], look, bool(share[1] < _SUSPECT * usual[1]))
            share, searched = fitting_share(solution), True
        missed = share[0] >= self._least()[0] * usual[0] and share[1] < _SUSPECT * usual[1]
        self._missed = self._missed + 1 if missed else 0
        if _is_due(self._missed, self._found[1]):
            lost = not self._found[1]
            solution = search.with_jaw_searched(solution, starts[0], self._poses, look, self._motion, lost)
        if searched:
            solution = search.with_jaw(solution, look, self._least()[1] * usual[1])
        return solution, searched

    def _least(self) -> Array:
        """Return the fraction of the usual matched contour below which each arch counts as not found, shape (2,)."""
        return np.where(self._found, _LOST, AGAIN)

    def _taken(self, look: InstantViews, rough: Solution, searched: bool, usual: Array, seen: bool) -> RegionPose:
        """Refine a rough alignment, decide which arches are found, and learn if both are."""
        solution = self._search.polished(rough, look, firm=searched)
        share, least = fitting_share(rough), self._least()
        found = (share >= least * usual) & (matched_px(solution) >= self._search.config.least_matched_px)
        # A lost jaw that fits a little keeps its pose as the start for the next frame, but is not found.
        guessed = bool(found[0] and not found[1] and share[1] >= _LOST * usual[1])
        kept = np.array([found[0], found[1] or guessed])
        poses = np.where(kept[:, None, None], solution.poses, self._motion.predict())
        covariance = np.where(found[:, None, None], _covariance(solution), np.nan)
        if found.all():
            look.learn(poses, RATES)
            self._search.condyles.learn(relative_pose(*poses), relative_covariance(poses[0], *covariance))
            self._usual.append(share)
        self._motion.update(poses, found, np.full(2, seen), guessed)
        self._poses, self._found = poses, found
        objective_px = self._search.objective_px(solution)
        return RegionPose(poses, found, covariance, objective_px, solution, share / usual, least)


def _is_due(count: int, found: bool) -> bool:
    """Return whether to search for an arch that fits badly for the `count`-th frame in a row.

    For an arch that was found in the previous frame, searches are due at doubling intervals; for a lost arch, in each
    of the first `_EAGER` frames, then in every `_OFTEN`-th one.
    """
    return count > 0 and (count & (count - 1) == 0 if found else count <= _EAGER or count % _OFTEN == 0)


def _covariance(solution: Solution) -> Array:
    """Return the covariances of the left twists of both arches about the world origin, shape (2, 6, 6)."""
    sigma = residual_px(solution)
    return np.stack([twist_covariance(solution, r, float(sigma[r]), CORRELATION_PX) for r in ARCHES])
