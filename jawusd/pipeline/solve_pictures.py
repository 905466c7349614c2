"""Solve a performance from the videos of a shot, without masks."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from jawusd.errors import TrackingError
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Bootstrap, CameraSource, Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.performance import Performance
from jawusd.geometry import Camera
from jawusd.geometry.arrays import Array
from jawusd.pipeline.cuts import Cutter
from jawusd.pipeline.media import open_videos
from jawusd.pipeline.prepare import subject_of_capture
from jawusd.pipeline.segment import with_masks
from jawusd.pipeline.state import Progress

if TYPE_CHECKING:
    from jawusd.segmentation.footage import ColourFootage
    from jawusd.segmentation.rows import Rows
    from jawusd.tracking.performance.coordinates import Pose
    from jawusd.tracking.region.performance import PictureTake
    from jawusd.tracking.region.picture import Cut
    from jawusd.tracking.region.picture_start import PictureStart

# Frames looked at for rows that are apart: every so-many-th, in parts of the shot; starts tried in a part. Of 64
# pictures of eight mouths, rows bridged by less than the limit were all parted rightly.
_EVERY, _PART, _TRIED, _MOST_BRIDGED = 8, 240, 4, 0.1
# Share of the contour in sight that fits colours, from which a start is taken at once, and below which it is none: of
# 20 starts found in one take, all but one within half a millimetre, it was 0.19 to 0.48.
_CLEAR_FIT, _LEAST_FIT = 0.4, 0.15


@dataclass(frozen=True)
class VideoOptions:
    """Choose how to solve; see `solve`."""

    fixed_head: bool = False
    free_focal: bool = False
    jobs: int = 2


@dataclass(frozen=True, eq=False)
class _Look:
    """Hold the rows of teeth that the cameras show on a frame."""

    frame: int
    rows: Mapping[str, Rows]

    @property
    def bridged(self) -> float:
        """The worst camera's share of line between the rows that is no gap."""
        return max(rows.bridged for rows in self.rows.values())


@dataclass(frozen=True, eq=False)
class _Begin:
    """Say where to begin, how much of the contour fits there, and how it was found."""

    frame: int
    pose: Pose
    fit: float
    by: str


def solve_videos(
    capture: Capture,
    cameras: Mapping[str, Camera],
    offsets: dict[str, int],
    meshes: Mapping[str, Mesh],
    jaw: JawRig,
    options: VideoOptions,
    progress: Progress,
) -> Performance:
    """Solve a shot from the videos of its cameras, which are calibrated, by name; see `solve`.

    Raises:
        CaptureError: no camera has a video, or one cannot be decoded.
        TrackingError: the teeth were not found.
    """
    from jawusd.segmentation.footage import ColourFootage
    from jawusd.tracking.contour.scan import prepare_scan
    from jawusd.tracking.region.performance import PictureShot, PictureTake
    from jawusd.tracking.region.picture_start import PictureStart

    videos = open_videos(capture)
    cameras = {name: camera for name, camera in cameras.items() if name in videos}
    footage = ColourFootage(videos, offsets)
    teeth = meshes["upper_teeth"], meshes["lower_teeth"]
    scans = prepare_scan(teeth[0], "upper"), prepare_scan(teeth[1], "lower")

    def cuts(placed: Sequence[Camera], centre: Array, frames: range) -> Iterator[Cut]:
        return Cutter({camera.name: camera for camera in placed}, scans, centre).walk(footage, frames)

    shot = PictureShot(
        cuts=cuts,
        cameras=tuple(cameras.values()),
        frames=range(*(capture.frames or footage.range())),
        fps=capture.fps,
        fixed_head=options.fixed_head,
        free_focal=options.free_focal,
    )
    take = PictureTake(jaw, scans, subject_of_capture(capture, meshes).T_anatomical_skull[:3, :3], shot)
    with ThreadPoolExecutor(options.jobs) as pool:
        search = PictureStart(teeth, scans, jaw, capture.anatomy.T_anatomical_skull, pool.map)
        if capture.bootstrap is not None and len(cameras) > 1:
            begin = _picked(capture.bootstrap, cameras, shot.frames, take, search)
        else:
            begin = _Search(capture, cameras, offsets, footage, take, search).run(shot.frames, progress)
    found = take.solve(begin.frame, begin.pose, partial(progress, "solve"))
    found.notes["start"] = {"by": begin.by, "frame": begin.frame, "fit": begin.fit}
    found.notes["findings"] = [finding.as_json() for finding in search.findings]
    return found


