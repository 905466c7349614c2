"""Track captures that have no masks, using the colours of their footage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError
from jawusd.formats.capture import Bootstrap, CameraSource, Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks
from jawusd.pipeline.cameras import open_footage
from jawusd.pipeline.follow import Follower
from jawusd.pipeline.picture_search import PictureSearch, Start, picked_start
from jawusd.pipeline.state import Progress
from jawusd.pipeline.subject import subject_of_capture

if TYPE_CHECKING:
    from jawusd.segmentation.picture import ColourFootage
    from jawusd.tracking.region.picture_start import ArchStart

FEWEST_VIDEOS = 2
# Minimum fraction of the visible contour that matches the colours for picks to be accepted. Six path-traced mouths
# reached 0.26 to 0.5, and three dark, noisy or colourless ones 0.13 to 0.27 with errors up to 0.3 mm. A focal length
# wrong by 15 % gave 0.05, and another subject's lower scan 0.08 and 0.12, with errors above 1 mm.
_LEAST_PICKED_FIT = 0.1


def track_videos(
    capture: Capture, offsets: dict[str, int], meshes: Mapping[str, Mesh], jobs: int, progress: Progress
) -> Tracks:
    """Track both arches using the colours of the videos; see `track`.

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
        search = ArchSearch(capture, offsets, footage, rows, follower)
        begin = search.run(frames, None, progress) if picks is None else _picked_start(rows, follower, picks, frames)
        followed = follower.run(frames, partial(search.run, progress=progress), progress)
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
    """Return a start of tracking from the picks.

    Raises:
        TrackingError: the picks are inconsistent, or do not fit the images.
    """

    def begin() -> tuple[Array, float]:
        found, fit = follower.start_at(picks.frame, rows.picked(picks, follower.cameras))
        return found.poses, fit

    return picked_start(picks.frame, frames, begin, _LEAST_PICKED_FIT)


@dataclass(frozen=True, eq=False)
class ArchSearch:
    """A search for the teeth that starts a follower where they are found.

    Attributes:
        capture, footage: the capture, and the images of its cameras.
        offsets: frame offset by camera.
        rows: search for the arches in rough masks.
        follower: tracker that refines the poses found, and measures their fit.
    """

    capture: Capture
    offsets: Mapping[str, int]
    footage: ColourFootage
    rows: ArchStart
    follower: Follower

    def run(self, frames: range, up_world: Array | None, progress: Progress) -> Start[Array]:
        """Search in a range of frames and start the follower; the pose is T_world_upper, T_world_lower (2, 4, 4).

        `up_world` is the up direction of the head in the world, shape (3,), if it is known.

        Raises:
            TrackingError: the teeth were not found.
            CaptureError: an image cannot be decoded.
        """
        cameras = self.follower.cameras

        def near(sources: Sequence[CameraSource], frame: int) -> Array | None:
            return self.rows.at(sources, cameras, self.offsets, frame)

        def judged(frame: int, poses: Array) -> tuple[Array, float]:
            found, fit = self.follower.start_at(frame, poses)
            return found.poses, fit

        begin = PictureSearch(self.capture, self.footage, cameras, near, judged).run(frames, progress, up_world)
        # Start again: the search may have tried other starts after this one.
        self.follower.start_at(begin.frame, begin.pose)
        return begin
