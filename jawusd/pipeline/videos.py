"""Track teeth by the colours of footage, without masks: in takes, and in shots of a subject who has a rig.

The teeth are followed from a start frame to both ends of the take. Where they are lost, they are searched for again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.performance import Performance
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera, relative_pose, transform_points
from jawusd.pipeline.cameras import open_colour_footage, open_videos
from jawusd.pipeline.picture_search import PictureSearch, Start
from jawusd.pipeline.state import Progress
from jawusd.pipeline.subject import Subject, subject_of_capture
from jawusd.segmentation.picture import ColourFootage, PictureFrame, Pictures
from jawusd.tracking.config import Mapper
from jawusd.tracking.contour.scan import Scan, prepare_scan, teeth_centre
from jawusd.tracking.contour.views import View
from jawusd.tracking.follow import Begin, TwoWays
from jawusd.tracking.performance.coordinates import Pose
from jawusd.tracking.performance.skin import SkinOf
from jawusd.tracking.region.appearance import Cut, Picture
from jawusd.tracking.region.performance import PictureShot, PictureTake
from jawusd.tracking.region.picture_start import ArchStart, PictureStart
from jawusd.tracking.region.take import footage_findings, tracks_of
from jawusd.tracking.region.tracker import RegionPose, RegionTracker

_WORKING_PX_PER_MM, _MARGIN_MM = 7.2, 6.0  # resolution at the teeth, and margin around them, in cropped images


class Cutter:
    """Crops the images of all cameras to the teeth."""

    def __init__(
        self, cameras: Mapping[str, Camera], scans: Sequence[Scan], centre: Array, executor: Executor | None = None
    ) -> None:
        """Choose the working resolution of every camera, at about `centre`, the teeth in the world [mm] (3,)."""
        self._frames: dict[str, PictureFrame] = {
            name: PictureFrame(camera, centre, _WORKING_PX_PER_MM) for name, camera in cameras.items()
        }
        self._map: Mapper = executor.map if executor else map
        self._probes = [scan.probes for scan in scans]

    def cut(self, pictures: Pictures) -> Cut:
        """Return a function that crops the images of one video frame around given poses."""

        def cut(poses: Array) -> list[Picture | None]:
            around = np.concatenate([transform_points(T, own) for T, own in zip(poses, self._probes, strict=True)])
            return list(self._map(lambda name: self._one(name, pictures, around), self._frames))

        return cut

    def walk(self, footage: ColourFootage, frames: range) -> Iterator[Cut]:
        """Yield the function returned by `cut` for each frame; raises CaptureError."""
        return (self.cut(pictures) for _, pictures in footage.walk(frames))

    def _one(self, name: str, pictures: Pictures, around: Array) -> Picture | None:
        image = pictures[name]
        window = None if image is None else self._frames[name].window(image, around, _MARGIN_MM)
        return None if window is None else Picture(window.camera, window.rgb)


_SAMPLED_VIEWS = 10  # maximum number of frames whose views are kept: a few MB
STAGE = "follow"


class Follower:
    """Tracker of both arches from a start frame; `sampled_views` has poses and views of some frames of the last run."""

    def __init__(
        self,
        footage: ColourFootage,
        cameras: Mapping[str, Camera],
        scans: Sequence[Scan],
        subject: Subject,
        pool: Executor | None = None,
    ) -> None:
        """Prepare the tracker; the subject provides axes and condyles."""
        self.cameras = cameras
        self._footage, self._scans, self._subject = footage, scans, subject
        self._pool = pool
        self.sampled_views: list[tuple[Array, list[View]]] = []
        self._wanted: set[int] = set()  # frames to be sampled

    def start_at(self, frame: int, poses: Array) -> tuple[Array, float]:
        """Refine T_world_upper, T_world_lower (2, 4, 4) in the frame from which `run` will start; return them, and fit.

        The fit is the fraction of the contour in sight that matches the colours, 0 .. 1, for the worse arch. Raises
        CaptureError if an image cannot be decoded.
        """
        cutter = Cutter(self.cameras, self._scans, teeth_centre(self._scans, poses), self._pool)
        axes = self._subject.T_anatomical_skull[:3, :3]
        landmarks, cameras = self._subject.landmarks, list(self.cameras.values())
        tracker = RegionTracker(self._scans, cameras, landmarks, axes, executor=self._pool)
        found = tracker.begin(cutter.cut(self._footage.at(frame)), poses)
        self._begin = Begin(frame, found, partial(self._walk, tracker, cutter))
        return found.poses, tracker.first_fit

    def start_by(
        self, search: PictureSearch[Array], frames: range, progress: Progress, up_world: Array | None = None
    ) -> Start[Array]:
        """Start where a search in a range of frames finds the teeth; see `PictureSearch.run`."""
        begin = search.run(frames, progress, up_world)
        self.start_at(begin.frame, begin.pose)  # again, since the search may have tried other starts after this one
        return begin

    def run(self, frames: range, search: PictureSearch[Array], progress: Progress) -> dict[int, RegionPose]:
        """Return the poses of all frames, from the frame last passed to `start_at`; search where the teeth are lost.

        Raises CaptureError if an image cannot be decoded.
        """
        points, up = self._subject.landmarks[:3], self._subject.T_anatomical_skull[1, :3]

        def again(lost: range, near: RegionPose) -> Begin[RegionPose]:
            self.start_by(search, lost, progress, near.poses[0, :3, :3] @ up)
            return self._begin

        def places(found: RegionPose) -> Array:
            return transform_points(relative_pose(*found.poses), points)

        take = TwoWays(
            frames, places, lambda found: found.objective_px, at_once=True, progress=partial(progress, STAGE)
        )
        self.sampled_views.clear()
        self._wanted = set(np.linspace(frames.start, frames.stop - 1, _SAMPLED_VIEWS).astype(int).tolist())
        begin = self._begin
        take.follow(begin)
        take.recover(again, begin.follow, lambda found: found.fit)
        for frame, least_mm in take.unconfirmed(begin.follow).items():
            take.known[frame] = take.known[frame].unconfirmed(least_mm, points[0])
        return dict(take.known)

    def _walk(self, tracker: RegionTracker, cutter: Cutter, way: range, near: RegionPose) -> Iterator[RegionPose]:
        """Yield the poses of frames in tracking order, starting next to a given pose; keep the views of some frames."""
        latest = deque[Cut](maxlen=1)  # `itertools.tee` would keep up to 57 items in memory

        def cuts() -> Iterator[Cut]:
            for cut in cutter.walk(self._footage, way):
                latest.append(cut)
                yield cut

        for frame, found in zip(way, tracker.follow(cuts(), near.poses), strict=True):
            if frame in self._wanted and found.found.all():
                self._wanted.remove(frame)
                self.sampled_views.append((found.poses, tracker.views(latest[0](found.poses), found.poses)))
            yield found


def track_videos(
    capture: Capture, offsets: dict[str, int], meshes: Mapping[str, Mesh], jobs: int, progress: Progress
) -> Tracks:
    """Track both arches using the colours of the videos of two or more cameras; see `track`, also for errors."""
    cameras, footage = open_colour_footage(capture, offsets, "tracking without masks")
    frames = range(*(capture.frames or footage.range()))
    subject = subject_of_capture(capture, meshes)
    teeth = meshes["upper_teeth"], meshes["lower_teeth"]
    scans = prepare_scan(teeth[0], "upper"), prepare_scan(teeth[1], "lower")
    with ThreadPoolExecutor(jobs) as pool:
        rows = ArchStart(teeth, scans, capture.anatomy.T_anatomical_skull, pool.map)
        follower = Follower(footage, cameras, scans, subject, pool)
        search = PictureSearch(footage, cameras, offsets, rows, follower.start_at)
        if capture.bootstrap is None:
            begin = follower.start_by(search, frames, progress)
        else:
            begin = search.picked(capture.bootstrap, frames)
        followed = follower.run(frames, search, progress)
    tracks = tracks_of(
        followed,
        tuple(cameras.values()),
        scans,
        subject.landmarks,
        subject.T_anatomical_skull[:3, :3],
        follower.sampled_views,
        rest_frame=capture.motion.rest_frame,
        registers=capture.scans.registration == "take",
    )
    tracks.meta["start"] = {"by": begin.by, "frame": begin.frame, "fit": begin.fit}
    findings = [finding.as_json() for finding in (*rows.findings, *footage_findings(tracks))]
    tracks.meta["findings"] = [*tracks.meta.get("findings", []), *findings]
    return tracks


@dataclass(frozen=True)
class VideoOptions:
    """Options of `solve` for shots with images; see `tracking.performance.shot.solve_capture`."""

    fixed_head: bool = False
    free_focal: bool = False
    jobs: int = 2
    skin: SkinOf | None = None


class PreparedTeeth:
    """The scans of a subject, prepared for tracking; `search` finds the teeth in rough masks.

    `axes` is the rotation from scan to anatomical axes (left, up, front), shape (3, 3).
    """

    def __init__(self, capture: Capture, meshes: Mapping[str, Mesh], jaw: JawRig, map_: Mapper) -> None:
        """Prepare the scans, registered as in the rig; raises TrackingError if they are not in occlusion."""
        teeth = meshes["upper_teeth"], meshes["lower_teeth"]
        self.scans = prepare_scan(teeth[0], "upper"), prepare_scan(teeth[1], "lower")
        self.axes = subject_of_capture(capture, meshes).T_anatomical_skull[:3, :3]
        self.search = PictureStart(ArchStart(teeth, self.scans, capture.anatomy.T_anatomical_skull, map_), jaw)


class VideoShot:
    """A shot, opened from the videos of its calibrated cameras."""

    def __init__(
        self,
        capture: Capture,
        cameras: Mapping[str, Camera],
        offsets: Mapping[str, int],
        teeth: PreparedTeeth,
        jaw: JawRig,
        options: VideoOptions,
        progress: Progress,
    ) -> None:
        """Open the videos of calibrated cameras, given by name; raises like `open_videos`."""
        videos = open_videos(capture)
        self._picks, self._teeth, self._progress = capture.bootstrap, teeth, progress
        self.cameras = {name: camera for name, camera in cameras.items() if name in videos}
        self.footage = ColourFootage(videos, offsets)
        shot = PictureShot(
            cuts=self._cuts,
            find=self._again,
            cameras=tuple(self.cameras.values()),
            frames=range(*(capture.frames or self.footage.range())),
            fps=capture.fps,
            fixed_head=options.fixed_head,
            free_focal=options.free_focal,
            skin=options.skin,
        )
        self._frames = shot.frames
        self.take = PictureTake(jaw, teeth.scans, teeth.axes, shot)
        self._search: PictureSearch[Pose] = PictureSearch(
            self.footage, self.cameras, offsets, teeth.search, self.take.begun
        )

    def _cuts(self, placed: Sequence[Camera], centre: Array, frames: range) -> Iterator[Cut]:
        table = {camera.name: camera for camera in placed}
        return Cutter(table, self._teeth.scans, centre).walk(self.footage, frames)

    def begin(self) -> Start[Pose]:
        """Return a start, from picks in at least two cameras or from a frame in which the arches are visibly apart.

        Raises TrackingError if the teeth are not found, and CaptureError if an image cannot be decoded.
        """
        picks = self._picks
        if picks is not None and len(self.cameras) > 1:
            return self._search.picked(picks, self._frames)
        return self._search.run(self._frames, self._progress)

    def _again(self, frames: range, up_world: Array) -> tuple[int, Pose]:
        """Search in frames in which the teeth were lost; see `PictureSearch.run`."""
        begin = self._search.run(frames, self._progress, up_world)
        return begin.frame, begin.pose


def solve_videos(
    capture: Capture,
    cameras: Mapping[str, Camera],
    offsets: dict[str, int],
    meshes: Mapping[str, Mesh],
    jaw: JawRig,
    options: VideoOptions,
    progress: Progress,
) -> Performance:
    """Solve a shot from the videos of its calibrated cameras, given by name; see `solve`, also for errors."""
    with ThreadPoolExecutor(options.jobs) as pool:
        teeth = PreparedTeeth(capture, meshes, jaw, pool.map)
        shot = VideoShot(capture, cameras, offsets, teeth, jaw, options, progress)
        begin = shot.begin()
        found = shot.take.solve(begin.frame, begin.pose, partial(progress, "solve"))
    found.notes["start"] = {"by": begin.by, "frame": begin.frame, "fit": begin.fit}
    found.notes["findings"] = [finding.as_json() for finding in teeth.search.findings]
    return found