def _picked(
    bootstrap: Bootstrap, cameras: Mapping[str, Camera], frames: range, take: PictureTake, search: PictureStart
) -> _Begin:
    """Return where the teeth are picked."""
    if bootstrap.frame not in frames:
        raise TrackingError(f"bootstrap.frame is {bootstrap.frame}, frames run from {frames[0]} to {frames[-1]}")
    pose, fit = take.begun(bootstrap.frame, search.picked(bootstrap, cameras))
    if fit < _LEAST_FIT:
        raise TrackingError(
            f"the teeth are not seen where they are picked: {fit:.0%} of the contour in sight fits the colours, at "
            f"least {_LEAST_FIT:.0%} is needed",
            frame=bootstrap.frame,
            hint="Check the picks, and that rig, scans and calibration are those of this person and these cameras.",
        )
    return _Begin(bootstrap.frame, pose, fit, "picks")


@dataclass(frozen=True, eq=False)
class _Search:
    """Search the teeth on frames on which both rows are apart."""

    capture: Capture
    cameras: Mapping[str, Camera]
    offsets: Mapping[str, int]
    footage: ColourFootage
    take: PictureTake
    search: PictureStart

    def run(self, frames: range, progress: Progress) -> _Begin:
        """Return the first start that fits clearly, or the one that fits best.

        Raises:
            TrackingError: none fits.
        """
        best: _Begin | None = None
        tried: list[int] = []
        for part in (frames[k : k + _PART] for k in range(0, len(frames), _PART)):
            looks = sorted(self._looks(part, progress), key=lambda look: look.bridged)
            for look in looks[:_TRIED]:
                tried.append(look.frame)
                found = self._at(look)
                if found is not None and (best is None or found.fit > best.fit):
                    best = found
                if best is not None and best.fit >= _CLEAR_FIT:
                    return best
        if best is not None and best.fit >= _LEAST_FIT:
            return best
        fit = (
            "" if best is None else f"; at best {best.fit:.0%} of the contour in sight fits, {_LEAST_FIT:.0%} is needed"
        )
        raise TrackingError(
            f"the teeth were not found on {len(tried)} frames that show both rows apart{fit}",
            hint="Check that the rig is of this person; let the shot show both rows of teeth apart and upright for a "
            "moment, pick teeth in two cameras ([bootstrap]), or draw masks.",
        )

    def _looks(self, part: range, progress: Progress) -> list[_Look]:
        """Return the frames of a part of the shot on which enough cameras show the rows apart."""
        from jawusd.segmentation.rows import tooth_rows

        out, chosen = [], part[::_EVERY]
        for done, (frame, pictures) in enumerate(self.footage.walk(chosen), start=1):
            rows = {name: tooth_rows(image) for name, image in pictures.items() if image is not None}
            apart = {name: row for name, row in rows.items() if row is not None and row.bridged <= _MOST_BRIDGED}
            if len(apart) >= min(2, len(self.cameras)):
                out.append(_Look(frame, apart))
            progress("start", done, len(chosen))
        return out

    def _at(self, look: _Look) -> _Begin | None:
        with tempfile.TemporaryDirectory() as folder:
            near = self.search.at(self._masked(look, Path(folder)), self.cameras, self.offsets, look.frame)
        if near is None:
            return None
        return _Begin(look.frame, *self.take.begun(look.frame, near), "search")

    def _masked(self, look: _Look, folder: Path) -> Sequence[CameraSource]:
        """Return the cameras of a look with its rows as masks, which are written to a folder."""
        from jawusd.segmentation.files import ARCHES, mask_path, write_mask

        for name, rows in look.rows.items():
            own = self.footage.own(name, look.frame)
            if own is not None:
                for arch, mask in zip(ARCHES, rows.masks, strict=True):
                    write_mask(mask_path(folder, name, arch, own), mask)
        return [camera for camera in with_masks(self.capture, folder).cameras if camera.name in look.rows]
