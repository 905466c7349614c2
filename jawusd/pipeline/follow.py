"""Follow both arches through footage by colours alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from typing import TYPE_CHECKING

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import Camera, relative_pose, transform_points
from jawusd.pipeline.cuts import Cutter
from jawusd.pipeline.state import Progress
from jawusd.pipeline.subject import Subject

if TYPE_CHECKING:
    from jawusd.segmentation.picture import ColourFootage
    from jawusd.tracking.contour.scan import Scan
    from jawusd.tracking.contour.views import View
    from jawusd.tracking.region.appearance import Cut
    from jawusd.tracking.region.tracker import RegionPose, RegionTracker

# Change of the jaw's motion from frame to frame [mm] after which the frames before are looked at again, and distance of
# poses that are the same. Speech and chewing reach 1 mm at 24 frames a second: needless looks end after a frame.
_JUMP_MM, _SAME_MM = 0.8, 0.15
_LOOKS = 10  # frames that are kept to look at them again: a few MB
STAGE = "follow"


class Follower:
    """Follow both arches from one frame to both ends of a take.

    Attributes:
        cameras: calibrated, those that have a video, by name.
        looks: poses and views of some frames of the last run, all over the take.
    """

    def __init__(
        self,
        footage: ColourFootage,
        cameras: Mapping[str, Camera],
        scans: Sequence[Scan],
        subject: Subject,
        pool: Executor | None = None,
    ) -> None:
        """Prepare.

        Args:
            footage, cameras: pictures, and the calibrated cameras by the same names.
            scans: upper and lower, prepared.
            subject: gives axes and condyles.
            pool: threads that match the contours of all cameras side by side.
        """
        self.cameras = cameras
        self._footage, self._scans, self._subject = footage, scans, subject
        self._pool = pool
        self.looks: list[tuple[Array, list[View]]] = []

    def begun(self, frame: int, poses: Array) -> tuple[RegionPose, float]:
        """Return better poses on a frame than T_world_upper, T_world_lower (2, 4, 4), and how well they fit.

        That is the share of the contour in sight that fits the colours, of the arch that fits worse, 0 .. 1. What
        `run` goes on from is kept.

        Raises:
            CaptureError: a picture cannot be decoded.
        """
        from jawusd.tracking.contour.scan import teeth_centre
        from jawusd.tracking.region.tracker import RegionTracker

        cutter = Cutter(self.cameras, self._scans, teeth_centre(self._scans, poses), self._pool)
        axes = self._subject.T_anatomical_skull[:3, :3]
        landmarks, cameras = self._subject.landmarks, list(self.cameras.values())
        tracker = RegionTracker(self._scans, cameras, landmarks, axes, executor=self._pool)
        found = tracker.begin(cutter.cut(self._footage.at(frame)), poses)
        self._begun: tuple[int, RegionPose, RegionTracker, Cutter] = frame, found, tracker, cutter
        return found, tracker.first_fit

    def run(self, frames: range, progress: Progress) -> dict[int, RegionPose]:
        """Return the poses of all frames, from the frame that `begun` had last.

        Raises:
            CaptureError: a picture cannot be decoded.
        """
        frame, begin, tracker, cutter = self._begun
        self.looks.clear()
        looked = set(np.linspace(frames.start, frames.stop - 1, _LOOKS).astype(int).tolist())
        out, points = {frame: begin}, self._subject.landmarks[:3]
        progress(STAGE, 1, len(frames))
        for way in (range(frame + 1, frames.stop), range(frame - 1, frames.start - 1, -1)):
            cuts = _Latest(cutter.walk(self._footage, way))
            for at, found in zip(way, tracker.follow(cuts, begin.poses), strict=True):
                out[at] = found
                if at in looked and found.found.all():
                    self.looks.append((found.poses, tracker.views(cuts.latest(found.poses), found.poses)))
                progress(STAGE, len(out), len(frames))
            for jump in _jumps(way, out, points):
                back = range(jump - way.step, frame, -way.step)
                _follow_back(back, tracker.follow(cutter.walk(self._footage, back), out[jump].poses), out, points)
        return out


class _Latest(Iterator["Cut"]):
    """Pass on what cuts the pictures, and keep the one passed on last; `itertools.tee` would keep up to 57 of them."""

    def __init__(self, cuts: Iterator[Cut]) -> None:
        self._cuts = cuts

    def __next__(self) -> Cut:
        self.latest = next(self._cuts)
        return self.latest


def _places(found: RegionPose, points: Array) -> Array:
    """Return where points of the lower teeth (N, 3) are against the upper ones [mm], shape (N, 3)."""
    return transform_points(relative_pose(found.poses[0], found.poses[1]), points)


def _jumps(way: range, known: Mapping[int, RegionPose], points: Array) -> list[int]:
    """Return the frames of a way on which the jaw changes its motion more suddenly than jaws do."""
    if len(way) < 3:
        return []
    places = np.stack([_places(known[frame], points) for frame in way])
    bend_mm = np.linalg.norm(np.diff(places, 2, axis=0), axis=-1).mean(-1)
    return [way[k + 2] for k in np.flatnonzero(bend_mm > _JUMP_MM).tolist()]


def _follow_back(back: range, again: Iterator[RegionPose], known: dict[int, RegionPose], points: Array) -> None:
    """Put in poses followed the other way, as long as they differ and more contour fits them.

    A jaw that is found again has been followed wrongly before; the frames up to there look right one by one.
    """
    for frame, found in zip(back, again, strict=False):
        apart_mm = np.linalg.norm(_places(found, points) - _places(known[frame], points), axis=-1).mean()
        better = found.objective_px > known[frame].objective_px or not known[frame].found.all()
        if apart_mm < _SAME_MM or not found.found.all() or not better:
            return
        known[frame] = found
