"""Tracking with masks that are generated while tracking, around poses found by colour."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.capture import Bootstrap
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import LOST
from jawusd.geometry import Camera
from jawusd.tracking.config import FOR_AUTO_MASKS, TrackingConfig
from jawusd.tracking.contour.frame_record import FrameRecord, FrameSummary
from jawusd.tracking.contour.quality import coverage_error, uncovered_px
from jawusd.tracking.contour.scan import Scan, prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View, present_masks
from jawusd.tracking.initialization.bootstrap import poses_from_picks
from jawusd.tracking.initialization.first_frame import FIRST_ROUNDS, first_record
from jawusd.tracking.sequence.frame_tracker import FrameTracker
from jawusd.tracking.sequence.history import History

#: Returns the views of a frame, given its number in the reference camera, expected T_world_upper and T_world_lower,
#: shape (2, 4, 4), and the index of the round, which is 0 for poses not yet aligned with masks.
MakeViews = Callable[[int, Array, int], Sequence[View]]


class GuidedTracker:
    """Tracks the teeth frame by frame, with masks generated around poses found by colour."""

    def __init__(
        self,
        upper: Mesh,
        lower: Mesh,
        see: MakeViews,
        rounds: int,
        config: TrackingConfig | None = None,
        executor: Executor | None = None,
    ) -> None:
        """Prepare the scans, in one coordinate frame and in occlusion [mm]; errors are those of `prepare_scan`.

        `see` generates the masks of a frame around its poses, which they tend to confirm; the poses are then aligned
        with the masks, `rounds` times.
        """
        self._vertices = upper.vertices, lower.vertices
        scans = prepare_scan(upper, "upper"), prepare_scan(lower, "lower")
        self._solver = ContourSolver(scans, config or FOR_AUTO_MASKS, executor)
        self._see, self._rounds = see, rounds

    @property
    def scans(self) -> tuple[Scan, ...]:
        """The prepared scans."""
        return self._solver.scans

    def picked(self, bootstrap: Bootstrap | None, cameras: Mapping[str, Camera]) -> Array:
        """Return T_world_upper and T_world_lower from the picks, shape (2, 4, 4).

        Raises TrackingError if there are no picks, too few, or picks that contradict one another.
        """
        if bootstrap is None:
            raise TrackingError(
                "without masks, tracking starts from picks, but the capture has no picks",
                hint="Pick vertices on the page of `jawusd view CAPTURE`, or add [bootstrap]: three or more vertices "
                "of each scan with their pixels in two cameras.",
            )
        return poses_from_picks(bootstrap, self._vertices, cameras)

    def begin(self, frame: int, poses: Array) -> FrameRecord:
        """Align the first frame from picked poses; raises TrackingError if the teeth do not fit the views."""
        for turn in range(FIRST_ROUNDS):
            views = self._see(frame, poses, min(turn, self._rounds - 1))
            record = first_record(self._solver, poses, views, frame)
            poses = record.solution.poses
        return record

    def follow(
        self, frames: range, guide: Mapping[int, Array], past: Sequence[FrameSummary]
    ) -> Iterator[tuple[int, FrameRecord]]:
        """Yield frame numbers and records; poses of lost arches are replaced by those of `guide`.

        Args:
            frames: frame numbers in either direction.
            guide: poses by frame, as found by colour, shape (2, 4, 4).
            past: summaries of the frames tracked before, from the first aligned frame to the neighbour of `frames`.
        """
        history = History(self._solver.config.history_frames, self._solver.config.score_frames)
        for before in past:
            history.add_summary(before)
        tracker = FrameTracker(self._solver, history)
        for frame in frames:
            self._solver.forget_drawings()  # makes the poses of resumed runs the same as those of uninterrupted runs
            start = guide[frame]
            record = tracker.track([start], self._see(frame, start, 0), None)
            for turn in range(1, self._rounds):
                poses = _without_lost(record, start)
                record = tracker.track([poses], self._see(frame, poses, turn), None)
            solution = replace(record.solution, poses=_without_lost(record, start))
            record = replace(record, solution=solution)
            history.add(record)
            yield frame, record

    def judge(self, frame: int, poses: Array, status: NDArray[np.int8]) -> FrameRecord:
        """Return the record of a frame with known poses (2, 4, 4) and status (2,)."""
        self._solver.forget_drawings()
        views = self._see(frame, poses, self._rounds - 1)
        use = present_masks(views)
        solution = self._solver.solve(poses, views, (), use)
        coverage = coverage_error(*uncovered_px(self._solver.scans, solution.poses, views))
        return FrameRecord(solution, status, use, coverage)


def _without_lost(record: FrameRecord, otherwise: Array) -> Array:
    """Return the poses of a record, shape (2, 4, 4), with the poses of lost arches replaced."""
    return np.where((record.status == LOST)[:, None, None], otherwise, record.solution.poses)
