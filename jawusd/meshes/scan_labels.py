"""Separate crown and gum of a teeth scan by its shape and, where crown and gum differ in colour, by colour.

There are two kinds of scans. If crowns are separate components of the mesh, each component is crown or gum. If one
surface covers crowns and gum, the boundary between them is the crease around every crown. First the occlusal direction
of the arch is found, and seed points that are certainly crown or gum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter
from scipy.spatial import ConvexHull, QhullError, cKDTree

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.formats.mesh import GUM, TOOTH, Mesh
from jawusd.meshes.scan_surface import CreaseWalk, ScanSurface

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
    """Return the direction in which the crowns of a dental arch with vertices (v, 3) point, shape (3,).

    `towards` is the centre (3,) of the opposing arch in the same frame, teeth in occlusion. If it is None, the crowns
    are on the rougher side of the surface.
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
    """Return which components have no other component above their centre, (P,); `piece` is that of each point, (v,)."""
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


# Bounding box diagonal [mm] that separates crowns, including scanned root and gum, from the gum of an arch or quadrant;
# the former are smaller, the latter larger.
_TOOTH_MM = 30.0
_FEWEST_FACES = 100  # minimum number of faces of a scan; scans with fewer cannot be labelled or tracked
# Bounding box diagonal of the smallest crown [mm]; smaller components are scraps and brackets, which take the label of
# the adjacent component.
_CROWN_MM = 4.0
# Fraction of a component's height, from its lower end, in which vertices become gum seeds if there are no better ones.
_LOWEST = 0.12
# Maximum rate at which random walks from a crown top reach the gum, per mm of the top's outline [1/mm], divided by a
# factor that grows with the top's depth below the hull of the arch. Observed in 40 scans: up to 0.030 at crowns, 0.026
# to 0.074 at ridges without teeth, most of which are below the hull.
_LEAVING, _STRICTER_PER_MM, _STRICTEST_MM = 0.06, 3.0, 0.6
# Maximum fraction of a component's crown-gum border that has no crease (median over a dental arch) for the components
# to be treated as crowns with gum. Observed: 0.02 to 0.162 with a collar of gum (58 scans); without gum, 0.24 to 1.0,
# and 0.167 for one scan from the root side, whose grooves and necks resemble short creases.
_MOST_WEAK = 0.165
# Median edge length above which creases at the gum line are not resolved, so that crowns may include gum.
_COARSE_MM = 1.2
# Minimum height of a small component's lower end above the lower end of the adjacent crown, as a fraction of the
# crown's height, for the component to be attached to the crown (such as a bracket) instead of being gum.
_ON_CROWN = 0.2
# Minimum difference in redness between the highest points and points far below them, in standard deviations, for vertex
# colours to be used; stone casts and untextured scans stay below it.
_LEAST_CONTRAST = 4.0
_FAR_BELOW_MM = 9.0  # depth below the highest nearby point that few crowns exceed
_FEWEST = 50  # minimum number of vertices that are certainly crown, and of those certainly gum, for colours to be used
_GRAIN = 0.003  # standard deviation of redness due to 8-bit quantisation


@dataclass(frozen=True, eq=False)
class Labelling:
    """Crown and gum labels of a scan."""

    labels: NDArray[np.uint8]  # GUM or TOOTH for each vertex of the scan, shape (V,)
    up: Array  # direction in which the crowns point, shape (3,)
    # Fraction of the crown-gum border that does not follow a crease, 0 to 1; 0 if there is no border, 1 if the faces
    # are too large to resolve creases.
    weak_share: float


def label_scan(mesh: Mesh, towards: Array | None) -> Labelling:
    """Separate crown and gum of a teeth scan [mm]; one that contains only crowns is labelled entirely as crown.

    `towards` is the centre (3,) of the opposing arch in the coordinate frame of the scan, teeth in occlusion, or None.
    """
    surface = ScanSurface.of(mesh)
    if len(surface.faces) < _FEWEST_FACES:
        return Labelling(np.full(len(mesh.vertices), TOOTH, np.uint8), np.array([0.0, 1.0, 0.0]), 0.0)
    up = biting_direction(surface.vertices, towards)
    surface = surface.wound(up)
    seen = tops(surface.vertices, up)
    by_colour = None if mesh.colors is None else crown_by_colour(mesh.colors, surface, seen)
    walk = CreaseWalk(surface, by_colour)
    crown, weak = _by_pieces(surface, seen, up, walk)
    crown = _scraps_joined(surface, crown)
    if crown.all() and surface.edge_mm(walk.edges) > _COARSE_MM:
        weak = 1.0
    labels = np.where(crown, TOOTH, GUM).astype(np.uint8)
    return Labelling(labels[surface.of_vertex], up, weak)


