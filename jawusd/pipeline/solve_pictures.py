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
    from jawusd.tracking.config import Mapper
    from jawusd.tracking.performance.coordinates import Pose
    from jawusd.tracking.region.performance import PictureTake
    from jawusd.tracking.region.picture import Cut
    from jawusd.tracking.region.picture_start import PictureStart

# Frames looked at for rows that are apart: every so-many-th, in parts of the shot; starts tried in a part.
_EVERY, _PART, _TRIED = 8, 240, 4
#: How much rows of teeth may be bridged to count as apart: of 64 pictures of eight mouths, those below were all parted
#: rightly.
MOST_BRIDGED = 0.1
#: Share of the contour in sight that fits colours, below which a start is none: of 20 starts found in one take, all but
#: one within half a millimetre, it was 0.19 to 0.48. From the others on, with several cameras and with one, whose depth
#: may be wrong, it is taken at once.
LEAST_FIT, _CLEAR_FIT, _CLEAR_FIT_SINGLE = 0.15, 0.25, 0.4


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
class Begin:
    """Say where to begin, how much of the contour fits there, and how it was found."""

    frame: int
    pose: Pose
    fit: float
    by: str


class PreparedTeeth:
    """Prepare the scans of a person.

    Attributes:
        scans: upper and lower teeth.
        axes: rotation from scan to anatomical axes: left, up, front; shape (3, 3).
        search: finds them in pictures.
    """

    def __init__(self, capture: Capture, meshes: Mapping[str, Mesh], jaw: JawRig, map_: Mapper) -> None:
        """Take the scans of a capture, as the rig knows them; `map_` runs parts of searches.

        Raises:
            TrackingError: the scans cannot be in occlusion.
        """
        from jawusd.tracking.contour.scan import prepare_scan
        from jawusd.tracking.region.picture_start import PictureStart

        teeth = meshes["upper_teeth"], meshes["lower_teeth"]
        self.scans = prepare_scan(teeth[0], "upper"), prepare_scan(teeth[1], "lower")
        self.axes = subject_of_capture(capture, meshes).T_anatomical_skull[:3, :3]
        self.search = PictureStart(teeth, self.scans, jaw, capture.anatomy.T_anatomical_skull, map_)


class VideoShot:
    """Open a shot from the videos of its cameras.

    Attributes:
        cameras: calibrated, those that have a video, by name.
        footage: their pictures.
        take: follows the teeth.
    """

    def __init__(
        self,
        capture: Capture,
        cameras: Mapping[str, Camera],
        offsets: Mapping[str, int],
        teeth: PreparedTeeth,
        jaw: JawRig,
        options: VideoOptions,
    ) -> None:
        """Open the videos of calibrated cameras, by name.

        Raises:
            CaptureError: no camera has a video, or one cannot be decoded.
        """
        from jawusd.segmentation.footage import ColourFootage
        from jawusd.tracking.region.performance import PictureShot, PictureTake

        videos = open_videos(capture)
        self._capture, self._offsets, self._teeth = capture, offsets, teeth
        self.cameras = {name: camera for name, camera in cameras.items() if name in videos}
        self.footage = ColourFootage(videos, offsets)
        shot = PictureShot(
            cuts=self._cuts,
            cameras=tuple(self.cameras.values()),
            frames=range(*(capture.frames or self.footage.range())),
            fps=capture.fps,
            fixed_head=options.fixed_head,
            free_focal=options.free_focal,
        )
        self._frames = shot.frames
        self.take = PictureTake(jaw, teeth.scans, teeth.axes, shot)

    def _cuts(self, placed: Sequence[Camera], centre: Array, frames: range) -> Iterator[Cut]:
        table = {camera.name: camera for camera in placed}
        return Cutter(table, self._teeth.scans, centre).walk(self.footage, frames)

    def begin(self, progress: Progress) -> Begin:
        """Return where to begin: at picks in two cameras or more, or on a frame on which both rows of teeth are apart.

        Raises:
            TrackingError: the teeth were not found.
            CaptureError: a picture cannot be decoded.
        """
        if self._capture.bootstrap is not None and len(self.cameras) > 1:
            return self._picked(self._capture.bootstrap)
        search = _Search(self._capture, self.cameras, self._offsets, self.footage, self.take, self._teeth.search)
        return search.run(self._frames, progress)

    def _picked(self, bootstrap: Bootstrap) -> Begin:
        """Return where the teeth are picked."""
        if bootstrap.frame not in self._frames:
            first, last = self._frames[0], self._frames[-1]
            raise TrackingError(f"bootstrap.frame is {bootstrap.frame}, frames run from {first} to {last}")
        pose, fit = self.take.begun(bootstrap.frame, self._teeth.search.picked(bootstrap, self.cameras))
        if fit < LEAST_FIT:
            raise TrackingError(
                f"the teeth are not seen where they are picked: {fit:.0%} of the contour in sight fits the colours, at "
                f"least {LEAST_FIT:.0%} is needed",
                frame=bootstrap.frame,
                hint="Check the picks, and that rig, scans and calibration are those of this person and these cameras.",
            )
        return Begin(bootstrap.frame, pose, fit, "picks")


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
    with ThreadPoolExecutor(options.jobs) as pool:
        teeth = PreparedTeeth(capture, meshes, jaw, pool.map)
        shot = VideoShot(capture, cameras, offsets, teeth, jaw, options)
        begin = shot.begin(progress)
        found = shot.take.solve(begin.frame, begin.pose, partial(progress, "solve"))
    found.notes["start"] = {"by": begin.by, "frame": begin.frame, "fit": begin.fit}
    found.notes["findings"] = [finding.as_json() for finding in teeth.search.findings]
    return found


