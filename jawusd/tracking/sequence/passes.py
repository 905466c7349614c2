"""Tracking of the frames of a take from the first one, search of lost teeth, and comparison of the frames."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.tracks import LOST, RECOVERED, TRACKED, LostReason
from jawusd.geometry import relative_pose, transform_points
from jawusd.tracking.contour.frame_record import FrameRecord, Loss, PackedRecords
from jawusd.tracking.contour.quality import fitting_share, residual_px, score_px
from jawusd.tracking.contour.scan import ARCHES, probe_points
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews, View
from jawusd.tracking.follow import Begin, TwoWays, both_ways
from jawusd.tracking.initialization.first_frame import CLEAR_FIT, first_record
from jawusd.tracking.initialization.footage import Footage, MaskSurvey
from jawusd.tracking.initialization.start import SURVEYED
from jawusd.tracking.initialization.start_search import SearchResult, StartSearch
from jawusd.tracking.sequence.frame_tracker import FrameTracker
from jawusd.tracking.sequence.history import History, MotionPredictor, SearchBudget

Progress = Callable[[int, int], None]

_NEARBY_FRAMES = 4000  # frames around a restart from which the tracker is initialised: all would take quadratic time
_TRIED = 3  # maximum number of frames of a lost stretch in which the teeth are searched for
_PATIENCE = 16  # lost frames after which tracking backwards ends: wrong masks often last for a few frames


class LostSearch:
    """Searches for both arches in the masks of frames in which a tracker lost them, without using its predictions."""

    def __init__(self, make_search: Callable[[], StartSearch], footage: Footage) -> None:
        # preparing a search takes time, and is rarely needed
        self._make_search, self._footage = make_search, footage

    def frames(self, lost: range, records: Mapping[int, FrameRecord]) -> list[int]:
        """Return the most promising frames of a lost stretch, those in which one arch was found first.

        Raises:
            TrackingError: no frame has masks of both arches in enough cameras.
            CaptureError: a mask cannot be read.
        """
        found = {frame: int(records[frame].found.sum()) for frame in lost}
        best = max(found.values())
        usual_px = self._usual_px(records)
        ranked = self._footage.survey((lost.start, lost.stop), SURVEYED).promising(len(lost), usual_px).tolist()
        ranked.sort(key=lambda frame: found[frame] != best)
        return ranked[:_TRIED]

    def at(self, frame: int, poses: Array, *, everywhere: bool) -> Array | None:
        """Return T_world_upper and T_world_lower in a frame, shape (2, 4, 4), or None if the teeth do not fit clearly.

        The teeth are searched for near the given poses (2, 4, 4) and, if `everywhere`, then everywhere, which takes
        longer. Raises CaptureError if a mask cannot be read.
        """
        near = self._clear(partial(self._search.near, self._footage, frame, poses))
        if near is None and everywhere:
            return self._clear(partial(self._search.at, self._footage, frame))
        return near

    @staticmethod
    def _clear(attempt: Callable[[], SearchResult]) -> Array | None:
        """Return the poses that a search finds, shape (2, 4, 4), or None if they do not fit clearly."""
        try:
            found = attempt()
        except TrackingError:
            return None
        return found.poses if found.fit >= CLEAR_FIT else None

    @cached_property
    def _search(self) -> StartSearch:
        return self._make_search()

    @cached_property
    def _survey(self) -> MaskSurvey:
        return self._footage.survey(None, SURVEYED)

    def _usual_px(self, records: Mapping[int, FrameRecord]) -> Array | None:
        """Return the largest areas of the masks in frames in which both arches were found [px], shape (2, C)."""
        frames = self._survey.frames.tolist()
        found = np.array([frame in records and bool(records[frame].found.all()) for frame in frames])
        return self._survey.areas_px[found].max(0) if found.any() else None


class Passes:
    """Tracks the frames of a take, and stores one record per frame."""

    def __init__(
        self, solver: ContourSolver, masks: MaskViews, first: int, stop: int, progress: Progress | None
    ) -> None:
        self._solver, self._config, self._masks = solver, solver.config, masks
        self._first, self._stop = first, stop
        self._progress = progress or (lambda done, total: None)
        self._probes = probe_points(solver.scans)
        self.records = PackedRecords()
        self.searches = SearchBudget(stop - first)

    def track_from(self, frame: int, poses: Array, search: LostSearch) -> None:
        """Track from the given frame in both directions, and backwards from frames before which poses may be wrong.

        In lost frames with masks, the teeth are then searched for. `poses` are T_world_scan of both arches in the
        frame, close enough for the alignment to converge, shape (2, 4, 4).

        Raises:
            TrackingError: the teeth do not fit the masks of that frame.
            CaptureError: a mask cannot be read.
        """
        take = TwoWays(
            range(self._first, self._stop),
            self._places,
            _fitting_px,
            jump_mm=np.inf,  # masks show whether a pose is wrong
            patience=_PATIENCE,
            progress=self._progress,
            known=self.records,
        )
        take.follow(Begin(frame, self.begin(frame, poses), self._walk))
        self.judge_first(take, frame)
        take.recover(partial(self._found_in, search, SearchBudget(len(take.frames))))

    def _found_in(self, search: LostSearch, budget: SearchBudget, lost: range, near: FrameRecord) -> Begin[FrameRecord]:
        """Search for the teeth in a lost stretch; raises TrackingError if they do not fit as elsewhere."""
        for frame in search.frames(lost, self.records):
            if budget.allows(frame):
                record = self._searched(search, lost, frame, near.solution.poses)
                budget.note(frame, record is not None)
                if record is not None:
                    return Begin(frame, record, self._walk)
        raise TrackingError("the teeth were not found again in the frames in which they were lost")

    def _searched(self, search: LostSearch, lost: range, frame: int, near: Array) -> FrameRecord | None:
        """Return the record of a lost frame after a search near given poses (2, 4, 4), or None if it stays lost."""
        before = self.records[frame]
        poses = near.copy()
        if before.found[0]:
            poses = before.solution.poses[0] @ np.stack([np.eye(4), relative_pose(*near)])
        if before.found[1]:
            poses = before.solution.poses[1] @ np.stack([relative_pose(*near[::-1]), np.eye(4)])
        found = search.at(frame, poses, everywhere=not before.found.any())
        if found is None:
            return None
        record = self.tracker_beside(frame, lost).track([found], self._masks.at(frame), None)
        status = np.where(before.found, record.status, RECOVERED).astype(np.int8)
        return replace(record, status=status) if record.found.all() else None

    def begin(self, frame: int, poses: Array) -> FrameRecord:
        """Align the first frame."""
        return first_record(self._solver, poses, self._masks.at(frame), frame, True)

    def judge_first(self, take: TwoWays[FrameRecord], first: int) -> None:
        """Track from the nearest frame with a good fit back to the first frame, and beyond it until the poses agree.

        The first frame was aligned before the usual fit was known, and its neighbours were followed from it.
        """
        seen = nearest_well_seen(self.records, first)
        if seen is None or seen == first:
            return
        way = both_ways(seen, take.frames)[seen > first]
        doubted = range(way.start, first + way.step, way.step)
        take.replace(way, self._walk(way, self.records[seen], way), doubted)

    def tracker_beside(self, frame: int, without: Container[int] = ()) -> FrameTracker:
        """Return a tracker for the neighbour of a frame, initialised with the usual fit in other frames around it."""
        history = History(self._config.history_frames, self._config.score_frames)
        for near in self._around(frame, without)[-self._config.history_frames :]:
            history.add(self.records[near])
        return FrameTracker(self._solver, history)

    def _around(self, frame: int, without: Container[int]) -> list[int]:
        """Return the tracked frames around a frame, the nearest ones last."""
        known = (other for other in self.records if other not in without)
        return sorted(known, key=lambda other: -abs(other - frame))[-_NEARBY_FRAMES:]

    def _walk(self, way: range, near: FrameRecord, without: Container[int] = ()) -> Iterator[FrameRecord]:
        """Yield the records of frames in tracking order, next to a given one; arches lost before count as recovered."""
        beside = way.start - way.step
        tracker = self.tracker_beside(beside, without)
        motion = MotionPredictor(near.solution.poses, self._probes)
        for frame in self._around(beside, without)[::10]:
            motion.remember(self.records[frame].solution.poses, self.records[frame].found)
        for frame, views in self._masks.walk(way.start, way.stop, way.step):
            record = self._one(tracker, motion, frame, views)
            if frame in self.records:
                again = record.found & ~self.records[frame].found
                record = replace(record, status=np.where(again, RECOVERED, record.status).astype(np.int8))
            yield record

    def _one(self, tracker: FrameTracker, motion: MotionPredictor, frame: int, views: Sequence[View]) -> FrameRecord:
        """Track the next frame."""
        reach = self._config.gate_per_miss * motion.miss_mm() * self._config.working_px_per_mm
        may_search = motion.search_is_due() and self.searches.allows(frame)
        record = tracker.track(motion.starts(), views, motion.pose_history() if may_search else None, reach)
        if tracker.searched:
            self.searches.note(frame, bool(record.found.all()))
        motion.update(record.solution.poses, record.found, np.asarray(record.used.any(1)))
        tracker.history.add(record)
        return record

    def _places(self, record: FrameRecord) -> Array:
        return transform_points(relative_pose(*record.solution.poses), self._probes[1])


def _fitting_px(record: FrameRecord) -> float:
    return float(score_px(record.solution).sum())


# Minimum score and maximum residual of a frame with a good fit, relative to the medians of the take. These limits only
# determine the frame from which tracking returns to the first frame.
_LEAST_SCORE, _MOST_RESIDUAL = 0.8, 1.2
# Minimum matched fraction of the visible contour, and maximum residual, both relative to the medians of the take: an
# arch that violates both was matched with lip edges instead of teeth. Last value: minimum number of frames for the
# medians. False-alarm rate: at most 1.4 %.
_POOR_SHARE, _POOR_RESIDUAL, _TELLING_FRAMES = 0.5, 1.6, 6


def nearest_well_seen(records: Mapping[int, FrameRecord], start: int) -> int | None:
    """Return the frame nearest to a given one in which both arches fit as well as usual in the take, or None."""
    frames = [frame for frame, record in records.items() if (record.status == TRACKED).all()]
    if not frames:
        return None
    scores = np.array([score_px(records[frame].solution).sum(1) for frame in frames])
    residuals = np.array([residual_px(records[frame].solution) for frame in frames])
    good = scores >= _LEAST_SCORE * np.median(scores, axis=0)
    good &= residuals <= _MOST_RESIDUAL * np.median(residuals, axis=0)
    seen = np.array(frames)[good.all(1)]
    return min(seen.tolist(), key=lambda frame: (abs(frame - start), frame), default=None)


def mark_poorly_seen_lost(records: MutableMapping[int, FrameRecord]) -> None:
    """Mark arches as lost in frames in which they match far less contour than usual, with far larger residuals."""
    frames = sorted(records)
    kept = np.array([records[frame].found for frame in frames])
    if (kept.sum(0) < _TELLING_FRAMES).any():
        return
    solutions = (records[frame].solution for frame in frames)
    share, residual = np.array([(fitting_share(own), residual_px(own)) for own in solutions]).swapaxes(0, 1)
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
