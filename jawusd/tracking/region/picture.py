"""A part of a picture around the teeth, and the first colours that it teaches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from jawusd.base.arrays import Array
from jawusd.geometry import Camera
from jawusd.tracking.contour.scan import ARCHES, CROWN, GUM, Scan
from jawusd.tracking.region.colours import Areas, CameraColours, colour_bins

# Areas that teach the first colours [px]: inside crowns, outside of them, ring around them, beyond all.
_INSIDE_PX, _OUTSIDE_PX, _RING_PX, _BEYOND_PX = 2.0, 3.0, 30.0, 4.0


class Picture(NamedTuple):
    """Hold a part of an undistorted picture around the teeth."""

    camera: Camera  # the pinhole camera of the part
    rgb: NDArray[np.uint8]  # shape (h, w, 3)


#: Cuts the pictures of an instant, one per camera or None, around T_world_upper and T_world_lower, shape (2, 4, 4).
Cut = Callable[[Array], Sequence[Picture | None]]


def first_colours(picture: Picture, poses: Array, scans: Sequence[Scan]) -> CameraColours:
    """Return the colours of a picture in which the scans have poses T_world_upper and T_world_lower (2, 4, 4)."""
    shape = picture.rgb.shape[:2]
    labels = np.zeros((2, *shape), np.uint8)
    for r in ARCHES:
        matrix = picture.camera.projection_matrix() @ poses[r]
        scans[r].draw(matrix, np.zeros(shape, np.float32), labels[r])
    crowns, gum = (labels == CROWN).any(0), (labels == GUM).any(0)
    to_crown, to_any = (distance_transform_edt(~area) for area in (crowns, crowns | gum))
    inside = distance_transform_edt(crowns) > _INSIDE_PX
    outside = to_crown > _OUTSIDE_PX
    near = outside & (to_crown < _RING_PX)
    return CameraColours(colour_bins(picture.rgb), Areas(inside, near, near & gum, to_any > _BEYOND_PX))
