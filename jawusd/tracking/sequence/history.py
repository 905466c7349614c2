"""Predictions from earlier frames: poses of the next frame, and the usual quality of a good frame."""

from __future__ import annotations

from collections import deque

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.formats.tracks import PARTIAL, TRACKED
from jawusd.geometry import orthonormalise, se3_inverse, transform_points
from jawusd.tracking.contour.frame_record import FrameRecord, FrameSummary
from jawusd.tracking.contour.scan import ARCHES

_KEPT_POSES = 16  # maximum number of earlier poses kept: enough to cover the range of motion of a jaw
_APART_MM = 2.0  # minimum distance between the poses kept [mm]: closer ones converge to the same local minimum
# Number of failed multi-start searches allowed in any take, and number of frames for each further search: at up to five
# seconds per search, all searches together take no longer than tracking.
_FRUITLESS, _FRAMES_PER_FRUITLESS = 8, 32
_RECENT = 8  # number of frames over which prediction errors are remembered: a third of a chewing stroke at 24 fps


class MotionPredictor:
    """Extrapolates poses with constant velocity, and keeps earlier poses as starts for recovery."""

    def __init__(self, poses: Array, points: Array) -> None:
        """Start at rest; prediction errors are measured at `points` of both arches, shape (2, N, 3)."""
        self._points = points
        self._misses: deque[float] = deque(maxlen=2 * _RECENT)  # each arch adds one entry per frame
        self._last = np.array(poses)
        self._step: list[Array | None] = [None, None]
        self._lost_for = np.zeros(2, int)
        self._failures = np.zeros(2, int)
        self._seen: list[Array] = []

    def predict(self) -> Array:
        """Return the expected T_world_upper and T_world_lower of the next frame, shape (2, 4, 4)."""
        out = self._last.copy()
        for r, step in enumerate(self._step):
            if step is not None:
                out[r] = step @ self._last[r]
        if self._lost_for[1] and not self._lost_for[0]:
            out[1] = out[0] @ se3_inverse(self._last[0]) @ self._last[1]  # a lost jaw is assumed to move with the head
        return orthonormalise(out)

    def starts(self) -> list[Array]:
        """Return predictions for the next frame, most likely first: constant velocity, at rest, and midway between."""
        moving = self.predict()
        if self._step[0] is None and self._step[1] is None:
            return [moving]
        half = orthonormalise(0.5 * (moving + self._last))
        return [moving, self._last.copy(), half]

    def update(self, poses: Array, found: Mask, seen: Mask, guessed: bool = False) -> None:
        """Add the poses (2, 4, 4) of a frame; for arches not found, keep predictions or, if `guessed`, these poses.

        `found` and `seen` (2,) are whether each arch has a reliable pose, and any mask.
        """
        expected = self.predict()
        for r in ARCHES:
            if found[r]:
                if not self._lost_for[r]:
                    gap = transform_points(expected[r], self._points[r]) - transform_points(poses[r], self._points[r])
                    self._misses.append(float(np.linalg.norm(gap, axis=1).max()))
                # After a loss, the last pose is only a guess, from which no velocity can be computed.
                self._step[r] = None if self._lost_for[r] else poses[r] @ se3_inverse(self._last[r])
            else:
                self._step[r] = None
        self._lost_for = np.where(found, 0, self._lost_for + 1)
        self._failures = np.where(found, 0, self._failures + seen)
        if guessed:
            expected = poses
        elif not found[1]:
            head = poses[0] if found[0] else expected[0]
            expected[1] = head @ se3_inverse(self._last[0]) @ self._last[1]
        self._last = np.where(found[:, None, None], poses, expected)
        self.remember(poses, found)

    def miss_mm(self) -> float:
        """Return the largest recent prediction error at the points of the arches [mm]."""
        return max(self._misses, default=0.0)

    def remember(self, poses: Array, found: Mask) -> None:
        """Keep poses of both arches (2, 4, 4) as starts for later frames if they differ from the poses kept so far."""
        if not found.all():
            return
        new = se3_inverse(poses[0]) @ poses[1]
        if any(np.linalg.norm((new - se3_inverse(p[0]) @ p[1])[:3, 3]) < _APART_MM for p in self._seen):
            return
        self._seen = [*self._seen[-_KEPT_POSES + 1 :], np.array(poses)]

    def search_is_due(self) -> bool:
        """Return whether a multi-start search is due: at first always, then less and less often while searches fail.

        Frames without masks do not count, so the search runs as soon as the teeth reappear.
        """
        failures = int(self._failures.max())
        return failures & (failures - 1) == 0 or failures % 16 == 0

    def pose_history(self) -> list[Array]:
        """Return earlier poses as starts for the next frame, relative to the current head pose."""
        head = self.predict()[0]
        return [np.stack([p[0], head @ se3_inverse(p[0]) @ p[1]]) for p in self._seen]


