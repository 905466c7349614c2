"""Follow the teeth through footage by their colours, and track captures without masks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError
from jawusd.formats.capture import Bootstrap, CameraSource, Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera, relative_pose, transform_points
from jawusd.pipeline.cameras import open_footage
from jawusd.pipeline.picture_search import PictureSearch, Start, picked_start
from jawusd.pipeline.state import Progress
from jawusd.pipeline.subject import Subject, subject_of_capture

if TYPE_CHECKING:
    from jawusd.segmentation.picture import ColourFootage, PictureFrame, Pictures
    from jawusd.tracking.config import Mapper
    from jawusd.tracking.contour.scan import Scan
    from jawusd.tracking.contour.views import View
    from jawusd.tracking.region.appearance import Cut, Picture
    from jawusd.tracking.region.picture_start import ArchStart
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
STAGE = "follow"


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

    def run(self, frames: range, progress: Progress) -> dict[int, RegionPose]:
        """Return the poses of all frames, starting from the frame last passed to `start_at`.

        Raises:
            CaptureError: an image cannot be decoded.
        """
        frame, begin, tracker, cutter = self._start
        self.sampled_views.clear()
        sampled = set(np.linspace(frames.start, frames.stop - 1, _SAMPLED_VIEWS).astype(int).tolist())
        out, points = {frame: begin}, self._subject.landmarks[:3]
        progress(STAGE, 1, len(frames))
        for way in (range(frame + 1, frames.stop), range(frame - 1, frames.start - 1, -1)):
            cuts = _Latest(cutter.walk(self._footage, way))
            for at, found in zip(way, tracker.follow(cuts, begin.poses), strict=True):
                out[at] = found
                if at in sampled and found.found.all():
                    self.sampled_views.append((found.poses, tracker.views(cuts.latest(found.poses), found.poses)))
                progress(STAGE, len(out), len(frames))
            for jump in _jumps(way, out, points):
                back = range(jump - way.step, frame, -way.step)
                _follow_back(back, tracker.follow(cutter.walk(self._footage, back), out[jump].poses), out, points)
        return out


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


def _follow_back(back: range, again: Iterator[RegionPose], known: dict[int, RegionPose], points: Array) -> None:
    """Replace poses by those tracked backwards, as long as the two differ and the latter fit more of the contour.

    A jump means that the tracker recovered from an error; each wrong pose before the jump is plausible by itself.
    """
    for frame, found in zip(back, again, strict=False):
        apart_mm = np.linalg.norm(_places(found, points) - _places(known[frame], points), axis=-1).mean()
        better = found.objective_px > known[frame].objective_px or not known[frame].found.all()
        if apart_mm < _SAME_MM or not found.found.all() or not better:
            return
        known[frame] = found


FEWEST_VIDEOS = 2
# Minimum fraction of the visible contour that matches the colours, below which picks are rejected. Fractions of six
# path-traced mouths were 0.26 to 0.5; of three dark, noisy or colourless ones 0.13 to 0.27, with errors up to 0.3 mm. A
# focal length wrong by 15 % gave 0.05, another subject's lower scan 0.08 and 0.12, with errors above 1 mm.
_LEAST_PICKED_FIT = 0.1


def track_videos(
    capture: Capture, offsets: dict[str, int], meshes: Mapping[str, Mesh], jobs: int, progress: Progress
) -> Tracks:
    """Track both arches by the colours of the videos; see `track`.

    Args:
        offsets: frame offset by camera.
        meshes: labelled meshes of the capture.

    Raises:
        CaptureError: fewer than two cameras have a video, or one cannot be decoded.
        TrackingError: the teeth were not found.
    """
    from jawusd.segmentation.picture import ColourFootage
    from jawusd.tracking.contour.scan import prepare_scan
    from jawusd.tracking.region.picture_start import ArchStart
    from jawusd.tracking.region.take import TakeFacts, footage_findings, tracks_of

    cameras, videos = open_footage(capture)
    if len(videos) < FEWEST_VIDEOS:
        raise CaptureError(
            f"{len(videos)} of {len(capture.cameras)} cameras have a video; tracking without masks needs at least "
            f"{FEWEST_VIDEOS}.",
            path=capture.folder / "capture.toml",
        )
    cameras = {name: camera for name, camera in cameras.items() if name in videos}
    footage = ColourFootage(videos, offsets)
    frames = range(*(capture.frames or footage.range()))
    subject = subject_of_capture(capture, meshes)
    teeth = meshes["upper_teeth"], meshes["lower_teeth"]
    scans = prepare_scan(teeth[0], "upper"), prepare_scan(teeth[1], "lower")
    with ThreadPoolExecutor(jobs) as pool:
        rows = ArchStart(teeth, scans, capture.anatomy.T_anatomical_skull, pool.map)
        follower = Follower(footage, cameras, scans, subject, pool)
        picks = capture.bootstrap
        if picks is None:
            begin = searched_start(capture, offsets, footage, rows, follower, frames, progress)
        else:
            begin = _picked_start(rows, follower, picks, frames)
        followed = follower.run(frames, progress)
    facts = TakeFacts(
        tuple(cameras.values()),
        scans,
        subject.landmarks,
        subject.T_anatomical_skull[:3, :3],
        capture.motion.rest_frame,
        capture.scans.registration == "take",
    )
    tracks = tracks_of(followed, facts, follower.sampled_views)
    tracks.meta["start"] = {"by": begin.by, "frame": begin.frame, "fit": begin.fit}
    findings = [finding.as_json() for finding in (*rows.findings, *footage_findings(tracks))]
    tracks.meta["findings"] = [*tracks.meta.get("findings", []), *findings]
    return tracks


def _picked_start(rows: ArchStart, follower: Follower, picks: Bootstrap, frames: range) -> Start[Array]:
    """Return a start from the picks.

    Raises:
        TrackingError: the picks are inconsistent, or do not fit the images.
    """

    def begin() -> tuple[Array, float]:
        found, fit = follower.start_at(picks.frame, rows.picked(picks, follower.cameras))
        return found.poses, fit

    return picked_start(picks.frame, frames, begin, _LEAST_PICKED_FIT)


def searched_start(
    capture: Capture,
    offsets: Mapping[str, int],
    footage: ColourFootage,
    rows: ArchStart,
    follower: Follower,
    frames: range,
    progress: Progress,
) -> Start[Array]:
    """Search for the teeth and start the follower there; return T_world_upper, T_world_lower (2, 4, 4) as the pose.

    Raises:
        TrackingError: the teeth were not found.
        CaptureError: an image cannot be decoded.
    """

    def near(sources: Sequence[CameraSource], frame: int) -> Array | None:
        return rows.at(sources, follower.cameras, offsets, frame)

    def judged(frame: int, poses: Array) -> tuple[Array, float]:
        found, fit = follower.start_at(frame, poses)
        return found.poses, fit

    search = PictureSearch(capture, footage, follower.cameras, near, judged)
    begin = search.run(frames, progress)
    follower.start_at(begin.frame, begin.pose)  # repeated, because the search may have tried other frames since
    return begin
