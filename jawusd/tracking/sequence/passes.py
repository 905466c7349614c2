"""Tracking passes over the frames of a take: away from the first frame, back to it, and backwards into every gap."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.tracks import LOST, RECOVERED, TRACKED, LostReason
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.frame_record import FrameRecord, Loss, PackedRecords
from jawusd.tracking.contour.quality import residual_px, score_px
from jawusd.tracking.contour.scan import ARCHES, probe_points
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews, View
from jawusd.tracking.initialization.first_frame import first_record
from jawusd.tracking.sequence.frame_tracker import FrameTracker
from jawusd.tracking.sequence.history import History, MotionPredictor, SearchBudget

Progress = Callable[[int, int], None]

# Maximum number of frames around a restart from which the tracker is initialised: without this limit, long takes with
# many gaps would take quadratic time.
_NEARBY_FRAMES = 4000
_AGREED_MM = 0.05  # maximum distance between arch centres for tracking in both directions to agree [mm]


class Passes:
    """Runs the tracker over the frames of a take, and stores one record per frame."""

    def __init__(
        self,
        solver: ContourSolver,
        config: TrackingConfig,
        masks: MaskViews,
        first: int,
        stop: int,
        progress: Progress | None,
    ) -> None:
        self._solver, self._config, self._masks = solver, config, masks
        self._first, self._stop = first, stop
        self._progress = progress or (lambda done, total: None)
        self._probes = probe_points(solver.scans)
        self.records = PackedRecords()
        self.searches = SearchBudget(stop - first)

    def track_from(self, frame: int, poses: Array) -> None:
        """Track outwards from the given frame in both directions, then back to it, then fill the gaps.

        Args:
            frame: reference frame number.
            poses: T_world_scan of both arches in that frame, close enough for the alignment to converge, shape (2, 4,
                4).

        Raises:
            TrackingError: the teeth do not fit the masks of that frame.
            CaptureError: a mask cannot be read.
        """
        self.begin(frame, poses)
        self.run(range(frame + 1, self._stop))
        self.run(range(frame - 1, self._first - 1, -1))
        self.track_back_to(frame)
        self.close_gaps()

    def begin(self, frame: int, poses: Array) -> None:
        """Align the first frame."""
        self.records[frame] = first_record(self._solver, self._config, poses, self._masks.at(frame), frame, True)
        self._progress(1, self._stop - self._first)

    def run(self, frames: range) -> None:
        """Track a range of frames that starts next to a tracked one."""
        if not len(frames):
            return
        tracker, motion = self.beside(frames.start - frames.step)
        for frame, views in self._masks.walk(frames.start, frames.stop, frames.step):
            record = self._one(tracker, motion, frame, views)
            self.records[frame] = record
            self._progress(len(self.records), self._stop - self._first)

    def track_back_to(self, start: int) -> None:
        """Track from a frame with a good fit to the first frame, and past that until both tracking directions agree.

        The first frame was aligned before the usual fit of the take was known, and its neighbours were tracked from it.
        """
        seen = nearest_well_seen(self.records, start)
        if seen is None or seen == start:
            return
        step = 1 if seen < start else -1
        judged = self.records.kept(frame for frame in self.records if (frame - seen) * step <= 0)
        tracker, motion = self.beside(seen, judged)
        for frame, views in self._masks.walk(seen + step, self._stop if step > 0 else self._first - 1, step):
            before = self.records[frame]
            record = self._one(tracker, motion, frame, views, before.solution.poses)
            found = (record.status != LOST).all()
            apart = np.linalg.norm(record.solution.centres - before.solution.centres, axis=1).max()
            if (frame - start) * step > 0 and found and apart < _AGREED_MM:
                return
            both = record.used & before.used
            gain = np.where(both, score_px(record.solution) - score_px(before.solution), 0.0)
            if not found or gain.sum() >= 0:
                self.records[frame] = record

    def close_gaps(self) -> None:
        """Track backwards into every gap from the frame after it, and keep results that lose fewer arches."""
        for first, stop in _gaps(self.records):
            if stop not in self.records:
                continue
            tracker, motion = self.beside(stop)
            for frame, views in self._masks.walk(stop - 1, first - 1, -1):
                record = self._one(tracker, motion, frame, views)
                lost, was_lost = record.status == LOST, self.records[frame].status == LOST
                if (lost <= was_lost).all() and (lost != was_lost).any():
                    status = np.where(was_lost & ~lost, RECOVERED, record.status).astype(np.int8)
                    self.records[frame] = replace(record, status=status)

    def beside(
        self, frame: int, records: Mapping[int, FrameRecord] | None = None
    ) -> tuple[FrameTracker, MotionPredictor]:
        """Return a tracker and a motion predictor, initialised from the frames around a tracked frame."""
        records = records or self.records
        history = History(self._config.history_frames, self._config.score_frames)
        known = sorted(records, key=lambda f: -abs(f - frame))[-_NEARBY_FRAMES:]
        for near in known[-self._config.history_frames :]:
            history.add(records[near])
        motion = MotionPredictor(records[frame].solution.poses, self._probes)
        for near in known[::10]:
            motion.remember(records[near].solution.poses, records[near].status != LOST)
        return FrameTracker(self._solver, self._config, history), motion

    def _one(
        self,
        tracker: FrameTracker,
        motion: MotionPredictor,
        frame: int,
        views: Sequence[View],
        known: Array | None = None,
    ) -> FrameRecord:
        """Track the next frame; if an arch is lost, also try `known` poses, shape (2, 4, 4)."""
        reach = self._config.gate_per_miss * motion.miss_mm() * self._config.working_px_per_mm
        may_search = motion.search_is_due() and self.searches.allows(frame)
        record = tracker.track(motion.starts(), views, motion.pose_history() if may_search else None, reach)
        if tracker.searched:
            self.searches.note(frame, bool((record.status != LOST).all()))
        if known is not None and (record.status == LOST).any():
            other = tracker.track([known], views, None)
            record = other if (other.status != LOST).all() else record
        motion.update(record.solution.poses, np.asarray(record.status != LOST), np.asarray(record.used.any(1)))
        tracker.history.add(record)
        return record


def _gaps(records: Mapping[int, FrameRecord]) -> Iterable[tuple[int, int]]:
    """Return the runs of frames in which an arch is lost, each as first frame and one past the last."""
    lost = [frame for frame in sorted(records) if (records[frame].status == LOST).any()]
    runs: list[list[int]] = []
    for frame in lost:
        if runs and runs[-1][1] == frame:
            runs[-1][1] = frame + 1
        else:
            runs.append([frame, frame + 1])
    return [(a, b) for a, b in runs]


# Minimum score and maximum residual of a frame with a good fit, relative to the medians of the take. These limits only
# determine the frame from which tracking returns to the first frame.
_LEAST_SCORE, _MOST_RESIDUAL = 0.8, 1.2
# Minimum matched fraction of the visible contour, and maximum residual, both relative to the medians of the take: an
# arch that violates both was matched with lip edges instead of teeth. Last value: minimum number of frames for the
# medians. False-alarm rate: at most 1.4 %.
_POOR_SHARE, _POOR_RESIDUAL, _TELLING_FRAMES = 0.5, 1.6, 6


def nearest_well_seen(records: Mapping[int, FrameRecord], start: int) -> int | None:
    """Return the frame nearest to a given one in which both arches fit as well as usual in the take.

    Return None if there is no such frame.
    """
    frames = [frame for frame, record in records.items() if (record.status == TRACKED).all()]
    if not frames:
        return None
    scores = np.array([score_px(records[frame].solution).sum(1) for frame in frames])
    residuals = np.array([residual_px(records[frame].solution) for frame in frames])
    well = (scores >= _LEAST_SCORE * np.median(scores, axis=0)) & (
        residuals <= _MOST_RESIDUAL * np.median(residuals, axis=0)
    )
    seen = np.array(frames)[well.all(1)]
    return min(seen.tolist(), key=lambda frame: (abs(frame - start), frame), default=None)


def mark_poorly_seen_lost(records: MutableMapping[int, FrameRecord]) -> None:
    """Mark arches as lost in frames in which they match far less contour than usual, with far larger residuals."""
    frames = sorted(records)
    kept = np.array([records[frame].status != LOST for frame in frames])
    share, residual = (np.full((len(frames), 2), np.nan) for _ in range(2))
    for k, frame in enumerate(frames):
        solution = records[frame].solution
        share[k] = score_px(solution).sum(1) / np.maximum(solution.visible_px.sum(1), 1.0)
        residual[k] = residual_px(solution)
    if (kept.sum(0) < _TELLING_FRAMES).any():
        return
    usual = [[float(np.nanmedian(values[kept[:, r], r])) for r in ARCHES] for values in (share, residual)]
    relative = share / np.array(usual[0])
    poor = kept & (relative < _POOR_SHARE) & (residual > _POOR_RESIDUAL * np.array(usual[1]))
    for k in np.flatnonzero(poor.any(1)).tolist():
        record = records[frames[k]]
        losses = [
            Loss(LostReason.LOW_SCORE, float(relative[k, r]), _POOR_SHARE) if poor[k, r] else record.losses[r]
            for r in ARCHES
        ]
        status = np.where(poor[k], LOST, record.status).astype(np.int8)
        records[frames[k]] = replace(record, status=status, losses=(losses[0], losses[1]))
