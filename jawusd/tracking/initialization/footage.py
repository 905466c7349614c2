"""Survey of the masks before tracking: their positions and sizes, and the frames in which they are largest."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.capture import CameraSource
from jawusd.geometry import Camera, triangulate
from jawusd.media.masks import open_masks
from jawusd.media.working_view import WorkingView
from jawusd.tracking.contour.views import FEWEST_CAMERAS, MaskSource, MaskViews, masked_frames

_BESIDE = 2  # number of surveyed frames on either side of a chosen frame to skip as redundant
# Maximum ratio of the area of a plausible mask to that of masks known to be correct: an opening mouth shows more teeth.
_MOST_AREA = 5.0
_WIDTH_PX = 320  # width of the surveyed mask images [px]: enough for mask centres accurate to 0.1 mm


@dataclass(frozen=True, eq=False)
class Footage:
    """The masks to be tracked: cameras with masks, and the range of frames (end exclusive; None for all frames).

    `offsets` are time offsets by camera name: the reference frame number minus the camera's own frame number.
    """

    sources: Sequence[MaskSource]
    cameras: Mapping[str, Camera]
    offsets: Mapping[str, int]
    frames: tuple[int, int] | None
    fewest: int = FEWEST_CAMERAS  # minimum number of cameras with masks of both arches

    @property
    def files(self) -> list[CameraSource]:
        """The cameras whose masks are files."""
        return [source for source in self.sources if isinstance(source, CameraSource)]

    def without_each_camera(self) -> Iterator[tuple[str, Footage]]:
        """Yield the name of each camera, and the footage of the others; nothing with fewer than three cameras."""
        for source in self.sources if len(self.sources) >= 3 else ():
            yield source.name, replace(self, sources=[other for other in self.sources if other is not source])

    def survey(self, frames: tuple[int, int] | None, count: int) -> MaskSurvey:
        """Measure the masks of at most `count` evenly spaced frames, by default from the whole footage.

        Raises:
            TrackingError: no surveyed frame has masks of both arches in enough cameras.
            CaptureError: a mask cannot be read.
        """
        with ExitStack() as stack:
            working, readers = [], []
            for source in self.sources:
                camera = self.cameras[source.name]
                width, height = camera.size_px
                scale = min(1.0, _WIDTH_PX / max(width, height))
                view = WorkingView(camera, (max(1, round(width * scale)), max(1, round(height * scale))))
                working.append(view)
                opened = open_masks(source, camera.size_px, prepare=view.mask)
                readers.append([stack.enter_context(reader) for reader in opened])
            shifts = [self.offsets[source.name] for source in self.sources]
            first, stop = frames or self.frames or masked_frames(shifts, readers)
            chosen = np.unique(np.linspace(first, stop - 1, min(count, stop - first)).round().astype(np.int64))
            middles = np.full((len(chosen), 2, len(self.sources), 2), np.nan)
            areas = np.zeros((len(chosen), 2, len(self.sources)))
            for f, c, r in np.ndindex(len(chosen), len(self.sources), 2):
                mask = readers[c][r].read(int(chosen[f]) - shifts[c])
                if mask is not None and (area := float(mask.sum(dtype=np.float64)) / 255.0) > 1.0:
                    rows, columns = mask.sum(1, dtype=np.float64), mask.sum(0, dtype=np.float64)
                    middles[f, r, c] = [
                        columns @ np.arange(len(columns)) / columns.sum(),
                        rows @ np.arange(len(rows)) / rows.sum(),
                    ]
                    areas[f, r, c] = area
        if not ((areas > 0).sum(-1) >= self.fewest).all(-1).any():
            raise TrackingError(
                f"none of {len(chosen)} frames sampled from {chosen[0]} to {chosen[-1]} has masks of both arches "
                f"in {self.fewest} camera{'s' if self.fewest > 1 else ''}",
                hint="Segment some frames in every camera, or add [bootstrap] picks on a segmented frame.",
            )
        matrices = np.stack([view.camera.projection_matrix() for view in working])
        eyes = np.stack([view.camera.centre_world() for view in working])
        return MaskSurvey(chosen, middles, areas, matrices, eyes, self.fewest)

    def views(self, centre: Array, px_per_mm: float) -> MaskViews:
        """Open the masks, scaled to a given resolution at the teeth, which are near world point `centre` (3,) [mm]."""
        return MaskViews(self.sources, self.cameras, self.offsets, centre, px_per_mm, self.fewest)

    def has_masks(self, frame: int) -> bool:
        """Return whether both arches have masks in enough cameras on a frame."""
        try:
            self.survey((frame, frame + 1), 1)
        except TrackingError:
            return False
        return True


@dataclass(frozen=True, eq=False)
class MaskSurvey:
    """Centres and areas of the masks of the surveyed frames."""

    frames: NDArray[np.int64]  # frame numbers of the reference camera, shape (F,)
    # mean position (x, y) of every mask in its undistorted survey image [px], NaN without a mask, shape (F, 2, C, 2);
    # axis 1 is (upper, lower)
    middles: Array
    areas_px: Array  # area of every mask [px], shape (F, 2, C); 0 without a mask
    matrices: Array  # world [mm] to homogeneous px of the survey images, shape (C, 3, 4)
    eyes: Array  # camera centres in world coordinates [mm], shape (C, 3)
    fewest: int = FEWEST_CAMERAS  # minimum number of cameras with masks of both arches

    def places(self) -> Array:
        """Return the triangulated mask centres in the world [mm], NaN with fewer than two masks, shape (F, 2, 3)."""
        out = np.full((len(self.frames), 2, 3), np.nan)
        for f, r in np.ndindex(out.shape[:2]):
            seen = self.areas_px[f, r] > 0
            if seen.sum() >= 2:
                out[f, r] = triangulate(self.matrices[seen], self.middles[f, r, seen])
        return out

    def promising(self, count: int, usual_px: Array | None = None) -> NDArray[np.int64]:
        """Return at most `count` frames with large masks of both arches in all cameras, the best first.

        Areas are clipped at their 90 % quantile, since larger masks may be wrong. Neighbouring frames are redundant, so
        they come after all others. Masks far larger than `usual_px`, the areas of correct masks (2, C), count as
        missing.
        """
        areas_px = self.areas_px
        if usual_px is not None:
            areas_px = np.where(areas_px > _MOST_AREA * usual_px, 0.0, areas_px)
        full = np.maximum(np.quantile(areas_px, 0.9, axis=0), 1.0)
        shown = np.sqrt(np.minimum(areas_px / full, 1.0)).sum(-1).min(-1)
        usable = ((areas_px > 0).sum(-1) >= self.fewest).all(-1)
        apart: list[int] = []
        beside: list[int] = []
        for f in np.argsort(-shown, kind="stable").tolist():
            if usable[f]:
                (beside if any(abs(f - g) <= _BESIDE for g in apart) else apart).append(f)
        return self.frames[[*apart, *beside][:count]]
