"""Checks on the two teeth scans together: are they in occlusion, and is the upper one the upper one?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from jawusd.errors import TrackingError
from jawusd.geometry import anatomical_frame, transform_points
from jawusd.geometry.arrays import Array
from jawusd.tracking.contour.scan import Scan

# Teeth in occlusion touch. Scans taken slightly open, or a bite registered carelessly, stay within the first limit;
# beyond the second one the scans are not in one frame [mm].
_LOOSE_MM, _APART_MM = 1.0, 4.0
# Depth to which crowns may run into one another: registrations overlap by some tenths of a millimetre [mm].
_TIGHT_MM, _THROUGH_MM = 1.0, 3.0
# Distance of the middles of both arches along the bite plane: a severe malocclusion stays below [mm].
_ASIDE_MM = 15.0
_MIDLINES_MM = 4.0
# Height of the middle of the upper crowns above that of the lower ones: 5 mm or more in any bite [mm].
_LEAST_HEIGHT_MM = 2.5
_SHARE = 0.005  # of the crown vertices that may be exceptions


def check_occlusion(scans: Sequence[Scan], T_anatomical_scan: ArrayLike | None) -> tuple[Array, list[str]]:
    """Check that both arches lie in one frame, in occlusion; return T_anatomical_scan (4, 4) and odd findings.

    `T_anatomical_scan` maps the scan frame to (left, up, front) axes; None derives it. Findings are one sentence each.

    Raises:
        TrackingError: the arches are far apart, beside one another, or inside one another.
    """
    crowns = [scan.crown_vertices(6000) for scan in scans]
    near, depth = _gap_mm(crowns), _overlap_mm(scans)
    hint = "Export both scans in one coordinate frame with the teeth in occlusion (closed bite)."
    if near > _APART_MM:
        raise TrackingError(
            f"the upper and lower teeth scans are not in occlusion: they are {near:.1f} mm apart where they are "
            f"closest, at most {_APART_MM:g} mm are allowed",
            hint=hint,
        )
    if depth > _THROUGH_MM:
        raise TrackingError(
            f"the upper and lower teeth scans are not in occlusion: their crowns run {depth:.1f} mm into one another, "
            f"at most {_THROUGH_MM:g} mm are allowed",
            hint=hint,
        )
    given = T_anatomical_scan is not None
    # The thin direction of the upper arch alone: that of both arches means little while they are not known to meet.
    up = np.array(T_anatomical_scan, np.float64)[1, :3] if given else _thin_direction(crowns[0])
    between = crowns[0].mean(0) - crowns[1].mean(0)
    height, aside = float(up @ between), float(np.linalg.norm(between - up * (up @ between)))
    # The side of its gum tells a lower arch above the upper one from scans whose axes are turned over.
    height = abs(height) if (side := _gum_side(scans[0], up)) == 0 else height * side
    if height < _LEAST_HEIGHT_MM:
        raise TrackingError(
            f"the upper and lower teeth scans are not in occlusion: the middle of the upper crowns lies {height:.1f} "
            f"mm above that of the lower ones, at least {_LEAST_HEIGHT_MM:g} mm are needed",
            hint=hint,
        )
    if aside > _ASIDE_MM:
        raise TrackingError(
            f"the upper and lower teeth scans are not in occlusion: their arches lie {aside:.0f} mm beside one "
            f"another, at most {_ASIDE_MM:g} mm are allowed",
            hint=hint,
        )
    T = np.array(T_anatomical_scan, np.float64) if given else anatomical_frame(*crowns)
    upper, lower = (transform_points(T, c) for c in crowns)
    sideways = abs(_midline(upper) - _midline(lower))
    findings = []
    if near > _LOOSE_MM:
        findings.append(f"the scans do not touch: {near:.1f} mm apart where they are closest")
    if depth > _TIGHT_MM:
        findings.append(f"the crowns of the scans run {depth:.1f} mm into one another")
    if sideways > _MIDLINES_MM:
        findings.append(f"the middles of the two arches lie {sideways:.1f} mm apart sideways")
    if _width(lower) > _width(upper) and lower[:, 2].max() > upper[:, 2].max():
        findings.append("the lower arch encloses the upper one: an underbite, or exchanged scan files")
    return T, findings


def _gum_side(scan: Scan, up: Array) -> float:
    """Return on which side of its crowns an arch has its gum: 1 towards `up`, -1 away from it, 0 if it has none."""
    if not scan.painted or not len(scan.gum_faces):
        return 0.0
    gum, crowns = (scan.vertices[np.unique(faces)].mean(0) for faces in (scan.gum_faces, scan.crown_faces))
    return float(np.sign(up @ (gum - crowns)))


def _gap_mm(crowns: Sequence[Array]) -> float:
    """Return the distance of the vertices that are closest to the other arch [mm]."""
    distance = cKDTree(crowns[0]).query(crowns[1])[0]
    return float(np.quantile(distance, _SHARE))


def _overlap_mm(scans: Sequence[Scan]) -> float:
    """Return how deep the lower crowns run into the upper ones, which must be wound outwards [mm]."""
    if not scans[0].painted:
        return 0.0  # without paint nothing says which side of the surface is inside
    faces, vertices = scans[0].crown_faces, scans[0].vertices
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    points = scans[1].crown_vertices(6000)
    distance, nearest = cKDTree(corners.mean(1)).query(points)
    behind = np.einsum("ij,ij->i", points - corners.mean(1)[nearest], normals[nearest])
    # Behind the surface and not merely past its border.
    inside = np.where(behind < -0.7 * distance, distance, 0.0)
    return float(np.quantile(inside, 1.0 - _SHARE))


def _thin_direction(points: Array) -> Array:
    """Return the direction in which an arch extends least, shape (3,)."""
    return np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]


def _midline(points: Array) -> float:
    """Return the middle of an arch from side to side [mm]."""
    return float(np.percentile(points[:, 0], [1, 99]).mean())


def _width(points: Array) -> float:
    low, high = np.percentile(points[:, 0], [1, 99])
    return float(high - low)
