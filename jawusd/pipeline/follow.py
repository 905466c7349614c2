"""Follow the teeth through footage by their colours, from a start to both ends and again where they were lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.geometry import Camera, relative_pose, transform_points
from jawusd.pipeline.picture_search import Start
from jawusd.pipeline.state import Progress
from jawusd.pipeline.subject import Subject

if TYPE_CHECKING:
    from jawusd.segmentation.picture import ColourFootage, PictureFrame, Pictures
    from jawusd.tracking.config import Mapper
    from jawusd.tracking.contour.scan import Scan
    from jawusd.tracking.contour.views import View
    from jawusd.tracking.region.appearance import Cut, Picture
    from jawusd.tracking.region.tracker import RegionPose, RegionTracker


_WORKING_PX_PER_MM, _MARGIN_MM = 7.2, 6.0  # working resolution at the teeth, and margin of the crop around the teeth


class Cutter:
    """Crop the images of all cameras to the teeth."""

    def __init__(
        self, cameras: Mapping[str, Camera], scans: Sequence[Scan], centre: Array, executor: Executor | None = None
    ) -> None:
        """Choose the working resolution of every camera.

        Args:
            cameras: calibrated, by name.
            scans: upper and lower.
            centre: approximate position of the teeth in the world [mm], shape (3,).
            executor: threads for the images of all cameras.
        """
        from jawusd.segmentation.picture import PictureFrame

        self._frames: dict[str, PictureFrame] = {
            name: PictureFrame(camera, centre, _WORKING_PX_PER_MM) for name, camera in cameras.items()
        }
        self._map: Mapper = executor.map if executor else map
        self._probes = [scan.probes for scan in scans]

    def cut(self, pictures: Pictures) -> Cut:
        """Return a function that crops the images of one frame around given poses."""

        def cut(poses: Array) -> list[Picture | None]:
            around = np.concatenate([transform_points(T, own) for T, own in zip(poses, self._probes, strict=True)])
            return list(self._map(lambda name: self._one(name, pictures, around), self._frames))

        return cut

    def walk(self, footage: ColourFootage, frames: range) -> Iterator[Cut]:
        """Yield the function of `cut` for each frame.

        Raises:
            CaptureError: an image cannot be decoded.
        """
        return (self.cut(pictures) for _, pictures in footage.walk(frames))

    def _one(self, name: str, pictures: Pictures, around: Array) -> Picture | None:
        from jawusd.tracking.region.appearance import Picture

        image = pictures[name]
        window = None if image is None else self._frames[name].window(image, around, _MARGIN_MM)
        return None if window is None else Picture(window.camera, window.rgb)


# Threshold of the second difference of the jaw's motion [mm], above which the preceding frames are tracked again
# backwards, and distance [mm] below which two poses count as equal. Speech and chewing reach second differences of 1 mm
# at 24 fps; a false positive costs the time of one frame.
_JUMP_MM, _SAME_MM = 0.8, 0.15
_SAMPLED_VIEWS = 10  # maximum number of frames whose views are kept: a few MB
_SHORTEST_LOSS = 3  # minimum number of successive lost frames in which the teeth are searched for
STAGE = "follow"

#: Function that searches for the teeth in some frames, passes what it finds to `Follower.start_at`, and returns it.
#: Its second argument is the up direction of the head in the world, shape (3,). It raises TrackingError.
Find: TypeAlias = Callable[[range, Array], Start[Array]]


class Follower:
    """Follow both arches from one frame to both ends of a take.

    Attributes:
        cameras: calibrated, those that have a video, by name.
        sampled_views: poses and views of evenly sampled frames of the last run.
    """

    def __init__(
        self,
        footage: ColourFootage,
        cameras: Mapping[str, Camera],
        scans: Sequence[Scan],
        subject: Subject,
        pool: Executor | None = None,
    ) -> None:
        """Prepare to follow.

        Args:
            footage, cameras: images, and the calibrated cameras by name.
            scans: upper and lower, prepared.
            subject: provides axes and condyles.
            pool: threads for the cameras.
        """
        self.cameras = cameras
        self._footage, self._scans, self._subject = footage, scans, subject
        self._pool = pool
        self.sampled_views: list[tuple[Array, list[View]]] = []

    def start_at(self, frame: int, poses: Array) -> tuple[RegionPose, float]:
        """Refine T_world_upper, T_world_lower (2, 4, 4) on a frame, from which `run` then starts; return pose and fit.

        The fit is the fraction of the visible contour that matches the colours, 0 .. 1, for the worse arch.

        Raises:
            CaptureError: an image cannot be decoded.
        """
        from jawusd.tracking.contour.scan import teeth_centre
        from jawusd.tracking.region.tracker import RegionTracker

        cutter = Cutter(self.cameras, self._scans, teeth_centre(self._scans, poses), self._pool)
        axes = self._subject.T_anatomical_skull[:3, :3]
        landmarks, cameras = self._subject.landmarks, list(self.cameras.values())
        tracker = RegionTracker(self._scans, cameras, landmarks, axes, executor=self._pool)
        found = tracker.begin(cutter.cut(self._footage.at(frame)), poses)
        self._start: tuple[int, RegionPose, RegionTracker, Cutter] = frame, found, tracker, cutter
        return found, tracker.first_fit

    def run(self, frames: range, find: Find, progress: Progress) -> dict[int, RegionPose]:
        """Return the poses of all frames, starting from the frame last passed to `start_at`.

        Where the teeth are lost for several frames, `find` searches for them.

        Raises:
            CaptureError: an image cannot be decoded.
        """
        frame, begin, tracker, cutter = self._start
        self.sampled_views.clear()
        sampled = set(np.linspace(frames.start, frames.stop - 1, _SAMPLED_VIEWS).astype(int).tolist())
        out, points = {frame: begin}, self._subject.landmarks[:3]
        progress(STAGE, 1, len(frames))
        for way in _ways(frame, frames):
            cuts = _Latest(cutter.walk(self._footage, way))
            for at, found in zip(way, tracker.follow(cuts, begin.poses), strict=True):
                out[at] = found
                if at in sampled and found.found.all():
                    self.sampled_views.append((found.poses, tracker.views(cuts.latest(found.poses), found.poses)))
                progress(STAGE, len(out), len(frames))
            for jump in _jumps(way, out, points):
                back = range(jump - way.step, frame, -way.step)
                _replace(back, tracker.follow(cutter.walk(self._footage, back), out[jump].poses), out, points)
        self._recover(out, frames, find)
        return out

    def _recover(self, known: dict[int, RegionPose], frames: range, find: Find) -> None:
        """Search for the teeth where they were lost, and follow them from there both ways, up to equal known poses.

        Poses that contradict the known ones where they meet, and agree with none, are discarded.
        """
        vain: set[int] = set()
        while lost := next((s for s in _lost_stretches(known, frames) if s.start not in vain), None):
            nearest = min(
                (f for f in known if known[f].found[0]), key=lambda f: min(abs(f - lost[0]), abs(f - lost[-1]))
            )
            up = known[nearest].poses[0, :3, :3] @ self._subject.T_anatomical_skull[1, :3]
            again = self._followed_from(lost, frames, find, up, known)
            if again is None:
                vain.update(lost)
            else:
                known.update(again)

    def _followed_from(
        self, lost: range, frames: range, find: Find, up_world: Array, known: Mapping[int, RegionPose]
    ) -> dict[int, RegionPose] | None:
        """Return all poses after a search in lost frames, or None if it fails or contradicts the known poses."""
        try:
            begin = find(lost, up_world)
        except TrackingError:
            return None
        frame, pose, tracker, cutter = self._start
        again = {**known, begin.frame: pose}
        meetings = [
            _replace(
                way, tracker.follow(cutter.walk(self._footage, way), pose.poses), again, self._subject.landmarks[:3]
            )
            for way in _ways(frame, frames)
        ]
        return None if False in meetings and True not in meetings else again


class _Latest(Iterator["Cut"]):
    """An iterator that stores only its last item; `itertools.tee` would store up to 57."""

    def __init__(self, cuts: Iterator[Cut]) -> None:
        self._cuts = cuts

    def __next__(self) -> Cut:
        self.latest = next(self._cuts)
        return self.latest


def _places(found: RegionPose, points: Array) -> Array:
    """Return points of the lower teeth (N, 3) in the frame of the upper teeth [mm], shape (N, 3)."""
    return transform_points(relative_pose(found.poses[0], found.poses[1]), points)


def _jumps(way: range, known: Mapping[int, RegionPose], points: Array) -> list[int]:
    """Return the frames at which the jaw accelerates implausibly."""
    if len(way) < 3:
        return []
    places = np.stack([_places(known[frame], points) for frame in way])
    bend_mm = np.linalg.norm(np.diff(places, 2, axis=0), axis=-1).mean(-1)
    return [way[k + 2] for k in np.flatnonzero(bend_mm > _JUMP_MM).tolist()]


def _ways(frame: int, frames: range) -> tuple[range, range]:
    """Return the frames after and before a frame, in the order in which they are followed."""
    return range(frame + 1, frames.stop), range(frame - 1, frames.start - 1, -1)


def _lost_stretches(known: Mapping[int, RegionPose], frames: range) -> list[range]:
    """Return the runs of successive frames on which an arch was not found, except very short ones."""
    found = np.array([known[frame].found.all() for frame in frames])
    edges = np.flatnonzero(np.diff(np.concatenate([[True], found, [True]]).astype(int))).reshape(-1, 2).tolist()
    return [frames[first:stop] for first, stop in edges if stop - first >= _SHORTEST_LOSS]


def _replace(way: range, again: Iterator[RegionPose], known: dict[int, RegionPose], points: Array) -> bool | None:
    """Replace poses by others of the same frames, as long as the two differ and the latter fit more of the contour.

    A jump means that the tracker recovered from an error, and a loss that it made one; each wrong pose before is
    plausible by itself.

    Returns:
        True if an equal pose ended this, False if a different one that fits at least as well, None if the arches were
        lost or the take ended.
    """
    for frame, found in zip(way, again, strict=False):
        if not found.found.all():
            return None
        if known[frame].found.all():
            apart_mm = np.linalg.norm(_places(found, points) - _places(known[frame], points), axis=-1).mean()
            if apart_mm < _SAME_MM:
                return True
            if found.objective_px <= known[frame].objective_px:
                return False
        known[frame] = found
    return None
