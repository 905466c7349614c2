"""Bring teeth that were out of sight back near their masks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import transform_point
from jawusd.meshes.raster import unpack_bits
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.contour.views import View


def shift_to_masks(scan: Scan, pose: Array, arch: int, views: Sequence[View], use: Mask) -> Array:
    """Return the translation across the line of sight that brings the crowns' middle onto that of their masks [mm].

    Lips hide the back teeth, and others in every view, so the depth found would be wrong by a centimetre or two: it
    is left alone. Across, the result is good to a few millimetres: enough for a search to start from.

    `pose` is T_world_scan, `use` tells the masks to be used, shape (2, C). Zero without a mask.
    """
    centre = np.append(transform_point(pose, scan.centre), 1.0)
    H, g, sight = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for view in (view for view, used in zip(views, use[arch], strict=True) if used):
        height, width = view.masks.shape[1:]
        # Three pictures wide and high: what is to be brought near may lie off the picture.
        bits = scan.silhouette(view.matrix @ view.T_delay[arch] @ pose, (3 * height, 3 * width), -width, -height)
        crowns, mask = unpack_bits(bits, 3 * width), view.masks[arch] > 127
        depth = view.matrix[2] @ centre
        if depth <= 0 or not crowns.any() or not mask.any():
            continue
        pixel = view.matrix[:2] @ centre / depth
        slope = (view.matrix[:2, :3] - pixel[:, None] * view.matrix[2, :3]) / depth
        miss = _middle(mask) - (_middle(crowns) - [width, height])
        H += slope.T @ slope
        g += slope.T @ miss
        sight += (centre[:3] - view.eye) / np.linalg.norm(centre[:3] - view.eye)
    if not sight.any():
        return np.zeros(3)
    across = np.linalg.svd(sight[None])[2][1:]  # two directions normal to the mean line of sight
    return across.T @ np.linalg.solve(across @ H @ across.T, across @ g)


def _middle(picture: Mask) -> Array:
    """Return the mean position (x, y) of the set pixels, shape (2,)."""
    rows, columns = np.nonzero(picture)
    return np.array([columns.mean(), rows.mean()])