def _by_pieces(surface: ScanSurface, seen: Tops, up: Array, walk: CreaseWalk) -> tuple[Mask, float]:
    """Return which vertices are crown, shape (v,), and the fraction of crown-gum borders that have no crease."""
    piece, extent = surface.piece, _extent_mm(surface)
    small = extent < _TOOTH_MM
    starts = np.bincount(piece, seen.crown, len(extent))
    alone = small & (extent > _CROWN_MM) & topped_by(surface.vertices, up, piece)
    bearing = (extent > _CROWN_MM) & (starts > 0) | alone
    high = (seen.crown | (alone & (starts == 0))[piece] & (_height_share(surface, up) > 1 - _LOWEST)) & bearing[piece]
    if (bearing & small).sum() >= 3 and high[~small[piece]].sum() < 0.2 * high.sum():
        bearing &= small  # with several separate crowns, larger components are their gum
        high &= small[piece]
    low = seen.gum | ~bearing[piece]
    surely = np.bincount(piece, seen.gum, len(extent)) > 0
    low |= (bearing & ~(surely & ~small))[piece] & (_height_share(surface, up) < _LOWEST)
    strictness = 1.0 + _STRICTER_PER_MM * np.clip(seen.top_depth, 0.0, _STRICTEST_MM)
    crown = walk.crowns(high & ~low, low, np.where(small[piece], np.inf, _LEAVING / strictness))
    across, weak = walk.weak(crown)
    owner = piece[across[:, 0]]
    count = np.bincount(owner, minlength=len(extent))
    share = np.bincount(owner, weak, len(extent)) / np.maximum(count, 1)
    own = bearing & small
    both = own.any() and (
        walk.by_colour is not None or bool(np.median(np.where(count > 0, share, 1.0)[own]) <= _MOST_WEAK)
    )
    whole = own if not both else own & (count == 0)
    crown = crown & bearing[piece] | whole[piece]
    crown |= _carried(surface, up, bearing & small, ~bearing & small)[piece]
    counted = ~whole[owner]
    return crown, float(weak[counted].mean()) if counted.any() else 0.0


def _carried(surface: ScanSurface, up: Array, crowns: Mask, others: Mask) -> Mask:
    """Return which of the components `others` (P,) are attached to one of the components `crowns` (P,), shape (P,)."""
    out = np.zeros(len(others), dtype=bool)
    if not crowns.any() or not others.any():
        return out
    piece, count = surface.piece, len(others)
    low, high = _ranges(surface.vertices @ up, piece)
    standing = np.flatnonzero(crowns[piece])
    size = np.maximum(np.bincount(piece, minlength=count), 1)
    middle = np.stack([np.bincount(piece, axis, count) / size for axis in surface.vertices.T], axis=1)[others]
    at = piece[standing[cKDTree(surface.vertices[standing]).query(middle)[1]]]
    out[others] = low[others] > low[at] + _ON_CROWN * (high - low)[at]
    return out


def _ranges(values: Array, piece: Indices) -> tuple[Array, Array]:
    """Return the smallest and largest value in every component, shape (P, ...), of the values at vertices (v, ...)."""
    shape = (int(piece.max()) + 1, *values.shape[1:])
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    np.minimum.at(low, piece, values)
    np.maximum.at(high, piece, values)
    return low, high


def _extent_mm(surface: ScanSurface) -> Array:
    """Return the bounding box diagonal of every component [mm], shape (P,)."""
    low, high = _ranges(surface.vertices, surface.piece)
    return np.asarray(np.linalg.norm(high - low, axis=1))


def _height_share(surface: ScanSurface, up: Array) -> Array:
    """Return the relative height of each vertex in its component, from 0 (lowest) to 1 (highest), shape (v,)."""
    height = surface.vertices @ up
    low, high = _ranges(height, surface.piece)
    return np.asarray((height - low[surface.piece]) / np.maximum(high - low, 1e-9)[surface.piece])


def _scraps_joined(surface: ScanSurface, crown: Mask) -> Mask:
    """Return the crown vertices after giving scraps the label of the adjacent larger component."""
    scrap = (_extent_mm(surface) < _CROWN_MM)[surface.piece]
    if not scrap.any() or scrap.all():
        return crown
    nearest = cKDTree(surface.vertices[~scrap]).query(surface.vertices[scrap])[1]
    out = crown.copy()
    out[scrap] = crown[~scrap][nearest]
    return out


def crown_by_colour(colors: NDArray[np.uint8], surface: ScanSurface, seen: Tops) -> Array | None:
    """Return the probability (v,) that each vertex is crown, by its colour; None if the colours are not informative.

    `colors` (V, 3) are the red, green and blue of each vertex of the scan.
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
