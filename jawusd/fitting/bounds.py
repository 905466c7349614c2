"""The bounds of captured parameters: the paper's alpha shapes, and the slice hull, which is the default.

Alpha shapes of (d1, d2) and (d1, d3): a Delaunay triangle belongs to the shape if its circumradius is at most alpha
after both axes have been divided by the captured range (Edelsbrunner, Kirkpatrick & Seidel 1983 with r = alpha). The
paper's alpha of 0.12 is in units of its network's components, whose ranges are not published.

Slice hull: a convex section in (laterotrusion, protrusion), in mm, for every opening: the support function of the
captured poses near that opening, smoothed over the opening. A tight alpha shape in three dimensions would be hollow,
since border movements leave the inside of the envelope empty.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import Delaunay, QhullError
from shapely import MultiPoint, Polygon, polygons, union_all
from shapely.geometry.polygon import orient

from jawusd.base.arrays import Array
from jawusd.evaluator.bounds import SliceHull

#: Planes of the alpha shapes: their names, and their columns of d.
PLANES = {"polygon_d1d2": [0, 1], "polygon_d1d3": [0, 2]}

_SMALLEST_RANGE_MM = 0.5  # minimum range used for normalisation; a smaller range is noise, which would be amplified
_SLIVER = 1e-12  # twice the area of a triangle below which it is degenerate [normalised units]
_THIN = 0.02  # distance by which the hull of collinear points is widened [normalised units]

DIRECTIONS = 16
KNOTS = 48
SOFTNESS_MM = 0.1

_PROTRUSION_STRETCH = 1.6  # factor that stretches protrusion, the shorter axis, before directions are spaced evenly
_WINDOW_MM = 3.5  # maximum difference in opening [mm] between a section and the frames from which it is built
_FEWEST_IN_WINDOW = 12  # minimum number of frames per section; if the window has fewer, the nearest are used
_TAPER = 0.35  # fraction by which a frame at the edge of the window is moved towards the section's median
_KERNEL_KNOTS = 1.0  # standard deviation of the smoothing kernel over the opening, in knots
_FOLDS, _BLOCK = 5, 50  # number of folds, and length of their blocks [frames], about that of one exercise
# Margin of the hull. The soft maximum over all half-spaces exceeds the maximum by up to SOFTNESS_MM * log(DIRECTIONS +
# 2) = 0.29 mm; with a smaller margin, the section of a parameter that the data do not excite would be empty.
_MARGIN_MM = 0.38
_CONTACT_TOLERANCE_MM = 0.05  # extension of the hull below the captured openings [mm]
_FRAMES_PER_SLIP = 400  # because of noise, one in this many frames may lie beyond closed teeth
_SHORTEST_RANGE_MM = 1.0
_TOLERANCE_QUANTILE, _LARGEST_TOLERANCE_MM = 0.95, 1.0


def fit_bounds(d: Array, alpha: float, closed_mm: float | None = None) -> dict[str, Array]:
    """Return all arrays of a model that describe its bounds, for captured parameters (N, 3) [mm] in temporal order.

    `alpha` is as in `alpha_shape`, `closed_mm` as in `fit_slice_hull`.
    """
    hull, tolerances = fit_slice_hull(d, closed_mm)
    arrays = dict(hull)
    for name, columns in PLANES.items():
        arrays[name], arrays[f"{name}_counts"] = alpha_shape(d[:, columns], alpha)
    return {**arrays, "d_range": valid_box(hull), **tolerances}


def alpha_shape(points: Array, alpha: float) -> tuple[Array, Array]:
    """Return the outer rings of an alpha shape of points (N, 2) [mm]; `alpha` is its largest circumradius [per range].

    They are the vertices of all rings [mm], shape (P, 2), each ring open (its first vertex is not repeated),
    counter-clockwise, largest first; and the number of vertices of each ring (integers), shape (k,).
    """
    low = points.min(0)
    unit = np.maximum(np.ptp(points, axis=0), _SMALLEST_RANGE_MM)
    normalised = (points - low) / unit
    try:
        corners = normalised[Delaunay(normalised).simplices]
        shape = union_all(polygons(corners[_circumradius(corners) <= alpha]))
    except QhullError:  # all points are collinear
        shape = Polygon()
    if shape.is_empty:
        shape = MultiPoint(normalised).convex_hull.buffer(_THIN, join_style="mitre", cap_style="square")
    parts = sorted(getattr(shape, "geoms", [shape]), key=lambda part: -part.area)
    rings = [np.asarray(orient(part).exterior.coords)[:-1] for part in parts if isinstance(part, Polygon)]
    return np.concatenate(rings) * unit + low, np.array([len(ring) for ring in rings])


def _circumradius(corners: Array) -> Array:
    """Return the circumradii (T,) of triangles (T, 3, 2): product of the sides over four times the area."""
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    doubled_area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return np.where(doubled_area > _SLIVER, sides.prod(1) / np.maximum(2 * doubled_area, _SLIVER), np.inf)


def fit_slice_hull(d: Array, closed_mm: float | None = None) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the slice hull of captured parameters (N, 3) [mm] in temporal order, and `tolerance_mm` and `held_out_*`.

    The hull ends at the d1 of closed teeth; None: the smallest captured d1, apart from noise. The tolerance for
    measured poses is the 95 % quantile of the distance of held-out frames outside the hull, since other exercises reach
    slightly farther than those captured. It is at most 1 mm, since a larger one would accept poses that no frame shows.
    """
    blocks = np.arange(len(d)) // min(_BLOCK, max(1, len(d) // _FOLDS)) % _FOLDS
    excess = [SliceHull(_hull(d[blocks != k], closed_mm)).signed_distance(d[blocks == k]) for k in range(_FOLDS)]
    excess_mm = np.maximum(np.concatenate(excess), 0.0)
    p95_mm = np.quantile(excess_mm, _TOLERANCE_QUANTILE)
    tolerance_mm = np.minimum(p95_mm, _LARGEST_TOLERANCE_MM)
    share = np.mean(excess_mm <= tolerance_mm)
    return _hull(d, closed_mm), {
        "tolerance_mm": np.array(tolerance_mm),
        "held_out_share": np.array(share),
        "held_out_p95_mm": np.array(p95_mm),
    }


