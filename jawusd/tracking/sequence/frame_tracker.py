"""One instant at a time: solve, notice failure, try harder, and say what happened."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, TRACKED, LostReason
from jawusd.geometry import make_transform, se3_exp, transform_point
from jawusd.geometry.arrays import Array, Mask
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.frame_record import NO_LOSS, FrameRecord, Loss
from jawusd.tracking.contour.quality import (
    crown_sigma_mm,
    matched_px,
    residual_px,
    score_px,
    uncovered_px,
    view_residual_px,
)
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View
from jawusd.tracking.initialization.reacquire import shift_to_masks
from jawusd.tracking.sequence.history import History

_ROWS = (0, 1)
_FEWEST_MASKS = 2  # one view leaves the depth to the outline's width, which a wrong mask shares


@dataclass(frozen=True, eq=False)
class _Trial:
    """Hold a solution with the mask pixels it leaves uncovered; arrays per row and view, shape (2, C)."""

    solution: Solution
    bare_px: Array
    mask_px: Array
    use: Mask

    @property
    def coverage(self) -> Array:
        """Return E_SP over mask pixels, NaN without a mask."""
        return np.where(self.mask_px > 0, self.bare_px / np.maximum(self.mask_px, 1), np.nan)

    def worth(self, price: float) -> Array:
        """Return what ranks poses, per row and view: contour that fits less the price of uncovered mask [px]."""
        return score_px(self.solution) - price * np.where(self.use, self.bare_px, 0.0)


class FrameTracker:
    """Track instant after instant from predictions, with the failure ladder."""

    def __init__(self, solver: ContourSolver, config: TrackingConfig, history: History) -> None:
        self._solver = solver
        self._config = config
        self.history = history

    def track(
        self,
        starts: Sequence[Array],
        views: Sequence[View],
        gallery: Sequence[Array] | None,
        reach_px: float = 0.0,
    ) -> FrameRecord:
        """Align one instant.

        Args:
            starts: predictions, the likeliest first: T_world_upper, T_world_lower, each shape (2, 4, 4).
            views: one per camera.
            gallery: further starts for the last resort, each shape (2, 4, 4); None forgoes the last resort.
            reach_px: how far off the first start may be.
        """
        gates = self._config.gates_from(reach_px)
        trial = first = self._begin(starts[0], views, gates)
        for rows, attempt in (
            (self._suspect, self._others),
            (self._uneven, self._leave_out),
            (self._suspect, self._widen),
            (self._alarming, self._search),
        ):
            bad = rows(trial)
            if bad.any() and (attempt != self._search or gallery is not None):
                trial = attempt(trial, bad, starts, views, gallery)
        kept = trial.use & ~self._spoiled(trial, 1)
        if (kept != trial.use).any():  # a mask that had drawn the first attempt away from all others
            trial = self._try(trial.solution.poses, views, gates, kept)
        return self._record(first, trial)

    def align_once(self, start: Array, views: Sequence[View], reach_px: float) -> FrameRecord:
        """Align one instant from one prediction, shape (2, 4, 4), without the ladder; see `track`."""
        trial = self._begin(start, views, self._config.gates_from(reach_px))
        return self._record(trial, trial)

    def _begin(self, start: Array, views: Sequence[View], gates: Sequence[float]) -> _Trial:
        """Align once, and once more without masks that are spoiled."""
        use = np.array([[v.present[r] for v in views] for r in _ROWS])
        trial = self._try(start, views, gates, use)
        kept = use & ~self._spoiled(trial, 2)
        return trial if (kept == use).all() else self._try(start, views, gates, kept)

    def _record(self, first: _Trial, trial: _Trial) -> FrameRecord:
        c = self._config
        status = np.where(trial.use.all(1), TRACKED, PARTIAL).astype(np.int8)
        gain = trial.worth(c.bare_price).sum(1) - first.worth(c.bare_price).sum(1)
        status[(gain > c.recovery_gain * score_px(trial.solution).sum(1)) & (status == TRACKED)] = RECOVERED
        losses = self._losses(trial)
        status[[loss.reason != LostReason.NONE for loss in losses]] = LOST
        return FrameRecord(trial.solution, status, trial.use, trial.coverage, losses)

    def _try(self, start, views, gates, use) -> _Trial:
        solution = self._solver.solve(start, views, gates, use)
        return _Trial(solution, *uncovered_px(self._solver.scans, solution, views), use)

    def _suspect(self, trial: _Trial) -> Mask:
        """Tell which rows look worse than they lately did, shape (2,)."""
        return (self._scarce(trial) | self._rough(trial) | self._bare(trial).any(1)) & trial.use.any(1)

    def _alarming(self, trial: _Trial) -> Mask:
        """Tell which rows look so bad that closing lips alone do not explain it, shape (2,)."""
        bad = self._scarce(trial, self._config.alarming_score) | self._rough(trial) | self._bare(trial).any(1)
        return bad & trial.use.any(1)

    def _uneven(self, trial: _Trial) -> Mask:
        """Tell which rows are alarming or fit one view far worse than they usually fit, shape (2,)."""
        limit = self._config.uneven_residual * self.history.usual_residual()[:, None]
        return self._alarming(trial) | (trial.use & (view_residual_px(trial.solution) > limit)).any(1)

    def _scarce(self, trial: _Trial, share: float | None = None) -> Mask:
        share = self._config.suspect_score if share is None else share
        return score_px(trial.solution).sum(1) < share * self.history.usual_score().sum(1)

    def _rough(self, trial: _Trial, factor: float = 1.0) -> Mask:
        limit = factor * self._config.suspect_residual * self.history.usual_residual()
        return ~(residual_px(trial.solution) < limit)

    def _bare(self, trial: _Trial) -> Mask:
        """Tell which masks stay uncovered more than they lately did, shape (2, C)."""
        return trial.use & (trial.coverage - self.history.usual_coverage() > self._config.suspect_coverage)

    def _spoiled(self, trial: _Trial, fewest: int) -> Mask:
        """Tell which masks the scan neither covers nor fits while it does at least so many others, shape (2, C)."""
        fit = score_px(trial.solution)
        dead = trial.use & (fit < self._config.dead_score * self.history.usual_score())
        wrong = self._bare(trial) | dead
        for r in _ROWS:
            if (trial.use[r] & ~wrong[r]).sum() < fewest:
                wrong[r] = False  # it is the pose that is wrong, not so many masks
        return wrong

    def _losses(self, trial: _Trial) -> tuple[Loss, Loss]:
        """Return the first check that each arch fails."""
        c, solution = self._config, trial.solution
        residual, score, usual = residual_px(solution), score_px(solution).sum(1), self.history.usual_score().sum(1)
        masks, matched = trial.use.sum(1), matched_px(solution)
        uncovered = np.where(trial.use, trial.coverage, 0.0).max(1)
        sigma = [crown_sigma_mm(scan, solution, r, c) for r, scan in enumerate(self._solver.scans)]
        rough_px = c.lost_residual * c.suspect_residual * self.history.usual_residual()
        weak = self._rough(trial) & self._scarce(trial)

        def first(r: int) -> Loss:
            share = float(score[r] / usual[r]) if usual[r] > 0 else np.inf
            checks = (
                (masks[r] < _FEWEST_MASKS, LostReason.FEW_MASKS, masks[r], _FEWEST_MASKS),
                (matched[r] < c.least_matched_px, LostReason.LITTLE_CONTOUR, matched[r], c.least_matched_px),
                (not residual[r] < rough_px[r], LostReason.ROUGH_FIT, residual[r], rough_px[r]),
                (weak[r], LostReason.LOW_SCORE, share, c.suspect_score),
                (uncovered[r] > c.lost_coverage, LostReason.UNCOVERED_MASK, uncovered[r], c.lost_coverage),
                (sigma[r] > c.lost_sigma_mm, LostReason.UNCERTAIN, sigma[r], c.lost_sigma_mm),
            )
            found = (Loss(reason, float(value), float(limit)) for failed, reason, value, limit in checks if failed)
            return next(found, NO_LOSS)

        return first(0), first(1)

    def _others(self, trial, suspect, starts, views, gallery) -> _Trial:
        """Try the other predictions."""
        for start in starts[1:]:
            trial = self._better(
                trial, self._try(start, views, self._config.gates_from(0.0), trial.use), suspect, views
            )
        return trial

    def _leave_out(self, trial, suspect, starts, views, gallery) -> _Trial:
        """Leave a mask out if the others of its row then agree far better among themselves."""
        c = self._config
        for r in np.flatnonzero(suspect):
            for k in np.flatnonzero(trial.use[r]):
                rest = trial.use.copy()
                rest[r, k] = False
                if rest[r].sum() < 2:
                    continue
                without = self._try(starts[0], views, c.gates_from(0.0), rest)
                gain = (without.worth(c.bare_price) - trial.worth(c.bare_price))[r, rest[r]].sum()
                if gain > c.conflict_gain * score_px(without.solution)[r, rest[r]].sum():
                    trial = without
                    break
        return trial

    def _widen(self, trial, suspect, starts, views, gallery) -> _Trial:
        """Try again with wide gates from the predictions and from where we are."""
        for start in (*starts, trial.solution.poses):
            wide = self._try(start, views, self._config.wide_gates_px, trial.use)
            trial = self._better(trial, wide, suspect, views)
        return trial

    def _search(self, trial, suspect, starts, views, gallery) -> _Trial:
        """Try many starts around the prediction and earlier poses, the most promising ones to the end."""
        c = self._config
        for r in np.flatnonzero(suspect):
            only = np.arange(2) == r
            scan = self._solver.scans[r]
            bases = [self._brought_near(p[r], r, views, trial.use) for p in (starts[0], *gallery)]
            glances = []
            for pose in [*_around(bases[0], scan.centre, c.search_rings), *bases[1:]]:
                poses = np.where(only[:, None, None], pose, trial.solution.poses)
                glance = self._try(poses, views, c.glance_gates_px, trial.use)
                glances.append((glance.worth(c.bare_price)[r].sum(), poses))
            glances.sort(key=lambda g: -g[0])
            for _, poses in glances[: c.search_finalists]:
                trial = self._better(trial, self._try(poses, views, c.wide_gates_px, trial.use), only, views)
        return trial

    def _brought_near(self, pose: Array, r: int, views: Sequence[View], use: Mask):
        """Return the pose moved onto its masks if they lie farther off than the search reaches."""
        shift = shift_to_masks(self._solver.scans[r], pose, r, views, use)
        if np.linalg.norm(shift) <= self._config.search_rings[0][0]:
            return pose
        return make_transform(np.eye(3), shift) @ pose

    def _better(self, trial: _Trial, other: _Trial, rows: Mask, views: Sequence[View]) -> _Trial:
        """Return the better of two poses of each of the given rows."""
        price = self._config.bare_price
        take = rows & (other.worth(price).sum(1) > trial.worth(price).sum(1))
        if not take.any():
            return trial
        if take.all():
            return other
        poses = np.where(take[:, None, None], other.solution.poses, trial.solution.poses)
        return self._try(poses, views, self._config.wide_gates_px[-2:], trial.use)


def _around(pose: Array, centre: Array, rings: Sequence[tuple[float, float]]) -> Iterator[Array]:
    """Yield a pose and, for each (mm, rad), the poses moved and turned both ways along each axis about a scan point."""
    yield pose
    c = transform_point(pose, centre)
    to, back = make_transform(np.eye(3), -c), make_transform(np.eye(3), c)
    for mm, rad in rings:
        for k in range(6):
            for sign in (-1.0, 1.0):
                twist = np.zeros(6)
                twist[k] = sign * (rad if k < 3 else mm)
                yield back @ se3_exp(twist) @ to @ pose
