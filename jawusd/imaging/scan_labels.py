"""Tell crown, gum and base of a teeth scan apart by its shape.

Scans come in two kinds. Where crowns are pieces of their own, the pieces say which is which. Where one surface covers
crowns and gum, the line between them is the crease around every crown: a random walker (Grady, "Random walks for image
segmentation", PAMI 2006) starts where the surface stands highest, which is crown, and far from there, which is gum,
and hardly steps across creases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

from jawusd.formats.mesh import GUM, TOOTH, Mesh
from jawusd.geometry.arrays import Array, Indices, Mask
from jawusd.imaging.scan_surface import ScanSurface
from jawusd.imaging.scan_tops import Tops, biting_direction, tops

# A crown with what a scan keeps of its root is smaller than this in every direction, a gum larger [mm].
_TOOTH_MM = 24.0
_SPECK_MM = 3.0  # smaller pieces are scraps, which get the label of what they lie at
_LOW_MM = 6.0  # a piece that stays this far below the teeth around is no crown
_FEWEST_CROWNS = 3  # pieces of tooth size, so that the other pieces can be taken as their gum
# Steps of the walker become e times rarer per 1/_SHYNESS of inward curvature [mm].
_SHYNESS_MM = 2.5
_SHARPEST = 8.0  # sharper creases count like this one [1/mm]
_EVIDENCE = 0.6  # a border along a weaker crease is hardly supported by the shape [1/mm]
_EVIDENCE_REACH_MM = 0.5
_TOLERANCE, _STEPS = 1e-4, 3000


@dataclass(frozen=True, eq=False)
class Labelling:
    """Hold what the shape of a scan says."""

    labels: NDArray[np.uint8]  # GUM or TOOTH per vertex of the scan, shape (V,)
    up: Array  # the direction in which the crowns point, shape (3,)
    # share of the border between crown and gum on one surface that runs along no crease, 0 .. 1; 0 without a border
    weak_share: float
    pieces: int
    merged: int  # vertices of the scan that lay at the place of another one
    empty: int  # faces without area
    repeated: int  # faces that were there twice


def label_scan(mesh: Mesh, towards: Array | None) -> Labelling:
    """Tell crown and gum of a teeth scan apart by its shape; a scan of crowns alone is crown all over.

    Args:
        mesh: the scan [mm].
        towards: middle of the other arch in the same frame, teeth in occlusion, shape (3,); None if not known.
    """
    surface = ScanSurface.of(mesh)
    up = biting_direction(surface.vertices, towards)
    surface = surface.wound(up)
    seen = tops(surface.vertices, up)
    small = _tooth_sized(surface)
    crown = np.zeros(len(surface.vertices), dtype=bool)
    crown[small[surface.piece]] = _standing(surface, seen, small)[surface.piece[small[surface.piece]]]
    weak = 0.0
    if not small.all() and not _explained_by_pieces(surface, seen, small, crown):
        crown, weak = _walked(surface, seen, small, crown)
    labels = np.where(_scraps_joined(surface, crown), TOOTH, GUM).astype(np.uint8)
    return Labelling(
        labels=labels[surface.of_vertex],
        up=up,
        weak_share=weak,
        pieces=int(surface.piece.max()) + 1,
        merged=surface.merged,
        empty=surface.empty,
        repeated=surface.repeated,
    )


def _extent_mm(surface: ScanSurface) -> Array:
    """Return the diagonal of the box around every piece [mm], shape (P,)."""
    count = int(surface.piece.max()) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, surface.piece, surface.vertices)
    np.maximum.at(high, surface.piece, surface.vertices)
    return np.asarray(np.linalg.norm(high - low, axis=1))


def _tooth_sized(surface: ScanSurface) -> Mask:
    """Return which pieces are no larger than a tooth, shape (P,)."""
    return _extent_mm(surface) < _TOOTH_MM


def _standing(surface: ScanSurface, seen: Tops, small: Mask) -> Mask:
    """Return which of the small pieces reach up to where crowns are, shape (P,)."""
    depth = np.full(len(small), np.inf)
    np.minimum.at(depth, surface.piece, seen.below + np.maximum(seen.top_depth, 0.0))
    return small & (depth < _LOW_MM)


def _explained_by_pieces(surface: ScanSurface, seen: Tops, small: Mask, crown: Mask) -> bool:
    """Tell whether the highest places all belong to crowns that are pieces of their own."""
    own = np.unique(surface.piece[crown])
    if (_extent_mm(surface)[own] > _SPECK_MM).sum() < _FEWEST_CROWNS:
        return False
    others = seen.crown & ~small[surface.piece]
    return bool(others.sum() <= 0.2 * seen.crown.sum())


def _walked(surface: ScanSurface, seen: Tops, small: Mask, crown: Mask) -> tuple[Mask, float]:
    """Return which vertices are crown, shape (v,), the large pieces walked over, and the weak share of the border."""
    edges = surface.edges()
    crease = surface.creases(edges)
    large = ~small[surface.piece]
    weights = _weights(surface, crease)
    up, down = seen.crown & large, seen.gum & large
    share = _walk(weights, up, down)
    found = _without_islands(edges, (share > 0.5) & large, up, down, large)
    return np.where(large, found, crown), _weak_share(surface, edges, crease, found)


def _weights(surface: ScanSurface, crease: Array) -> csr_array:
    """Return how readily the walker steps between vertices: cotangent weights, less across creases, shape (v, v)."""
    n, parts = len(surface.vertices), []
    corners = surface.vertices[surface.faces]
    for k in range(3):
        i, j = surface.faces[:, (k + 1) % 3], surface.faces[:, (k + 2) % 3]
        one, two = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        area = np.maximum(np.linalg.norm(np.cross(one, two), axis=1), 1e-9)
        # Limits keep slivers from tearing the surface apart or gluing it together.
        weight = np.clip(np.einsum("ij,ij->i", one, two) / area, 0.05, 3.0)
        weight *= np.exp(-_SHYNESS_MM * np.minimum(0.5 * (crease[i] + crease[j]), _SHARPEST))
        parts.append((i, j, weight))
    rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    one_way = coo_array((values, (rows, columns)), shape=(n, n)).tocsr()
    return csr_array(one_way + one_way.T)


def _walk(weights: csr_array, up: Mask, down: Mask) -> Array:
    """Return how likely a walker from every vertex meets `up` before `down`, shape (v,)."""
    share = np.where(up, 1.0, np.where(down, 0.0, 0.5))
    free, fixed = ~(up | down), up | down
    if not free.any() or not fixed.any():
        return share
    degree = weights.sum(axis=1)[free] + 1e-9
    inner = csr_array(diags_array(degree) - weights[free][:, free])
    start = weights[free][:, fixed] @ share[fixed]
    found, _ = cg(inner, start, x0=share[free], rtol=_TOLERANCE, maxiter=_STEPS, M=diags_array(1.0 / degree))
    share[free] = found
    return share


def _without_islands(edges: Indices, crown: Mask, up: Mask, down: Mask, among: Mask) -> Mask:
    """Return the crowns without islands: parts of either label in which no walk starts become the other one."""
    for label, start in ((True, up), (False, down)):
        part = _parts(edges, (crown == label) & among)
        started = np.zeros(part.max() + 2, dtype=bool)
        started[part[start & (crown == label)]] = True
        island = (part >= 0) & ~started[part]
        crown = np.where(island, not label, crown)
    return crown


def _parts(edges: Indices, chosen: Mask) -> Indices:
    """Return the number of the connected part of every chosen vertex, -1 of the others, shape (v,)."""
    inside = edges[chosen[edges].all(axis=1)]
    links = coo_array((np.ones(len(inside), np.int8), (inside[:, 0], inside[:, 1])), shape=(len(chosen),) * 2)
    part = connected_components(links, directed=False)[1]
    return np.where(chosen, part, -1)


def _weak_share(surface: ScanSurface, edges: Indices, crease: Array, crown: Mask) -> float:
    """Return the share of the border's edges with no crease near them."""
    across = edges[crown[edges[:, 0]] != crown[edges[:, 1]]]
    if not len(across):
        return 0.0
    sharp = surface.vertices[crease > _EVIDENCE]
    if not len(sharp):
        return 1.0
    middle = surface.vertices[across].mean(axis=1)
    return float((cKDTree(sharp).query(middle)[0] > _EVIDENCE_REACH_MM).mean())


def _scraps_joined(surface: ScanSurface, crown: Mask) -> Mask:
    """Return the crowns with scraps counted to whatever larger piece they lie at."""
    scrap = (_extent_mm(surface) < _SPECK_MM)[surface.piece]
    if not scrap.any() or scrap.all():
        return crown
    nearest = cKDTree(surface.vertices[~scrap]).query(surface.vertices[scrap])[1]
    out = crown.copy()
    out[scrap] = crown[~scrap][nearest]
    return out