def valid_box(arrays: Mapping[str, Array]) -> Array:
    """Return the axis-aligned bounding box in d [mm], shape (3, 2), of the slice hull of the `slice_*` arrays."""
    reach, directions, d1 = arrays["slice_support"].max(0), arrays["slice_directions"], arrays["slice_d1"]
    ends = [sign * reach[np.argmax(sign * directions[:, axis])] for axis in (0, 1) for sign in (-1, 1)]
    box = np.array([[d1[0], d1[-1]], ends[:2], ends[2:]])
    return box + arrays["slice_margin_mm"] * np.array([-1.0, 1.0])


def _hull(d: Array, closed_mm: float | None) -> dict[str, Array]:
    angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    directions = np.stack([np.cos(angle), np.sin(angle) * _PROTRUSION_STRETCH], axis=-1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # The margin also extends the hull beyond closed teeth, so it is subtracted at that end.
    closed = float(np.sort(d[:, 0])[len(d) // _FRAMES_PER_SLIP]) if closed_mm is None else closed_mm
    low, high = closed + _MARGIN_MM - _CONTACT_TOLERANCE_MM, float(d[:, 0].max())
    knots = np.linspace(low, max(high, low + _SHORTEST_RANGE_MM), KNOTS)
    reach = d[:, 1:] @ directions.T
    support = np.stack([_section(np.abs(d[:, 0] - knot) / _WINDOW_MM, reach) for knot in knots])
    support = np.asarray(gaussian_filter1d(support, _KERNEL_KNOTS, axis=0, mode="nearest", truncate=3.0))
    return {
        "slice_d1": knots,
        "slice_directions": directions,
        "slice_support": support,
        "slice_softness_mm": np.array(SOFTNESS_MM),
        "slice_margin_mm": np.array(_MARGIN_MM),
    }


def _section(distance: Array, reach: Array) -> Array:
    """Return the support values (K,) of one section [mm], from the reach (N, K) of frames along each direction [mm].

    `distance` (N,) is the difference in opening between the frames and the section, in units of the window.
    """
    order = np.argsort(distance, kind="stable")
    count = max(int((distance < 1.0).sum()), min(_FEWEST_IN_WINDOW, len(distance)))
    near = order[:count]
    far = np.minimum(distance[near], 1.0)[:, None]
    middle = np.median(reach[near], axis=0)
    return (middle + (reach[near] - middle) * (1 - _TAPER * far**2)).max(0)
