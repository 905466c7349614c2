"""Measurements of how two teeth scans meet: contact, overlap, and relation of opposing crowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import bite_normal
from jawusd.tracking.contour.scan import Scan

_SAMPLES = 8000  # number of surface samples per arch; they are about half a millimetre apart
_SHARE = 0.002  # fraction of the crown surface that is ignored as outliers, such as spikes of the mesh
_DEEPEST_MM = 5.0  # maximum depth of a point inside a crown [mm]: deeper points lie beyond an open border
_SAME_MM = 0.05
_BESIDE_MM = 4.0  # maximum distance in the occlusal plane between opposed crown points [mm]: half the width of a molar
_CELL_MM = 1.0
_THROUGH_MM = 2.0  # minimum vertical overlap of arches that passed through one another [mm]; cusps overlap less
_SLAB_MM = 3.0
_FEWEST = 50  # minimum number of surface samples for a side of an arch to be measured
_ASIDE_MM = 6.0  # minimum distance from the midline of points left or right: nearer ones may be on central incisors
_OPEN = 0.08  # minimum ratio of vector area to area for a surface to count as open [-]
# Limits for the gum to indicate the orientation of a scan: minimum area relative to the crowns [-], and minimum
# vertical distance from the crowns [mm].
_GUM_SHARE, _GUM_BELOW_MM = 0.3, 2.0


@dataclass(frozen=True)
class Occlusion:
    """Measurements of how two arches meet; lengths in mm, NaN if not measurable."""

    gap_mm: float  # minimum distance between the crowns [mm], 0 if they touch
    side_gaps_mm: tuple[float, float]  # gaps left and right of the midline [mm], negative if crowns overlap
    depth_mm: float  # maximum depth by which the crowns overlap [mm]
    # fraction of the common area in the occlusal plane in which lower crowns reach more than 2 mm above the lowest
    # point of the upper ones
    through: float
    same: float  # fraction of the lower surface that coincides with the upper one
    # fraction of crown points directly above or below crowns of the other arch; the larger of the two values
    opposite: float
    aside_mm: float  # distance between the centres of the arches along the occlusal plane [mm]
    turn_rad: float  # angle in the occlusal plane between the forward directions of both arches [rad]
    # per arch, whether its gum lies between its crowns and the other arch; None if unknown
    turned_over: tuple[bool | None, bool | None]
    opens_towards: tuple[bool, bool]  # per arch, whether the open side of its crowns faces the other arch
    midlines_mm: float  # lateral distance between the midlines, where both arches have teeth left and right [mm]
    width_ratio: float  # ratio of the upper to the lower width, measured in the same transverse slabs
    widths_mm: tuple[float, float]  # maximum extent of each arch in its own plane [mm]
    lower_ahead_mm: float  # distance by which the lower front teeth lie in front of the upper ones [mm]


@dataclass(frozen=True, eq=False)
class CrownSurface:
    """Samples of a crown surface."""

    points: Array  # centres of faces [mm], shape (N, 3)
    normals: Array  # outward unit normals, shape (N, 3)
    areas: Array  # areas of these faces [mm^2], shape (N,)
    border: Mask  # whether a sample adjoins an opening of the surface, where the inside is undefined, shape (N,)


def measure_occlusion(scans: Sequence[Scan], T_anatomical_scan: Array) -> Occlusion:
    """Measure how two scans in a common frame meet; `T_anatomical_scan` maps that frame to (left, up, front) axes."""
    surfaces = [crown_surface(scan) for scan in scans]
    crowns = [scan.crown_vertices(_SAMPLES) for scan in scans]
    normal = bite_normal(*crowns)
    left = np.cross(normal, T_anatomical_scan[2, :3])
    left /= np.linalg.norm(left)
    axes = np.stack([left, normal, np.cross(left, normal)])
    upper, lower = (points @ axes.T for points in crowns)
    middle = float(np.mean([np.percentile(points[:, 0], [1, 99]).mean() for points in (upper, lower)]))
    # Distances are computed in both directions: samples of the finer surface find contacts that those of the coarser
    # one miss.
    others = [(surface, cKDTree(surface.points), _DEEPEST_MM) for surface in surfaces[::-1]]
    signed = [signed_distances(own.points, *other)[0] for own, other in zip(surfaces, others, strict=True)]
    nearest = [_weighted_quantile(d, surfaces[k].areas, _SHARE) for k, d in enumerate(signed)]
    midlines_mm, width_ratio = _compare_widths(upper, lower)
    return Occlusion(
        gap_mm=max(0.0, min(nearest)),
        side_gaps_mm=(_side_gap(signed, surfaces, left, middle), _side_gap(signed, surfaces, -left, -middle)),
        depth_mm=max(0.0, -min(nearest)),
        through=_through(upper, lower),
        same=float(np.mean(np.abs(signed[1]) < _SAME_MM)),
        opposite=float(max(_beside(upper, lower).mean(), _beside(lower, upper).mean())),
        aside_mm=float(np.linalg.norm((upper.mean(0) - lower.mean(0))[[0, 2]])),
        turn_rad=float(np.arccos(np.clip(_forward(upper[:, [0, 2]]) @ _forward(lower[:, [0, 2]]), -1.0, 1.0))),
        turned_over=(_turned_over(scans[0], surfaces[0], -normal), _turned_over(scans[1], surfaces[1], normal)),
        opens_towards=(_opens_towards(surfaces[0], -normal), _opens_towards(surfaces[1], normal)),
        midlines_mm=midlines_mm,
        width_ratio=width_ratio,
        widths_mm=(_widest_mm(upper), _widest_mm(lower)),
        lower_ahead_mm=float(np.percentile(lower[:, 2], 99.5) - np.percentile(upper[:, 2], 99.5)),
    )


def crown_surface(scan: Scan) -> CrownSurface:
    """Return surface samples: all crown faces, or about `_SAMPLES` of them."""
    border = np.zeros(len(scan.crown_faces), bool)
    border[scan.edges[scan.edges[:, 3] < 0, 2]] = True
    chosen = slice(None, None, max(1, len(scan.crown_faces) // _SAMPLES))
    corners = scan.vertices[scan.crown_faces[chosen]]
    directed = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(directed, axis=1)
    return CrownSurface(corners.mean(1), directed / np.maximum(areas, 1e-12)[:, None], areas, border[chosen])


def signed_distances(
    points: Array, surface: CrownSurface, tree: cKDTree, deepest_mm: float
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return distances of points (N, 3) from a surface and from its tangent planes, negative inside [mm], and samples.

    `tree` has the points of the surface; those that seem deeper inside than `deepest_mm` lie beyond its border. The
    last result is the index of the nearest sample of the surface.
    """
    distance, nearest = tree.query(points)
    behind = np.einsum("ij,ij->i", points - surface.points[nearest], surface.normals[nearest])
    # Points are inside if they lie behind the surface, and not merely beyond its border.
    inside = (behind < -0.7 * distance) & (distance < deepest_mm) & ~surface.border[nearest]
    return np.where(inside, -distance, distance), behind, nearest