class SearchBudget:
    """A budget for failed multi-start searches in a take.

    Wrong masks would otherwise trigger a failing search, as long as tracking ten to fifty frames, in every affected
    frame. Work is counted instead of time, so results do not depend on the machine.
    """

    def __init__(self, frames: int) -> None:
        self.most = self._left = _FRUITLESS + frames // _FRAMES_PER_FRUITLESS
        self.fruitless = 0
        self._searched: set[int] = set()
        self._refused: set[int] = set()

    @property
    def left_out(self) -> set[int]:
        """The frames on which a search was due but never ran."""
        return self._refused - self._searched

    def allows(self, frame: int) -> bool:
        """Return whether a due search may run on a frame."""
        if self._left <= 0:
            self._refused.add(frame)
        return self._left > 0

    def note(self, frame: int, found: bool) -> None:
        """Record a search on a frame; a successful one adds to the budget."""
        self._searched.add(frame)
        self._left = min(self.most, self._left + 1) if found else self._left - 1
        self.fruitless += not found


class History:
    """The quality of recent good frames, as a reference for the next frame.

    If a camera is missing in all frames, frames without it serve as the reference.
    """

    def __init__(self, length: int, score_length: int) -> None:
        """Start without frames; use at most `length` recent frames, and at most `score_length` frames for scores."""
        lengths = (score_length, length, length)
        # scores, residuals and coverage errors of frames with all cameras, and of frames in which a camera is missing
        self._whole: list[deque[Array]] = [deque(maxlen=most) for most in lengths]
        self._partial: list[deque[Array]] = [deque(maxlen=most) for most in lengths]
        self._usual: list[Array] | None = None  # their medians, cached until the next frame is added

    def add(self, record: FrameRecord) -> None:
        """Add the record of a frame; only well-tracked arches count."""
        self.add_summary(FrameSummary.of(record))

    def add_summary(self, past: FrameSummary) -> None:
        """Add the summary of a frame."""
        self._usual = None
        good, partial = (past.status == status for status in (TRACKED, PARTIAL))
        used, partly_used = good[:, None] & past.used, partial[:, None] & past.used
        figures = (past.score_px, past.residual_px, past.coverage)
        for kept, figure, valid in zip(self._whole, figures, (good[:, None], good, used), strict=True):
            kept.append(np.where(valid, figure, np.nan))
        for kept, figure, valid in zip(self._partial, figures, (partly_used, partial, partly_used), strict=True):
            kept.append(np.where(valid, figure, np.nan))

    def usual_score(self) -> Array:
        """Return the median score per arch and view [px], shape (2, C); 0 while unknown."""
        return self._medians()[0]

    def usual_residual(self) -> Array:
        """Return the median residual per arch [px], shape (2,); infinite while unknown."""
        return self._medians()[1]

    def usual_coverage(self) -> Array:
        """Return the median coverage error per arch and view, shape (2, C); 0 while unknown."""
        return self._medians()[2]

    def _medians(self) -> list[Array]:
        if self._usual is None:
            kept = zip(self._whole, self._partial, (0.0, np.inf, 0.0), strict=True)
            self._usual = [_median(whole, _median(partial, unknown)) for whole, partial, unknown in kept]
        return self._usual


def _median(values: deque[Array], otherwise: float | Array) -> Array:
    """Return medians that ignore NaN; `np.nanmedian` is ten times slower for so few values."""
    if not values:
        return np.asarray(otherwise, np.float64)
    stack = np.sort(np.array(values), axis=0)  # NaN is sorted to the end of the array
    known = np.isfinite(stack).any(0)
    count = (~np.isnan(stack)).sum(0)
    low, high = (np.take_along_axis(stack, at[None], axis=0)[0] for at in (np.maximum(count - 1, 0) // 2, count // 2))
    return np.asarray(np.where(known, 0.5 * (low + high), otherwise), np.float64)
