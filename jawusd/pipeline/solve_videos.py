"""Solve a shot without masks, using the colours of its videos."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.performance import Performance
from jawusd.geometry import Camera
from jawusd.pipeline.cameras import open_videos
from jawusd.pipeline.picture_search import PictureSearch, Start
from jawusd.pipeline.state import Progress
from jawusd.pipeline.subject import subject_of_capture
from jawusd.pipeline.track_videos import Cutter
from jawusd.segmentation.picture import ColourFootage
from jawusd.tracking.config import Mapper
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.performance.coordinates import Pose
from jawusd.tracking.performance.skin import SkinOf
from jawusd.tracking.region.appearance import Cut
from jawusd.tracking.region.performance import PictureShot, PictureTake
from jawusd.tracking.region.picture_start import PictureStart


@dataclass(frozen=True)
class VideoOptions:
    """Options of `solve` for shots with images; see `tracking.performance.shot.solve_capture`."""

    fixed_head: bool = False
    free_focal: bool = False
    jobs: int = 2
    skin: SkinOf | None = None


class PreparedTeeth:
    """The scans of a subject, prepared for tracking.

    Attributes:
        axes: rotation from scan to anatomical axes (left, up, front), shape (3, 3).
        search: finds the teeth in rough masks.
    """

    def __init__(self, capture: Capture, meshes: Mapping[str, Mesh], jaw: JawRig, map_: Mapper) -> None:
        """Prepare the scans, registered as in the rig; raises TrackingError if they are not in occlusion."""
        teeth = meshes["upper_teeth"], meshes["lower_teeth"]
        self.scans = prepare_scan(teeth[0], "upper"), prepare_scan(teeth[1], "lower")
        self.axes = subject_of_capture(capture, meshes).T_anatomical_skull[:3, :3]
        self.search = PictureStart(teeth, self.scans, jaw, capture.anatomy.T_anatomical_skull, map_)


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
        """Open the videos of calibrated cameras, given by name.

        Raises:
            CaptureError: no camera has a video, or one cannot be decoded.
        """
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

        Raises:
            TrackingError: the teeth were not found.
            CaptureError: an image cannot be decoded.
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
    """Solve a shot from the videos of its calibrated cameras, given by name; see `solve`.

    Raises:
        CaptureError: no camera has a video, or one cannot be decoded.
        TrackingError: the teeth were not found.
    """
    with ThreadPoolExecutor(options.jobs) as pool:
        teeth = PreparedTeeth(capture, meshes, jaw, pool.map)
        shot = VideoShot(capture, cameras, offsets, teeth, jaw, options, progress)
        begin = shot.begin()
        found = shot.take.solve(begin.frame, begin.pose, partial(progress, "solve"))
    found.notes["start"] = {"by": begin.by, "frame": begin.frame, "fit": begin.fit}
    found.notes["findings"] = [finding.as_json() for finding in teeth.search.findings]
    return found
