"""The paper's bounds: alpha shapes of the captured (d1, d2) and (d1, d3).

Convention of alpha here: a Delaunay triangle belongs to the shape when its circumradius is at most alpha, after both
axes were divided by the captured range (Edelsbrunner, Kirkpatrick & Seidel 1983 with r = alpha). The paper's alpha of
0.12 is in units of its network's codes, whose ranges it does not print.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError
from shapely import MultiPoint, Polygon, polygons, union_all
from shapely.geometry.polygon import orient

from jawusd.geometry.arrays import Array

_SMALLEST_RANGE_MM = 0.5  # ranges below this are noise, not motion; dividing by them would blow the noise up
_SLIVER = 1e-12  # twice the smallest area of a triangle, in normalised units
_THIN = 0.02  # width given to shapes of points on a line, normalised units


def alpha_shape(points: Array, alpha: float) -> tuple[Array, NDArray[np.int64]]:
    """Return the outer rings of an alpha shape.

    Args:
        points: captured pairs of parameters [mm], shape (N, 2).
        alpha: largest circumradius of a triangle, in range-normalised units.

    Returns:
        Vertices of all rings [mm], shape (P, 2), each ring open (its first vertex is not repeated), counter-clockwise,
        largest first; and the number of vertices of each ring, shape (k,).
    """
    low = points.min(0)
    unit = np.maximum(np.ptp(points, axis=0), _SMALLEST_RANGE_MM)
    normalised = (points - low) / unit
    try:
        corners = normalised[Delaunay(normalised).simplices]
        shape = union_all(polygons(corners[_circumradius(corners) <= alpha]))
    except QhullError:  # all points on one line
        shape = Polygon()
    if shape.is_empty:
        shape = MultiPoint(normalised).convex_hull.buffer(_THIN, join_style="mitre", cap_style="square")
    parts = sorted(getattr(shape, "geoms", [shape]), key=lambda part: -part.area)
    rings = [np.asarray(orient(part).exterior.coords)[:-1] for part in parts if isinstance(part, Polygon)]
    return np.concatenate(rings) * unit + low, np.array([len(ring) for ring in rings])


def _circumradius(corners: Array) -> Array:
    """Return the circumradii of triangles, shape (T, 3, 2) -> (T,): product of the sides over four times the area."""
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    doubled_area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return np.where(doubled_area > _SLIVER, sides.prod(1) / np.maximum(2 * doubled_area, _SLIVER), np.inf)