@dataclass(frozen=True, eq=False)
class _Search:
    """Search the teeth on frames on which both rows are apart."""

    capture: Capture
    cameras: Mapping[str, Camera]
    offsets: Mapping[str, int]
    footage: ColourFootage
    take: PictureTake
    search: PictureStart

    def run(self, frames: range, progress: Progress) -> Begin:
        """Return the first start that fits clearly, or the best one of a part of the shot.

        Raises:
            TrackingError: none fits.
        """
        best: Begin | None = None
        tried: list[int] = []
        for part in (frames[k : k + _PART] for k in range(0, len(frames), _PART)):
            looks = sorted(self._looks(part, progress), key=lambda look: look.bridged)
            for look in looks[:_TRIED]:
                tried.append(look.frame)
                found = self._at(look)
                if found is not None and (best is None or found.fit > best.fit):
                    best = found
                if best is not None and best.fit >= (_CLEAR_FIT if len(self.cameras) > 1 else _CLEAR_FIT_SINGLE):
                    return best
            if best is not None and best.fit >= LEAST_FIT:
                return best
        fit = (
            "" if best is None else f"; at best {best.fit:.0%} of the contour in sight fits, {LEAST_FIT:.0%} is needed"
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
            apart = {name: row for name, row in rows.items() if row is not None and row.bridged <= MOST_BRIDGED}
            if len(apart) >= min(2, len(self.cameras)):
                out.append(_Look(frame, apart))
            progress("start", done, len(chosen))
        return out

    def _at(self, look: _Look) -> Begin | None:
        numbers = {name: look.frame - self.offsets[name] for name in look.rows}
        with tempfile.TemporaryDirectory() as folder:
            masked = masked_cameras(self.capture, look.rows, numbers, Path(folder))
            near = self.search.at(masked, self.cameras, self.offsets, look.frame)
        if near is None:
            return None
        return Begin(look.frame, *self.take.begun(look.frame, near), "search")


def masked_cameras(
    capture: Capture, rows: Mapping[str, Rows], numbers: Mapping[str, int], folder: Path
) -> list[CameraSource]:
    """Return cameras with rows of teeth as masks, which are written to a folder under the cameras' own numbers.

    Raises:
        OutputError: a mask cannot be written.
    """
    from jawusd.segmentation.files import ARCHES, mask_path, write_mask

    for name, found in rows.items():
        for arch, mask in zip(ARCHES, found.masks, strict=True):
            write_mask(mask_path(folder, name, arch, numbers[name]), mask)
    return [camera for camera in with_masks(capture, folder).cameras if camera.name in rows]
