"""The masks of a take before anything is known about the teeth, and where tracking begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jawusd.errors import TrackingError
from jawusd.formats.capture import CameraSource
from jawusd.geometry import Camera
from jawusd.geometry.arrays import Array
from jawusd.tracking.mask_geometry import MaskSurvey, survey_masks
from jawusd.tracking.views import MaskViews


@dataclass(frozen=True, eq=False)
class Start:
    """Say where tracking begins.

    Attributes:
        frame: reference camera frame.
        poses: T_world_upper, T_world_lower, shape (2, 4, 4).
        notes: how it was found, for the meta data of the tracks.
    """

    frame: int
    poses: Array
    notes: dict


@dataclass(frozen=True, eq=False)
class Footage:
    """Name the masks to be tracked.

    Attributes:
        sources: cameras with masks.
        cameras: calibrated cameras by name.
        offsets: reference frame minus own frame number, by camera name.
        frames: first frame and one past the last, or None for all that have masks.
    """

    sources: Sequence[CameraSource]
    cameras: Mapping[str, Camera]
    offsets: Mapping[str, int]
    frames: tuple[int, int] | None

    def survey(self, frames: tuple[int, int] | None, count: int) -> MaskSurvey:
        """Look at evenly spread frames, of the whole footage if no range is given."""
        return survey_masks(self.sources, self.cameras, self.offsets, frames or self.frames, count)

    def views(self, centre: Array, px_per_mm: float) -> MaskViews:
        """Open the masks at a resolution at the teeth, which are near a world point [mm], shape (3,)."""
        return MaskViews(self.sources, self.cameras, self.offsets, centre, px_per_mm)

    def has_masks(self, frame: int) -> bool:
        """Tell whether both rows have masks in two cameras on a frame."""
        try:
            self.survey((frame, frame + 1), 1)
        except TrackingError:
            return False
        return True
