"""One instant at a time: solve, notice failure, try harder, and say what happened."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, TRACKED
from jawusd.geometry import make_transform, se3_exp, transform_points
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.quality import coverage_error, crown_sigma_mm, residual_px, score_px
from jawusd.tracking.solver import ContourSolver, Solution, View

_ROWS = (0, 1)


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """Hold what is known about one instant.

    Attributes:
        solution: the alignment; its poses of lost rows mean nothing.
        status: of both rows, as in `Tracks`, shape (2,).
        used: masks that took part, shape (2, C).
        coverage: E_SP over mask pixels, shape (2, C); NaN without a mask.
    """

    solution: Solution
    status: NDArray[np.int8]
    used: NDArray[np.bool_]
    coverage: NDArray[np.float64]


@dataclass(eq=False)
class History:
    """Remember what good frames looked like lately, to tell a bad one."""

    length: int
    scores: deque = field(init=False)
    residuals: deque = field(init=False)
    coverages: deque = field(init=False)
    shares: deque = field(init=False)

    def __post_init__(self) -> None:
        for name in ("scores", "residuals", "coverages", "shares"):
            setattr(self, name, deque(maxlen=self.length))

    def add(self, record: FrameRecord) -> None:
        """Take in a frame; only rows tracked without trouble count."""
        good = record.status == TRACKED
        self.scores.append(np.where(good, score_px(record.solution), np.nan))
        self.residuals.append(np.where(good, residual_px(record.solution), np.nan))
        seen = good[:, None] & record.used
        self.coverages.append(np.where(seen, record.coverage, np.nan))
        self.shares.append(np.where(seen, _shares(record.solution), np.nan))

    def usual(self, name: str, otherwise: float) -> NDArray[np.float64]:
        """Return the median of the remembered values, or a stand-in where there are none."""
        stack = np.array(getattr(self, name))
        if not len(stack):
            raise ValueError("an empty history knows nothing")
        known = np.isfinite(stack).any(0)
        out = np.full(stack.shape[1:], otherwise)
        out[known] = np.nanmedian(stack[:, known], axis=0)
        return out


def _shares(solution: Solution) -> NDArray[np.float64]:
    """Return the matched share of the visible contour per row and view, shape (2, C)."""
    return solution.systems[:, :, 6, 6] / np.maximum(solution.visible_px, 1.0)


class FrameTracker:
    """Track instant after instant from predictions, with the failure ladder."""

    def __init__(self, solver: ContourSolver, config: TrackingConfig, history: History) -> None:
        self._solver = solver
        self._config = config
        self.history = history

    def track(
        self, prediction: NDArray[np.float64], views: Sequence[View], gallery: Sequence[NDArray[np.float64]] | None
    ) -> FrameRecord:
        """Align one instant.

        Args:
            prediction: T_world_upper, T_world_lower, shape (2, 4, 4).
            views: one per camera.
            gallery: further starts for the last resort, each shape (2, 4, 4); None forgoes the last resort.
        """
        use = np.array([[v.present[r] for v in views] for r in _ROWS])
        solution = self._solver.solve(prediction, views, self._config.gates_px, use)
        coverage = coverage_error(self._solver.scans, solution, views)
        kept = use & ~self._spoiled(solution, coverage, use)
        if (kept != use).any():
            use = kept
            solution = self._solver.solve(prediction, views, self._config.gates_px, use)
            coverage = coverage_error(self._solver.scans, solution, views)
        first = solution
        for attempt in (self._widen,) if gallery is None else (self._widen, self._search):
            suspect = self._suspect(solution, coverage, use)
            if not suspect.any():
                break
            solution = attempt(solution, prediction, views, use, suspect, gallery)
            coverage = coverage_error(self._solver.scans, solution, views)
        complete = use.all(1)
        status = np.where(complete, TRACKED, PARTIAL).astype(np.int8)
        status[score_px(solution) > self._config.recovery_gain * score_px(first)] = RECOVERED
        status[self._lost(solution, coverage, use)] = LOST
        return FrameRecord(solution, status, use, coverage)

    def _suspect(self, solution: Solution, coverage, use) -> NDArray[np.bool_]:
        """Tell which rows look worse than they lately did."""
        c, h = self._config, self.history
        low = score_px(solution) < c.suspect_score * h.usual("scores", 0.0)
        rough = ~(residual_px(solution) < c.suspect_residual * h.usual("residuals", np.inf))
        bare = np.where(use, coverage - h.usual("coverages", 0.0), -np.inf).max(1) > c.suspect_coverage
        return (low | rough | bare) & use.any(1)

    def _spoiled(self, solution: Solution, coverage, use) -> NDArray[np.bool_]:
        """Tell which masks disagree with the scan while those of the other cameras do not, shape (2, C)."""
        c, h = self._config, self.history
        bare = coverage - h.usual("coverages", 0.0) > c.suspect_coverage
        share = _shares(solution) / np.maximum(h.usual("shares", 1.0), 1e-6)
        wrong = np.zeros_like(use)
        for r in _ROWS:
            if use[r].sum() < 2:
                continue
            ratio = np.where(use[r], share[r], -np.inf)
            others = np.array([np.delete(ratio, k).max() for k in range(len(ratio))])
            poor = use[r] & (ratio < c.spoiled_share * np.minimum(others, 1.0))
            wrong[r] = use[r] & (bare[r] | poor)
            if wrong[r].all():
                wrong[r] = False  # it is the pose that is wrong, not every mask
        return wrong

    def _lost(self, solution: Solution, coverage, use) -> NDArray[np.bool_]:
        """Tell which rows cannot be trusted, shape (2,)."""
        c, h = self._config, self.history
        few = solution.systems[:, :, 7, 7].sum(1) < c.least_matched_px
        rough = ~(residual_px(solution) < c.lost_residual * h.usual("residuals", np.inf))
        bare = np.where(use, coverage, -np.inf).max(1) > c.lost_coverage
        loose = np.array([crown_sigma_mm(self._solver.scans[r], solution, r, c) > c.lost_sigma_mm for r in _ROWS])
        return few | rough | bare | loose | ~use.any(1)

    def _widen(self, solution, prediction, views, use, suspect, gallery) -> Solution:
        """Try again from the prediction and from the present solution with wide gates."""
        for start in (prediction, solution.poses):
            trial = self._solver.solve(start, views, self._config.wide_gates_px, use)
            solution = self._better(solution, trial, suspect, views, use)
        return solution

    def _search(self, solution, prediction, views, use, suspect, gallery) -> Solution:
        """Try many starts around the prediction and earlier poses, the most promising ones to the end."""
        c = self._config
        for r in np.flatnonzero(suspect):
            starts = [*_around(prediction[r], self._solver.scans[r].centre, c.search_mm, c.search_rad)]
            starts += [g[r] for g in gallery]
            trials = []
            for start in starts:
                poses = solution.poses.copy()
                poses[r] = start
                trials.append((score_px(self._solver.solve(poses, views, c.glance_gates_px, use))[r], start))
            trials.sort(key=lambda t: -t[0])
            only = np.arange(2) == r
            for _, start in trials[: c.search_finalists]:
                poses = solution.poses.copy()
                poses[r] = start
                trial = self._solver.solve(poses, views, c.wide_gates_px, use)
                solution = self._better(solution, trial, only, views, use)
        return solution

    def _better(self, solution: Solution, trial: Solution, rows, views, use) -> Solution:
        """Return the solution made of the better poses of the given rows."""
        take = rows & (score_px(trial) > score_px(solution))
        if not take.any():
            return solution
        if take.all():
            return trial
        poses = np.where(take[:, None, None], trial.poses, solution.poses)
        return self._solver.solve(poses, views, self._config.gates_px[-2:], use)


def _around(pose: NDArray[np.float64], centre: NDArray[np.float64], mm: float, rad: float):
    """Yield a pose and the poses moved and turned both ways along each axis about a scan point."""
    yield pose
    c = transform_points(pose, centre)
    to, back = make_transform(np.eye(3), -c), make_transform(np.eye(3), c)
    for k in range(6):
        for sign in (-1.0, 1.0):
            twist = np.zeros(6)
            twist[k] = sign * (rad if k < 3 else mm)
            yield back @ se3_exp(twist) @ to @ pose