def _through(upper: Array, lower: Array) -> float:
    """Return `Occlusion.through` for crown points (left, up, front) [mm], shapes (N, 3) and (M, 3)."""
    ends = []
    for points, keep in ((upper, np.minimum), (lower, np.maximum)):
        cells, index = np.unique(np.floor(points[:, [0, 2]] / _CELL_MM).astype(int), axis=0, return_inverse=True)
        height = np.full(len(cells), np.inf if keep is np.minimum else -np.inf)
        keep.at(height, index.ravel(), points[:, 1])
        ends.append(dict(zip(map(tuple, cells.tolist()), height.tolist())))
    shared = [ends[1][cell] - ends[0][cell] for cell in ends[0].keys() & ends[1].keys()]
    return float(np.mean(np.array(shared) > _THROUGH_MM)) if shared else 0.0


def _weighted_quantile(values: Array, weights: Array, share: float) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][min(np.searchsorted(total, share * total[-1]), len(values) - 1)])


def _beside(these: Array, others: Array) -> Array:
    """Return whether the other arch has a point above or below each point, shape (N,)."""
    return cKDTree(others[:, [0, 2]]).query(these[:, [0, 2]])[0] < _BESIDE_MM


def _side_gap(signed: Sequence[Array], surfaces: Sequence[CrownSurface], aside: Array, middle: float) -> float:
    """Return the gap between the crowns on one side, in direction `aside` [mm]; NaN if an arch has no teeth there."""
    gaps = []
    for distance, surface in zip(signed, surfaces, strict=True):
        there = surface.points @ aside - middle > _ASIDE_MM
        if np.count_nonzero(there) < _FEWEST:
            return float("nan")
        gaps.append(_weighted_quantile(distance[there], surface.areas[there], 2 * _SHARE))
    return min(gaps)


