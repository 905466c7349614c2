"""Passes over the frames of a take: away from the first frame, back to it, and backwards into every gap."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.tracks import LOST, RECOVERED
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import score_px
from jawusd.tracking.contour.scan import probe_points
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews, View
from jawusd.tracking.initialization.first_frame import first_record
from jawusd.tracking.sequence.frame_tracker import FrameTracker
from jawusd.tracking.sequence.history import History, MotionPredictor, SearchAllowance
from jawusd.tracking.sequence.packed_records import PackedRecords
from jawusd.tracking.sequence.well_seen import nearest_well_seen

Progress = Callable[[int, int], None]

# Most frames around a restart whose poses and quality the tracker takes over: without a limit, a long take with many
# gaps would cost the square of its length.
_NEARBY_FRAMES = 4000
_AGREED_MM = 0.05  # centres of arches tracked from both sides: half the error that counts as one


class Passes:
    """Run the tracker over the frames of a take and keep one record per frame."""

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
        self.searches = SearchAllowance(stop - first)

    def track_from(self, frame: int, poses: Array) -> None:
        """Track all frames, both ways from the one whose poses are given, then back to it and into the gaps.

        Args:
            frame: reference frame number.
            poses: T_world_scan of both arches there, near enough to be aligned, shape (2, 4, 4).

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
        """Align the bootstrap frame from the pick poses."""
        self.records[frame] = first_record(self._solver, self._config, poses, self._masks.at(frame), frame, True)
        self._progress(1, self._stop - self._first)

    def run(self, frames: range) -> None:
        """Track away from the frame next to the first one given."""
        if not len(frames):
            return
        tracker, motion = self.beside(frames.start - frames.step)
        for frame, views in self._masks.walk(frames.start, frames.stop, frames.step):
            record = self._one(tracker, motion, frame, views)
            self.records[frame] = record
            self._progress(len(self.records), self._stop - self._first)

    def track_back_to(self, start: int) -> None:
        """Track to the first frame from one that shows the teeth well, and past it until both ways agree.

        The first frame was aligned without knowing how well teeth fit in this take, and those beside it followed it.
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
        """Track backwards into every gap from the frame after it, and keep frames that lose fewer arches."""
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
        """Return a tracker and a predictor that start from the frames around a tracked one, or those given."""
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
        """Track the next frame; where an arch is lost, poses known of it, shape (2, 4, 4), are tried as well."""
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
    """Yield runs of frames in which an arch is lost, as first frame and one past the last."""
    lost = [frame for frame in sorted(records) if (records[frame].status == LOST).any()]
    runs: list[list[int]] = []
    for frame in lost:
        if runs and runs[-1][1] == frame:
            runs[-1][1] = frame + 1
        else:
            runs.append([frame, frame + 1])
    return [(a, b) for a, b in runs]
