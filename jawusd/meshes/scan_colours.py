"""Crown or gum by the natural colours of a scan: gum is redder than enamel, whatever the light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.meshes.scan_surface import ScanSurface
from jawusd.meshes.scan_tops import Tops

# Colours are used where the redness of the highest places and of places far from them differs by so many of its
# standard deviations there; stone casts and untextured scans stay below.
_LEAST_CONTRAST = 4.0
_FAR_BELOW_MM = 9.0  # below the highest place around, few crowns go on
_FEWEST = 50  # vertices of either kind
_GRAIN = 0.003  # of 8 bit colours


def crown_by_colour(colors: NDArray[np.uint8], surface: ScanSurface, seen: Tops) -> Array | None:
    """Return how likely each vertex of the surface is crown by its colour, 0 .. 1, shape (v,).

    None where the colours say nothing.

    Args:
        colors: red, green, blue per vertex of the scan, shape (V, 3).
    """
    count = len(surface.vertices)
    total = np.maximum(colors.sum(axis=1, dtype=np.float64), 1.0)
    redness = (colors[:, 0].astype(np.float64) - colors[:, 1]) / total
    number = np.maximum(np.bincount(surface.of_vertex, minlength=count), 1)
    redness = np.bincount(surface.of_vertex, redness, count) / number
    gum = seen.gum | (seen.below > _FAR_BELOW_MM)
    if min(seen.crown.sum(), gum.sum()) < _FEWEST:
        return None
    crown_red, gum_red = float(np.median(redness[seen.crown])), float(np.median(redness[gum]))
    spread = [float(np.median(np.abs(redness[part] - np.median(redness[part])))) for part in (seen.crown, gum)]
    if gum_red - crown_red < _LEAST_CONTRAST * (1.4826 * max(spread) + _GRAIN):
        return None
    return np.clip((gum_red - redness) / (gum_red - crown_red), 0.0, 1.0)