def _compare_widths(upper: Array, lower: Array) -> tuple[float, float]:
    """Return the lateral distance between the midlines [mm], and the ratio of the arch widths; NaN if unknown."""
    middle = 0.5 * (upper[:, 0].mean() + lower[:, 0].mean())
    apart, ratios = [], []
    for z in np.arange(max(upper[:, 2].min(), lower[:, 2].min()), min(upper[:, 2].max(), lower[:, 2].max()), _SLAB_MM):
        ends = []
        for points in (upper, lower):
            x = points[(points[:, 2] >= z) & (points[:, 2] < z + _SLAB_MM), 0] - middle
            if min(np.count_nonzero(x > _ASIDE_MM), np.count_nonzero(x < -_ASIDE_MM)) < 10:
                break
            ends.append(np.percentile(x, [1, 99]))
        if len(ends) == 2:
            apart.append(ends[0].mean() - ends[1].mean())
            ratios.append(np.ptp(ends[0]) / np.ptp(ends[1]))
    if len(apart) < 3:
        return float("nan"), float("nan")
    return abs(float(np.median(apart))), float(np.median(ratios))


def _forward(flat: Array) -> Array:
    """Return the forward direction, towards the closed end, of a horseshoe of points (N, 2), shape (2,)."""
    flat = flat[:: max(1, len(flat) // 2000)]
    best, found = -np.inf, np.array([0.0, 1.0])
    for angle in np.deg2rad(np.arange(0, 360, 5)):
        ahead = np.array([np.sin(angle), np.cos(angle)])
        depth, lateral = flat @ ahead, flat @ np.array([ahead[1], -ahead[0]])
        lateral = lateral - np.percentile(lateral, [2, 98]).mean()
        left, right = depth[lateral > 0], depth[lateral < 0]
        if min(len(left), len(right)) < 20:
            continue
        symmetry = -np.corrcoef(depth, np.abs(lateral))[0, 1] - abs(left.mean() - right.mean()) / np.std(depth)
        if symmetry > best:
            best, found = symmetry, ahead
    return found


def _widest_mm(points: Array) -> float:
    """Return the larger of the two extents of an arch in its own plane [mm]."""
    axes = np.linalg.svd(points - points.mean(0), full_matrices=False)[2]
    return float(np.ptp(points @ axes[:2].T, axis=0).max())


def _turned_over(scan: Scan, surface: CrownSurface, towards: Array) -> bool | None:
    """Return whether the gum lies between the crowns and the other arch; None without gum."""
    corners = scan.vertices[scan.gum_faces]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if areas.sum() < _GUM_SHARE * surface.areas.sum():
        return None
    gum, crowns = (
        np.average(points, axis=0, weights=weights)
        for points, weights in ((corners.mean(1), areas), (surface.points, surface.areas))
    )
    along = float(towards @ (crowns - gum))
    return None if abs(along) < _GUM_BELOW_MM else along < 0


def _opens_towards(surface: CrownSurface, towards: Array) -> bool:
    """Return whether the open side of a surface faces the other arch.

    The vector area (the integral of the normal) of an open surface points away from the opening.
    """
    directed = (surface.normals * surface.areas[:, None]).sum(0) / surface.areas.sum()
    return bool(towards @ directed < -_OPEN)
