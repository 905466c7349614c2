"""Tracking of single frames: align, detect failure, escalate, and classify the result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, TRACKED, LostReason
from jawusd.geometry import transform_point
from jawusd.tracking.contour.equations import Solution, motion_about, translation
from jawusd.tracking.contour.frame_record import NO_LOSS, FrameRecord, Loss
from jawusd.tracking.contour.quality import (
    coverage_error,
    crown_sigma_mm,
    matched_px,
    penalised_score_px,
    residual_px,
    score_px,
    uncovered_px,
    view_residual_px,
)
from jawusd.tracking.contour.scan import ARCHES
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import FEWEST_MASKS, View, present_masks
from jawusd.tracking.initialization.pose_search import shift_to_masks
from jawusd.tracking.sequence.history import History


@dataclass(frozen=True, eq=False)
class _Trial:
    """A solution with its uncovered and total mask pixels and the masks used, each per arch and view, shape (2, C)."""

    solution: Solution
    uncovered: Array
    mask_px: Array
    use: Mask

    @property
    def coverage(self) -> Array:
        """The uncovered fraction of every mask, NaN without a mask."""
        return coverage_error(self.uncovered, self.mask_px)

    def objective(self, price: float) -> Array:
        """Return the objective per arch and view: matched contour less the penalty for uncovered mask [px]."""
        return penalised_score_px(self.solution, np.where(self.use, self.uncovered, 0.0), price)


@dataclass(frozen=True, eq=False)
class _Instant:
    """Inputs shared by all attempts on one frame; see `FrameTracker.track`."""

    starts: Sequence[Array]
    views: Sequence[View]
    pose_history: Sequence[Array]


class FrameTracker:
    """Tracks frames from predictions, with increasingly expensive attempts while an alignment looks wrong."""

    def __init__(self, solver: ContourSolver, history: History) -> None:
        self._solver, self._config, self.history = solver, solver.config, history
        self.searched = False  # whether the multi-start search ran on the last frame

    def track(
        self,
        starts: Sequence[Array],
        views: Sequence[View],
        pose_history: Sequence[Array] | None,
        reach_px: float = 0.0,
    ) -> FrameRecord:
        """Align one frame.

        Args:
            starts: predicted T_world_upper and T_world_lower, the most likely first, each shape (2, 4, 4).
            views: one view per camera.
            pose_history: further starts for the multi-start search, each shape (2, 4, 4); None disables that search.
            reach_px: expected error of the first start.
        """
        gates = self._config.gates_from(reach_px)
        instant = _Instant(starts, views, pose_history or ())
        self.searched = False
        trial = first = self._begin(starts[0], views, gates)
        # arches that fit worse than in recent frames, and worse than closing lips can explain
        suspect = partial(self._failing, share=self._config.suspect_score)
        alarming = partial(self._failing, share=self._config.alarming_score)
        for failing, attempt in (
            (suspect, self._try_other_starts),
            (self._uneven, self._drop_conflicting_masks),
            (suspect, self._try_wide_gates),
            (alarming, self._search_many_starts),
        ):
            bad = failing(trial)
            if bad.any() and (attempt != self._search_many_starts or pose_history is not None):
                trial = attempt(trial, bad, instant)
        kept = trial.use & ~self._spoiled(trial, 1)
        if (kept != trial.use).any():  # exclude masks that biased the first attempt
            trial = self._try(trial.solution.poses, views, gates, kept)
        return self._record(first, trial)

    def _begin(self, start: Array, views: Sequence[View], gates: Sequence[float]) -> _Trial:
        """Align once and, if some masks are wrong, again without them."""
        use = present_masks(views)
        trial = self._try(start, views, gates, use)
        kept = use & ~self._spoiled(trial, FEWEST_MASKS)
        return trial if (kept == use).all() else self._try(start, views, gates, kept)

    def _record(self, first: _Trial, trial: _Trial) -> FrameRecord:
        c = self._config
        status = np.where(trial.use.all(1), TRACKED, PARTIAL).astype(np.int8)
        gain = trial.objective(c.uncovered_price).sum(1) - first.objective(c.uncovered_price).sum(1)
        status[(gain > c.recovery_gain * score_px(trial.solution).sum(1)) & (status == TRACKED)] = RECOVERED
        losses = self._losses(trial)
        status[[loss.reason != LostReason.NONE for loss in losses]] = LOST
        return FrameRecord(trial.solution, status, trial.use, trial.coverage, losses)

    def _try(
        self,
        start: Array,
        views: Sequence[View],
        gates: Sequence[float],
        use: Mask,
        solver: ContourSolver | None = None,
    ) -> _Trial:
        solver = solver or self._solver
        solution = solver.solve(start, views, gates, use)
        return _Trial(solution, *uncovered_px(solver.scans, solution.poses, views, solver.map), use)

    def _failing(self, trial: _Trial, share: float) -> Mask:
        """Return which arches have a fraction of the usual score, rough residuals or uncovered masks, shape (2,)."""
        bad = self._low_score(trial, share) | self._high_residual(trial) | self._badly_covered(trial).any(1)
        return np.asarray(bad & trial.use.any(1))

    def _uneven(self, trial: _Trial) -> Mask:
        """Return which arches are alarming, or fit one view far worse than usual, shape (2,)."""
        limit = self._config.uneven_residual * self.history.usual_residual()[:, None]
        uneven = (trial.use & (view_residual_px(trial.solution) > limit)).any(1)
        return self._failing(trial, self._config.alarming_score) | uneven

    def _low_score(self, trial: _Trial, share: float) -> Mask:
        return np.asarray(score_px(trial.solution).sum(1) < share * self.history.usual_score().sum(1))

    def _high_residual(self, trial: _Trial) -> Mask:
        return ~(residual_px(trial.solution) < self._config.suspect_residual * self.history.usual_residual())

    def _badly_covered(self, trial: _Trial) -> Mask:
        """Return which masks are covered less by their scans than in recent frames, shape (2, C)."""
        return trial.use & (trial.coverage - self.history.usual_coverage() > self._config.suspect_coverage)

    def _spoiled(self, trial: _Trial, fewest: int) -> Mask:
        """Return the masks that a scan does not fit although it fits at least `fewest` other masks, shape (2, C)."""
        dead = trial.use & (score_px(trial.solution) < self._config.dead_score * self.history.usual_score())
        uncovered = trial.use & (trial.coverage > self._config.lost_coverage)  # same limit as for a lost arch
        wrong = self._badly_covered(trial) | uncovered | dead | self._outweighed(trial)
        for r in ARCHES:
            if (trial.use[r] & ~wrong[r]).sum() < fewest:
                wrong[r] = False  # a wrong pose is more likely than so many wrong masks
        return wrong

    def _outweighed(self, trial: _Trial) -> Mask:
        """Return the masks whose penalty exceeds their matched contour, shape (2, C).

        Pixels that are usually uncovered are exempt: errors of a long outline would outweigh a short matched contour.
        """
        unusual_px = trial.uncovered - self.history.usual_coverage() * trial.mask_px
        score = penalised_score_px(trial.solution, unusual_px, self._config.uncovered_price)
        return np.asarray(trial.use & (score <= 0.0))

    def _losses(self, trial: _Trial) -> tuple[Loss, Loss]:
        """Return, for each arch, the first check that it fails."""
        c, solution = self._config, trial.solution
        residual, score, usual = residual_px(solution), score_px(solution).sum(1), self.history.usual_score().sum(1)
        masks, matched = trial.use.sum(1), matched_px(solution)
        uncovered = np.where(trial.use, trial.coverage, 0.0).max(1)
        sigma = [crown_sigma_mm(scan, solution, r, c) for r, scan in enumerate(self._solver.scans)]
        allowed_px = c.lost_residual * c.suspect_residual * self.history.usual_residual()
        weak = self._high_residual(trial) & self._low_score(trial, c.suspect_score)

        def first(r: int) -> Loss:
            share = float(score[r] / usual[r]) if usual[r] > 0 else np.inf
            checks = (
                (masks[r] < FEWEST_MASKS, LostReason.FEW_MASKS, masks[r], FEWEST_MASKS),
                (matched[r] < c.least_matched_px, LostReason.LITTLE_CONTOUR, matched[r], c.least_matched_px),
                (not residual[r] < allowed_px[r], LostReason.ROUGH_FIT, residual[r], allowed_px[r]),
                (weak[r], LostReason.LOW_SCORE, share, c.suspect_score),
                (uncovered[r] > c.lost_coverage, LostReason.UNCOVERED_MASK, uncovered[r], c.lost_coverage),
                (sigma[r] > c.lost_sigma_mm, LostReason.UNCERTAIN, sigma[r], c.lost_sigma_mm),
            )
            found = (Loss(reason, float(value), float(limit)) for failed, reason, value, limit in checks if failed)
            return next(found, NO_LOSS)

        return first(0), first(1)

    def _try_other_starts(self, trial: _Trial, suspect: Mask, instant: _Instant) -> _Trial:
        for start in instant.starts[1:]:
            other = self._try(start, instant.views, self._config.gates_from(0.0), trial.use)
            trial = self._better(trial, other, suspect, instant)
        return trial

    def _drop_conflicting_masks(self, trial: _Trial, suspect: Mask, instant: _Instant) -> _Trial:
        """Exclude a mask if the other masks of the same arch then agree far better."""
        c = self._config
        for r in np.flatnonzero(suspect):
            for k in np.flatnonzero(trial.use[r]):
                rest = trial.use.copy()
                rest[r, k] = False
                if rest[r].sum() < FEWEST_MASKS:
                    continue
                without = self._try(instant.starts[0], instant.views, c.gates_from(0.0), rest)
                gain = (without.objective(c.uncovered_price) - trial.objective(c.uncovered_price))[r, rest[r]].sum()
                if gain > c.conflict_gain * score_px(without.solution)[r, rest[r]].sum():
                    trial = without
                    break
        return trial

    def _try_wide_gates(self, trial: _Trial, suspect: Mask, instant: _Instant) -> _Trial:
        """Try again with wide residual gates, from the predictions and from the current poses."""
        for start in (*instant.starts, trial.solution.poses):
            wide = self._try(start, instant.views, self._config.wide_gates_px, trial.use)
            trial = self._better(trial, wide, suspect, instant)
        return trial

    def _search_many_starts(self, trial: _Trial, suspect: Mask, instant: _Instant) -> _Trial:
        """Try many starts around the prediction and earlier poses, and refine the most promising ones."""
        c, views = self._config, instant.views
        self.searched = True
        for r in np.flatnonzero(suspect).tolist():
            only = np.arange(2) == r
            bases = [self._onto_masks(p[r], r, views, trial.use) for p in (instant.starts[0], *instant.pose_history)]
            ranked = []
            for pose in [*_around(bases[0], self._solver.scans[r].centre, c.search_rings), *bases[1:]]:
                poses = np.where(only[:, None, None], pose, trial.solution.poses)
                brief = self._try(poses, views, c.trial_gates_px, trial.use, self._solver.rough)
                ranked.append((brief.objective(c.uncovered_price)[r].sum(), poses))
            ranked.sort(key=lambda entry: -entry[0])
            for _, poses in ranked[: c.search_finalists]:
                trial = self._better(trial, self._try(poses, views, c.wide_gates_px, trial.use), only, instant)
        return trial

    def _onto_masks(self, pose: Array, r: int, views: Sequence[View], use: Mask) -> Array:
        """Return the pose of an arch, moved onto its masks if these are out of reach of the search."""
        shift = shift_to_masks(self._solver.scans[r], pose, r, views, use)
        if np.linalg.norm(shift) <= self._config.search_rings[0][0]:
            return pose
        return translation(shift) @ pose

    def _better(self, trial: _Trial, other: _Trial, arches: Mask, instant: _Instant) -> _Trial:
        """Combine two attempts: for each of the given arches, choose the better pose."""
        price = self._config.uncovered_price
        take = arches & (other.objective(price).sum(1) > trial.objective(price).sum(1))
        if not take.any():
            return trial
        if take.all():
            return other
        poses = np.where(take[:, None, None], other.solution.poses, trial.solution.poses)
        return self._try(poses, instant.views, self._config.wide_gates_px[-2:], trial.use)


def _around(pose: Array, centre: Array, rings: Sequence[tuple[float, float]]) -> Iterator[Array]:
    """Yield a pose and, for each ring (mm, rad), the pose translated along and rotated about each axis, both ways."""
    yield pose
    c = transform_point(pose, centre)
    for mm, rad in rings:
        for k in range(6):
            for sign in (-1.0, 1.0):
                twist = np.zeros(6)
                twist[k] = sign * (rad if k < 3 else mm)
                yield motion_about(c, twist) @ pose
