"""Find the occlusal direction of a dental arch, and seed points of a scan that are certainly crown or gum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, maximum_filter
from scipy.spatial import ConvexHull, QhullError

from jawusd.base.arrays import Array, Indices, Mask

_CELL_MM = 0.75  # cell size of the height map of an arch
# Maximum distance between a crown's points and its highest point in plan view; half the width of a wide molar.
_REACH_MM = 4.5
# Maximum depth below the highest nearby point for a point to be certainly crown; even worn crowns protrude by 3 mm.
_BAND_MM = 1.5
# Maximum depth of a crown top below the hull of the dental arch. A curve of Spee or an open bite causes 3 to 4 mm;
# ridges without teeth are deeper.
_UNDER_HULL_MM = 4.5
# Distance from every crown top in plan view, and depth below the hull of the dental arch, beyond which a point is not
# crown.
_ASIDE_MM, _DEEP_MM = 5.0, 13.0
_LEVEL = 0.95  # minimum vertical component of the normal of a hull facet that counts as level
_ROUNDS = 3
_MIDDLE_CELLS = 2  # radius in plan view [cells] in which components above a component's centre are searched


@dataclass(frozen=True, eq=False)
class Tops:
    """Depth of an arch's vertices below its highest points, and vertices that are certainly crown or gum."""

    below: Array  # depth of each vertex below the highest nearby point [mm], shape (v,)
    top_depth: Array  # depth of the highest point near each vertex below the hull of the arch [mm], shape (v,)
    crown: Mask  # which vertices are certainly crown, shape (v,)
    gum: Mask  # which vertices are certainly gum, shape (v,)


def biting_direction(points: Array, towards: Array | None) -> Array:
    """Return the direction in which the crowns of a dental arch point, shape (3,).

    Args:
        points: vertices of the arch, shape (v, 3).
        towards: centre of the opposing arch, shape (3,), in the same coordinate frame with the teeth in occlusion. If
            it is None, the crowns are on the rougher side of the surface.
    """
    middle = points.mean(axis=0)
    _, size, axes = np.linalg.svd(points - middle, full_matrices=False)
    if towards is not None and np.linalg.norm(towards - middle) > _BAND_MM:
        away = (towards - middle) / np.linalg.norm(towards - middle)
        # Prefer the thin direction of the arch, since an overjet displaces the arches along the occlusal plane.
        nearest = axes[(np.abs(axes @ away) / np.maximum(size, 1e-9)).argmax()]
        up = nearest * np.sign(nearest @ away)
    else:
        up = axes[2] * np.sign(_roughness(points, axes[2]) - _roughness(points, -axes[2]) or 1.0)
    for _ in range(_ROUNDS):
        high = points[tops(points, up).crown]
        if len(high) < 100:
            break
        normal = np.linalg.svd(high - high.mean(axis=0), full_matrices=False)[2][2]
        up = normal * np.sign(normal @ up)
    return np.asarray(up)


def _roughness(points: Array, up: Array) -> float:
    """Return the roughness [mm] of the upper side of points along a direction (3,), relative to the convex hull."""
    seen = tops(points, up)
    return float(np.std(seen.top_depth[seen.below < _BAND_MM]))


def tops(points: Array, up: Array) -> Tops:
    """Find the highest points of an arch along the direction `up` (3,) among points (v, 3)."""
    cells, height, heights = _height_map(points, up)
    radius = round(_REACH_MM / _CELL_MM)
    row, column = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    highest = maximum_filter(heights, footprint=row**2 + column**2 <= radius**2, mode="constant", cval=-np.inf)
    place = tuple(cells.T)
    below = highest[place] - height
    top_depth = _hull_height(heights)[place] - highest[place]
    crown = (below < _BAND_MM) & (top_depth < _UNDER_HULL_MM)
    aside = np.ones(heights.shape, dtype=bool)
    aside[tuple(cells[crown].T)] = False
    distance = distance_transform_edt(aside)[place] * _CELL_MM if crown.any() else np.zeros(len(points))
    gum = ((distance > _ASIDE_MM) | (below + np.maximum(top_depth, 0) > _DEEP_MM)) & ~crown
    return Tops(below, top_depth, crown, gum)


def topped_by(points: Array, up: Array, piece: Indices) -> Mask:
    """Return which components have no other component above their centre, shape (P,).

    Args:
        piece: component index of each point, shape (v,).
    """
    cells, height, heights = _height_map(points, up)
    count = int(piece.max()) + 1
    size = np.maximum(np.bincount(piece, minlength=count), 1)
    middle = np.stack([np.bincount(piece, cells[:, k], count) / size for k in range(2)], axis=1)
    near = np.abs(cells - middle[piece]).max(axis=1) <= _MIDDLE_CELLS
    own = np.full(count, -np.inf)
    np.maximum.at(own, piece[near], height[near])
    radius = _MIDDLE_CELLS
    over = maximum_filter(heights, size=2 * radius + 1, mode="constant", cval=-np.inf)
    return np.asarray(own >= over[tuple(middle.astype(np.int64).T)] - _BAND_MM)


def _height_map(points: Array, up: Array) -> tuple[Indices, Array, Array]:
    """Return the cell (v, 2) and height (v,) of each point, and the largest height in each cell, -inf if empty."""
    one = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    one /= np.linalg.norm(one)
    plan = points @ np.stack([one, np.cross(up, one)], axis=1)
    cells = np.floor((plan - plan.min(axis=0)) / _CELL_MM).astype(np.int64)
    height = points @ up
    heights = np.full(cells.max(axis=0) + 1, -np.inf)
    np.maximum.at(heights, tuple(cells.T), height)
    return cells, height, heights


def _hull_height(heights: Array) -> Array:
    """Return the height of the upper convex hull over each cell of a map, with the hull's level facets extended."""
    filled = np.argwhere(np.isfinite(heights))
    places = np.column_stack([filled * _CELL_MM, heights[tuple(filled.T)]])
    out = np.full(heights.shape, np.nan)
    try:
        planes = ConvexHull(places).equations
    except (QhullError, ValueError):  # a flat or tiny component has no convex hull
        out[tuple(filled.T)] = places[:, 2].max()
        return out
    # Steep hull facets lead down to the palate, folds or base plate beside the teeth; level facets replace them.
    level = planes[:, 2] > _LEVEL
    planes = planes[level] if level.any() else planes[planes[:, 2].argmax()][None]
    over = -(places[:, :2] @ planes[:, :2].T + planes[:, 3]) / planes[:, 2]
    out[tuple(filled.T)] = over.min(axis=1)
    return out
