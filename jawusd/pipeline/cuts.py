"""Parts of the footage around the teeth, frame after frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import Camera, transform_points

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from jawusd.segmentation.picture import ColourFootage, PictureFrame, Pictures
    from jawusd.tracking.config import Mapper
    from jawusd.tracking.contour.scan import Scan
    from jawusd.tracking.region.appearance import Cut, Picture

_WORKING_PX_PER_MM, _MARGIN_MM = 7.2, 6.0  # resolution at the teeth, and what is looked at around them


class Cutter:
    """Cut what surrounds the teeth out of the pictures of all cameras."""

    def __init__(
        self, cameras: Mapping[str, Camera], scans: Sequence[Scan], centre: Array, executor: Executor | None = None
    ) -> None:
        """Choose the working size.

        Args:
            cameras: calibrated, by name.
            scans: upper and lower.
            centre: where the teeth are about, in the world [mm], shape (3,).
            executor: threads that prepare the pictures of all cameras side by side.
        """
        from jawusd.segmentation.picture import PictureFrame

        self._frames: dict[str, PictureFrame] = {
            name: PictureFrame(camera, centre, _WORKING_PX_PER_MM) for name, camera in cameras.items()
        }
        self._map: Mapper = executor.map if executor else map
        self._probes = [scan.probes for scan in scans]

    def cut(self, pictures: Pictures) -> Cut:
        """Return what cuts the pictures of an instant around poses."""

        def cut(poses: Array) -> list[Picture | None]:
            around = np.concatenate([transform_points(T, own) for T, own in zip(poses, self._probes, strict=True)])
            return list(self._map(lambda name: self._one(name, pictures, around), self._frames))

        return cut

    def walk(self, footage: ColourFootage, frames: range) -> Iterator[Cut]:
        """Yield what cuts the pictures of frame after frame.

        Raises:
            CaptureError: a picture cannot be decoded.
        """
        return (self.cut(pictures) for _, pictures in footage.walk(frames))

    def _one(self, name: str, pictures: Pictures, around: Array) -> Picture | None:
        from jawusd.tracking.region.appearance import Picture

        image = pictures[name]
        window = None if image is None else self._frames[name].window(image, around, _MARGIN_MM)
        return None if window is None else Picture(window.camera, window.rgb)
