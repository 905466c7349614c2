"""What follows from earlier frames for the next one: predicted poses, and the usual quality of a good frame."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.formats.tracks import PARTIAL, TRACKED
from jawusd.geometry import orthonormalise, se3_inverse, transform_points
from jawusd.tracking.contour.frame_record import FrameRecord, FrameSummary
from jawusd.tracking.contour.scan import ARCHES

_KEPT_POSES = 16  # earlier poses kept: enough to cover the exercises of a jaw at 2 mm
_APART_MM = 2.0  # poses nearer than this have the same basin
# Searches from many starts that may find nothing in a take, and frames of it that allow one more: at five seconds each
# at most, all of them together take no longer than tracking. Of 40 valid persons of the population (seeds 8100, 9300)
# none needed more, nor did 300 frames of one take and 80 of another while lips close over the teeth.
_FRUITLESS, _FRAMES_PER_FRUITLESS = 8, 32
_RECENT = 8  # frames over which prediction errors are remembered: a third of a chewing stroke at 24 fps


class MotionPredictor:
    """Extrapolate with constant velocity; keep earlier poses as starts for getting back after a loss."""

    def __init__(self, poses: Array, points: Array) -> None:
        """Start at rest; prediction errors will be measured at some points of both arches, shape (2, N, 3)."""
        self._points = points
        self._misses: deque[float] = deque(maxlen=2 * _RECENT)  # two arches
        self._last = np.array(poses)
        self._step: list[Array | None] = [None, None]
        self._lost_for = np.zeros(2, int)
        self._failures = np.zeros(2, int)
        self._seen: list[Array] = []

    def predict(self) -> Array:
        """Return the expected T_world_upper, T_world_lower of the next frame, shape (2, 4, 4)."""
        out = self._last.copy()
        for r, step in enumerate(self._step):
            if step is not None:
                out[r] = step @ self._last[r]
        if self._lost_for[1] and not self._lost_for[0]:
            out[1] = out[0] @ se3_inverse(self._last[0]) @ self._last[1]  # a lost jaw is carried along by the head
        return orthonormalise(out)

    def starts(self) -> list[Array]:
        """Return predictions for the next frame, the likeliest first: going on as before, at rest, and half way."""
        moving = self.predict()
        if self._step[0] is None and self._step[1] is None:
            return [moving]
        half = orthonormalise(0.5 * (moving + self._last))
        return [moving, self._last.copy(), half]

    def update(self, poses: Array, found: Mask, seen: Mask, guessed: bool = False) -> None:
        """Add the next frame; arches not found keep their predictions, or go where they are guessed.

        Args:
            poses: T_world_upper, T_world_lower, shape (2, 4, 4).
            found: arches whose poses can be trusted, shape (2,).
            seen: arches that have any mask, shape (2,).
            guessed: whether poses of arches not found are guesses better than predictions.
        """
        expected = self.predict()
        for r in ARCHES:
            if found[r]:
                if not self._lost_for[r]:
                    gap = transform_points(expected[r], self._points[r]) - transform_points(poses[r], self._points[r])
                    self._misses.append(float(np.linalg.norm(gap, axis=1).max()))
                # After a loss the last pose is a guess, and a velocity from it would be another.
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
        """Return the largest recent error of a prediction at the given points [mm]."""
        return max(self._misses, default=0.0)

    def remember(self, poses: Array, found: Mask) -> None:
        """Keep poses of both arches, shape (2, 4, 4), as later starts if they are unlike those kept."""
        if not found.all():
            return
        new = se3_inverse(poses[0]) @ poses[1]
        if any(np.linalg.norm((new - se3_inverse(p[0]) @ p[1])[:3, 3]) < _APART_MM for p in self._seen):
            return
        self._seen = [*self._seen[-_KEPT_POSES + 1 :], np.array(poses)]

    def search_is_due(self) -> bool:
        """Tell whether a search from many starts is due: always at first, then ever less often while it fails.

        Frames without masks do not count: teeth that come back are searched at once.
        """
        failures = int(self._failures.max())
        return failures & (failures - 1) == 0 or failures % 16 == 0

    def pose_history(self) -> list[Array]:
        """Return earlier poses as starts for the next frame: the jaw relative to where the head is now."""
        head = self.predict()[0]
        return [np.stack([p[0], head @ se3_inverse(p[0]) @ p[1]]) for p in self._seen]


class SearchAllowance:
    """Say whether a take is worth another search from many starts.

    One takes as long as tracking ten to fifty frames. Masks that show something else now and then would have it run in
    vain on each such frame, forwards and backwards. Work is counted, not time, so the result does not depend on the
    machine.
    """

    def __init__(self, frames: int) -> None:
        """Allow for the searches of a take of so many frames."""
        self.most = self._left = _FRUITLESS + frames // _FRAMES_PER_FRUITLESS
        self.fruitless = 0
        self._searched: set[int] = set()
        self._refused: set[int] = set()

    @property
    def left_out(self) -> set[int]:
        """The frames on which a search was due and never ran."""
        return self._refused - self._searched

    def allows(self, frame: int) -> bool:
        """Tell whether to search on a frame where that is due."""
        if self._left <= 0:
            self._refused.add(frame)
        return self._left > 0

    def note(self, frame: int, found: bool) -> None:
        """Take a search on a frame into account: what finds teeth earns another one."""
        self._searched.add(frame)
        self._left = min(self.most, self._left + 1) if found else self._left - 1
        self.fruitless += not found


class _Partial(NamedTuple):
    """Hold the quality of frames without one of the cameras; they count where there are no others."""

    scores: deque[Array]
    residuals: deque[Array]
    coverages: deque[Array]


class _Usual(NamedTuple):
    """Hold what is usual; see the methods of `History`."""

    score: Array
    residual: Array
    coverage: Array


class History:
    """Remember the quality of recent good frames, to tell a bad one.

    A camera may be missing in the whole take; then the frames without it tell what is usual.
    """

    def __init__(self, length: int, score_length: int) -> None:
        """Start empty; keep at most `length` frames, scores of at most `score_length`."""
        self._scores: deque[Array] = deque(maxlen=score_length)
        self._residuals: deque[Array] = deque(maxlen=length)
        self._coverages: deque[Array] = deque(maxlen=length)
        self._partial = _Partial(deque(maxlen=score_length), deque(maxlen=length), deque(maxlen=length))
        self._usual: _Usual | None = None

    def add(self, record: FrameRecord) -> None:
        """Add a frame; only arches tracked without trouble count, see the class."""
        self.add_summary(FrameSummary.of(record))

    def add_summary(self, past: FrameSummary) -> None:
        """Add what was kept of a frame."""
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
        """Return what is usual; found once between two frames, for a dozen questions about each."""
        if self._usual is None:
            self._usual = _Usual(
                _median(self._scores, _median(self._partial.scores, 0.0)),
                _median(self._residuals, _median(self._partial.residuals, np.inf)),
                _median(self._coverages, _median(self._partial.coverages, 0.0)),
            )
        return self._usual


def _median(values: deque[Array], otherwise: float | Array) -> Array:
    """Return the medians of what is known, by sorting: of so few values `np.nanmedian` takes ten times as long."""
    if not values:
        return np.asarray(otherwise, np.float64)
    stack = np.sort(np.array(values), axis=0)  # NaN behind all others
    known = np.isfinite(stack).any(0)
    count = (~np.isnan(stack)).sum(0)
    low, high = (np.take_along_axis(stack, at[None], axis=0)[0] for at in (np.maximum(count - 1, 0) // 2, count // 2))
    return np.asarray(np.where(known, 0.5 * (low + high), otherwise), np.float64)
