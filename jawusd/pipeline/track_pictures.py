"""Track a capture from its videos alone, without masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError
from jawusd.formats.capture import Bootstrap, CameraSource, Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks
from jawusd.pipeline.follow import Follower
from jawusd.pipeline.media import open_footage
from jawusd.pipeline.picture_search import Begin, PictureSearch, outside, unseen_picks
from jawusd.pipeline.state import Progress
from jawusd.pipeline.subject import subject_of_capture

if TYPE_CHECKING:
    from jawusd.segmentation.picture import ColourFootage
    from jawusd.tracking.region.picture_start import ArchStart

FEWEST_VIDEOS = 2
# Share of the contour in sight that fits colours, below which teeth are not where they are picked: of six path-traced
# mouths it was 0.26 to 0.5, of three of them in the dark, with noise or without colours 0.13 to 0.27, and these were
# tracked to 0.3 mm. With focal lengths 15 % off it was 0.05, with another person's lower scan 0.08 and 0.12, and these
# were a millimetre off and more.
_LEAST_PICKED_FIT = 0.1


def track_videos(
    capture: Capture, offsets: dict[str, int], meshes: Mapping[str, Mesh], jobs: int, progress: Progress
) -> Tracks:
    """Track both arches by the colours of the videos; see `track`.

    Args:
        offsets: frame offset by camera.
        meshes: of the capture, labelled.

    Raises:
        CaptureError: fewer than two cameras have a video, or one cannot be decoded.
        TrackingError: the teeth were not found.
    """
    from jawusd.segmentation.picture import ColourFootage
    from jawusd.tracking.contour.scan import prepare_scan
    from jawusd.tracking.region.picture_start import ArchStart
    from jawusd.tracking.region.take import TakeFacts, footage_doubts, tracks_of

    cameras, videos = open_footage(capture)
    if len(videos) < FEWEST_VIDEOS:
        raise CaptureError(
            f"{len(videos)} of {len(capture.cameras)} cameras have a video; without masks, {FEWEST_VIDEOS} at least "
            "are needed.",
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
    tracks = tracks_of(followed, facts, follower.looks)
    tracks.meta["start"] = {"by": begin.by, "frame": begin.frame, "fit": begin.fit}
    findings = [finding.as_json() for finding in (*rows.findings, *footage_doubts(tracks))]
    tracks.meta["findings"] = [*tracks.meta.get("findings", []), *findings]
    return tracks


def _picked_start(rows: ArchStart, follower: Follower, picks: Bootstrap, frames: range) -> Begin[Array]:
    """Return where the teeth are picked.

    Raises:
        TrackingError: the picks cannot be, or do not fit what is seen.
    """
    if picks.frame not in frames:
        raise outside(picks.frame, frames)
    found, fit = follower.begun(picks.frame, rows.picked(picks, follower.cameras))
    if fit < _LEAST_PICKED_FIT:
        raise unseen_picks(picks.frame, fit, _LEAST_PICKED_FIT)
    return Begin(picks.frame, found.poses, fit, "picks")


def searched_start(
    capture: Capture,
    offsets: Mapping[str, int],
    footage: ColourFootage,
    rows: ArchStart,
    follower: Follower,
    frames: range,
    progress: Progress,
) -> Begin[Array]:
    """Return where a search finds the teeth, T_world_upper and T_world_lower (2, 4, 4); the follower has begun there.

    Raises:
        TrackingError: nowhere.
        CaptureError: a picture cannot be decoded.
    """

    def near(sources: Sequence[CameraSource], frame: int) -> Array | None:
        return rows.at(sources, follower.cameras, offsets, frame)

    def judged(frame: int, poses: Array) -> tuple[Array, float]:
        found, fit = follower.begun(frame, poses)
        return found.poses, fit

    search = PictureSearch(capture, footage, len(follower.cameras), near, judged)
    begin = search.run(frames, progress)
    follower.begun(begin.frame, begin.pose)  # the last one tried may have been another
    return begin
