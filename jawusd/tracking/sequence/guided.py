"""Track while masks are made: each frame is segmented around the poses predicted for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import TrackingError
from jawusd.formats.capture import Bootstrap
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import LOST, TRACKED
from jawusd.geometry import Camera, se3_exp, se3_inverse, se3_log, transform_points
from jawusd.geometry.arrays import Array
from jawusd.tracking.config import FOR_AUTO_MASKS, TrackingConfig
from jawusd.tracking.contour.frame_record import FrameRecord, FrameSummary
from jawusd.tracking.contour.quality import coverage_error, uncovered_px
from jawusd.tracking.contour.scan import prepare_scan, probe_points
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View, present_masks
from jawusd.tracking.initialization.bootstrap import pose_from_picks
from jawusd.tracking.initialization.first_frame import first_record
from jawusd.tracking.sequence.frame_tracker import FrameTracker
from jawusd.tracking.sequence.history import History, MotionPredictor

#: Makes the views of a frame of the reference camera: called with the frame, T_world_upper and T_world_lower as
#: expected, shape (2, 4, 4), and the round, 0 for poses that are only predicted.
See = Callable[[int, Array, int], Sequence[View]]

#: Measures how well a frame's pictures agree with guessed poses, without masks: called with the frame and T_world_upper
#: and T_world_lower, shape (N, 2, 4, 4); returns N numbers, more for better.
Agreement = Callable[[int, Array], Array]

_CLEARLY = 1.01  # share of a guess's agreement at which another is better: less is noise of colours
# Shares of the way from the jaw's last pose to earlier ones: jaws repeat their paths.
_SHARES = (0.15, 0.3, 0.6, 1.0)
# Distance between predicted and found pose of the lower arch [mm] beyond which the earlier poses were wrong:
# predictions of a jaw that is tracked err by less.
_WRONG_POSE_MM = 4.0
_WEAK_SCORE = 0.5  # share of the usual score below which a pose may follow wrong masks made around it
_FIRST_ROUNDS = 3  # picks are a few tenths of a millimetre off; each round takes most of the rest


class GuidedTracker:
    """Track the teeth frame by frame; masks are made around the predicted poses."""

    def __init__(
        self,
        upper: Mesh,
        lower: Mesh,
        see: See,
        agreement: Agreement,
        rounds: int,
        config: TrackingConfig | None = None,
        executor: Executor | None = None,
    ) -> None:
        """Prepare the scans.

        Args:
            upper, lower: teeth scans in one frame, in occlusion [mm].
            see: makes the masks.
            agreement: tells good guesses from bad ones. Masks made around a guess tend to confirm it.
            rounds: how often masks and poses alternate on a frame.

        Raises:
            TrackingError: a scan cannot be tracked.
        """
        self._config = config or FOR_AUTO_MASKS
        self._meshes = {"upper": upper, "lower": lower}
        scans = [prepare_scan(mesh, arch) for arch, mesh in self._meshes.items()]
        self._solver = ContourSolver(scans, self._config, executor)
        self._see, self._agreement, self._rounds = see, agreement, rounds
        self._probes = probe_points(scans)

    def picked(self, bootstrap: Bootstrap | None, cameras: Mapping[str, Camera]) -> Array:
        """Return T_world_upper and T_world_lower that agree with the picks, shape (2, 4, 4).

        Raises:
            TrackingError: no picks, too few, or picks that contradict one another.
        """
        if bootstrap is None:
            raise TrackingError(
                "without masks the tracking starts from picks, and the capture has none",
                hint="Make them in the page of `jawusd view CAPTURE`, or add [bootstrap]: three or more vertices of "
                "each scan with their pixels in two cameras.",
            )
        picks = {"upper": bootstrap.upper, "lower": bootstrap.lower}
        return np.stack(
            [pose_from_picks(picks[arch], mesh.vertices, cameras, arch)[0] for arch, mesh in self._meshes.items()]
        )

    def begin(self, frame: int, poses: Array) -> FrameRecord:
        """Align the first frame from picked poses.

        Raises:
            TrackingError: the teeth do not fit what is seen.
        """
        for turn in range(_FIRST_ROUNDS):
            views = self._see(frame, poses, min(turn, self._rounds - 1))
            record = first_record(self._solver, self._config, poses, views, frame)
            poses = record.solution.poses
        return record

    def follow(self, frames: range, past: Sequence[FrameSummary]) -> Iterator[tuple[int, FrameRecord, bool]]:
        """Yield frames, their records, and whether earlier poses of the jaw turn out to have been wrong.

        Lost arches take the poses that agree best with the colours.

        Args:
            frames: in either direction, starting beside a known frame.
            past: the frames before, from the first one aligned to the one next to these.
        """
        history = History(self._config.history_frames, self._config.score_frames)
        motion = MotionPredictor(past[0].poses, self._probes)
        history.add_summary(past[0])
        for before in past[1:]:
            motion.update(before.poses, np.asarray(before.status != LOST), np.asarray(before.used.any(1)), guessed=True)
            history.add_summary(before)
        tracker = FrameTracker(self._solver, self._config, history)
        reliable = _is_reliable(past[-1], history)
        for frame in frames:
            record = self._one(tracker, motion, frame, reliable)
            poses, expected = record.solution.poses, motion.predict()
            motion.update(poses, np.asarray(record.status != LOST), np.asarray(record.used.any(1)), guessed=True)
            history.add(record)
            was_reliable, reliable = reliable, _is_reliable(FrameSummary.of(record), history)
            yield frame, record, reliable and not was_reliable and self.apart_mm(expected, poses) > _WRONG_POSE_MM

    def apart_mm(self, one: Array, other: Array) -> float:
        """Return how far the lower arch is between two poses of both, shape (2, 4, 4), at most [mm]."""
        gap = transform_points(one[1], self._probes[1]) - transform_points(other[1], self._probes[1])
        return float(np.linalg.norm(gap, axis=1).max())

    def judge(self, frame: int, poses: Array, status: NDArray[np.int8]) -> FrameRecord:
        """Return the record of a frame whose poses, shape (2, 4, 4), and status, shape (2,), are known already."""
        views = self._see(frame, poses, self._rounds - 1)
        use = present_masks(views)
        solution = self._solver.solve(poses, views, (), use)
        coverage = coverage_error(*uncovered_px(self._solver.scans, solution.poses, views))
        return FrameRecord(solution, status, use, coverage)

    def _one(self, tracker: FrameTracker, motion: MotionPredictor, frame: int, reliable: bool) -> FrameRecord:
        c = self._config
        starts = motion.starts() if reliable else self._likeliest_first(frame, motion.starts(), motion.pose_history())
        pose_history = motion.pose_history() if motion.search_is_due() else None
        reach = c.gate_per_miss * motion.miss_mm() * c.working_px_per_mm
        views = self._see(frame, starts[0], 0)
        record = None
        if pose_history is None:
            # Masks made around a prediction look suspect next to settled ones: further attempts wait for those.
            record = self._settle(tracker, frame, starts[0], tracker.align_once(starts[0], views, reach))
            if (record.status == LOST).any():
                views, record = self._see(frame, starts[0], 0), None
        if record is None:
            record = self._settle(tracker, frame, starts[0], tracker.track(starts, views, pose_history, reach))
        lost = (record.status == LOST)[:, None, None]
        poses = np.where(lost, starts[0], record.solution.poses)
        return replace(record, solution=replace(record.solution, poses=poses))

    def _likeliest_first(self, frame: int, starts: list[Array], pose_history: list[Array]) -> list[Array]:
        """Return starts (2, 4, 4) with the one in front that agrees best with the colours.

        Poses between the prediction and earlier poses are tried too.
        """
        guesses = [*starts, *_poses_towards(starts, pose_history)]
        rates = self._agreement(frame, np.stack(guesses))
        best = int(np.argmax(rates))
        if rates[best] <= _CLEARLY * rates[0]:
            return starts
        return [guesses[best], *(start for k, start in enumerate(starts) if k != best)]

    def _settle(self, tracker: FrameTracker, frame: int, start: Array, record: FrameRecord) -> FrameRecord:
        """Alternate masks and poses after the first alignment."""
        for turn in range(1, self._rounds):
            lost = (record.status == LOST)[:, None, None]
            poses = np.where(lost, start, record.solution.poses)
            record = tracker.track([poses], self._see(frame, poses, turn), None)
        return record


def _is_reliable(past: FrameSummary, history: History) -> bool:
    """Tell whether a frame, which the history holds already, has nothing unusual."""
    weak = past.score_px.sum(1) < _WEAK_SCORE * history.usual_score().sum(1)
    return bool((past.status == TRACKED).all() and not weak.any())


def _poses_towards(starts: Sequence[Array], pose_history: Sequence[Array]) -> list[Array]:
    """Return poses of the jaw between the first start and earlier ones, with the predicted head."""
    head, last = starts[0][0], se3_inverse(starts[0][0]) @ starts[0][1]
    out = []
    for poses in pose_history:
        twist = se3_log(se3_inverse(poses[0]) @ poses[1] @ se3_inverse(last))
        out += [np.stack([head, head @ se3_exp(share * twist) @ last]) for share in _SHARES]
    return out
