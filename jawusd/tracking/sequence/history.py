"""Predictions from earlier frames: poses of the next frame, and the usual quality of a good frame."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

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
        """Add the next frame; for arches not found, keep the predictions or the given guesses.

        Args:
            poses: T_world_upper, T_world_lower, shape (2, 4, 4).
            found: whether each arch has a reliable pose, shape (2,).
            seen: whether each arch has any mask, shape (2,).
            guessed: whether the given poses of arches not found are better guesses than the predictions.
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

    A search takes as long as tracking ten to fifty frames, and wrong masks would otherwise trigger a failing search in
    every affected frame, in both directions. Work is counted instead of time, so results do not depend on the machine.
    """

    def __init__(self, frames: int) -> None:
        """Set the search budget for a take of `frames` frames."""
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


class _Partial(NamedTuple):
    """Quality of frames in which a camera is missing; used if no frame has all cameras."""

    scores: deque[Array]
    residuals: deque[Array]
    coverages: deque[Array]


class _Usual(NamedTuple):
    """Medians of recent frames; see the methods of `History`."""

    score: Array
    residual: Array
    coverage: Array


class History:
    """The quality of recent good frames, as a reference for the next frame.

    If a camera is missing in all frames, frames without it serve as the reference.
    """

    def __init__(self, length: int, score_length: int) -> None:
        """Start without frames; use at most `length` recent frames, and at most `score_length` frames for scores."""
        self._scores: deque[Array] = deque(maxlen=score_length)
        self._residuals: deque[Array] = deque(maxlen=length)
        self._coverages: deque[Array] = deque(maxlen=length)
        self._partial = _Partial(deque(maxlen=score_length), deque(maxlen=length), deque(maxlen=length))
        self._usual: _Usual | None = None

    def add(self, record: FrameRecord) -> None:
        """Add the record of a frame; only well-tracked arches count."""
        self.add_summary(FrameSummary.of(record))

    def add_summary(self, past: FrameSummary) -> None:
        """Add the summary of a frame."""
        self._usual = None
        good = past.status == TRACKED
        self._scores.append(np.where(good[:, None], past.score_px, np.nan))
        self._residuals.append(np.where(good, past.residual_px, np.nan))
        self._coverages.append(np.where(good[:, None] & past.used, past.coverage, np.nan))
        partial = past.status == PARTIAL
        used = partial[:, None] & past.used
        self._partial.scores.append(np.where(used, past.score_px, np.nan))
        self._partial.residuals.append(np.where(partial, past.residual_px, np.nan))
        self._partial.coverages.append(np.where(used, past.coverage, np.nan))

    def usual_score(self) -> Array:
        """Return the median score per arch and view [px], shape (2, C); 0 while unknown."""
        return self._medians().score

    def usual_residual(self) -> Array:
        """Return the median residual per arch [px], shape (2,); infinite while unknown."""
        return self._medians().residual

    def usual_coverage(self) -> Array:
        """Return the median coverage error per arch and view, shape (2, C); 0 while unknown."""
        return self._medians().coverage

    def _medians(self) -> _Usual:
        """Return the medians, cached until the next frame is added."""
        if self._usual is None:
            self._usual = _Usual(
                _median(self._scores, _median(self._partial.scores, 0.0)),
                _median(self._residuals, _median(self._partial.residuals, np.inf)),
                _median(self._coverages, _median(self._partial.coverages, 0.0)),
            )
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
