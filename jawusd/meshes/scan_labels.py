"""Separate crown and gum of a teeth scan by its shape and, where crown and gum differ in colour, by colour.

There are two kinds of scans. If crowns are separate components of the mesh, each component is crown or gum. If one
surface covers crowns and gum, the boundary between them is the crease around every crown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array, Mask
from jawusd.formats.mesh import GUM, TOOTH, Mesh
from jawusd.meshes.scan_surface import ScanSurface
from jawusd.meshes.scan_tops import Tops, biting_direction, topped_by, tops
from jawusd.meshes.scan_walk import CreaseWalk

# Bounding box diagonal [mm] that separates crowns, including scanned root and gum, from the gum of an arch or quadrant;
# the former are smaller, the latter larger.
_TOOTH_MM = 30.0
_FEWEST_FACES = 100  # minimum number of faces of a scan; scans with fewer cannot be labelled or tracked
# Bounding box diagonal of the smallest crown [mm]; smaller components are scraps and brackets, which take the label of
# the adjacent component.
_CROWN_MM = 4.0
# Fraction of a component's height, from its lower end, in which vertices become gum seeds if there are no better ones.
_LOWEST = 0.12
# Maximum rate at which random walks from a crown top reach the gum, per mm of the top's outline [1/mm]. The limit is
# divided by a factor that grows with the depth of the top below the hull of the dental arch. Observed rates (40 scans,
# each one surface): 0.003 (median) to 0.030 at crowns, 0.026 to 0.074 at ridges without teeth, most of which are below
# the hull.
_LEAVING, _STRICTER_PER_MM, _STRICTEST_MM = 0.06, 3.0, 0.6
# Maximum fraction of a component's crown-gum border that has no crease (median over a dental arch) for the components
# to be treated as crowns with gum. Observed: 0.02 to 0.162 for synthetic crowns with a collar of gum (58 scans of 5,000
# faces or more); 0.8 to 1.0 for synthetic crowns without gum; 0.24 to 0.34 for real crowns without gum; 0.167 for one
# scan recorded from the root side, on which grooves and necks resemble short creases.
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
    """Separate crown and gum of a teeth scan by its shape and, where crown and gum differ in colour, by colour.

    A scan that contains only crowns is labelled entirely as crown.

    Args:
        mesh: the scan [mm].
        towards: centre of the opposing arch in the coordinate frame of the scan, teeth in occlusion, shape (3,), or
            None.
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
    height, piece, count = surface.vertices @ up, surface.piece, len(others)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, piece, height)
    np.maximum.at(high, piece, height)
    standing = np.flatnonzero(crowns[piece])
    size = np.maximum(np.bincount(piece, minlength=count), 1)
    middle = np.stack([np.bincount(piece, axis, count) / size for axis in surface.vertices.T], axis=1)[others]
    at = piece[standing[cKDTree(surface.vertices[standing]).query(middle)[1]]]
    out[others] = low[others] > low[at] + _ON_CROWN * (high - low)[at]
    return out


def _extent_mm(surface: ScanSurface) -> Array:
    """Return the bounding box diagonal of every component [mm], shape (P,)."""
    count = int(surface.piece.max()) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, surface.piece, surface.vertices)
    np.maximum.at(high, surface.piece, surface.vertices)
    return np.asarray(np.linalg.norm(high - low, axis=1))


def _height_share(surface: ScanSurface, up: Array) -> Array:
    """Return the relative height of each vertex in its component, from 0 (lowest) to 1 (highest), shape (v,)."""
    height = surface.vertices @ up
    count = int(surface.piece.max()) + 1
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, surface.piece, height)
    np.maximum.at(high, surface.piece, height)
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
    """Return the probability that each vertex is crown, judged by its colour, 0 to 1, shape (v,).

    Return None if the colours are not informative.

    Args:
        colors: red, green and blue of each vertex of the scan, shape (V, 3).
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
