"""Teeth that are together touch: what that says about a bite."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array
from jawusd.geometry import transform_points
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.initialization.occlusion import crown_surface

# How far apart or into one another the nearest parts of two scanned rows are when the teeth are together [mm].
_SIGMA_MM = 0.15
_SHARE = 0.04  # of the lower crowns on a side: what touches there
_REACH_MM = 3.0  # farther inside, a point is past the base of a crown


class Contact:
    """Draw both rows together until they touch on the left and on the right."""

    def __init__(self, scans: Sequence[Scan]) -> None:
        """Prepare the surfaces of the upper and the lower crowns."""
        self._upper, self._lower = (crown_surface(scan) for scan in scans)
        self._tree = cKDTree(self._upper.points)
        centred = self._lower.points - scans[1].centre
        # The longest axis of a row runs from left to right, unless half of it is missing: then either half is a side.
        across = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        self._sides = [across > np.percentile(across, 60), across < np.percentile(across, 40)]

    def equations(self, T_upper_lower: Array, centre: Array) -> tuple[Array, Array, Array]:
        """Return slopes (N, 6) by a twist of the bite about `centre`, distances [mm] and weights [1/mm^2]."""
        points = transform_points(T_upper_lower, self._lower.points)
        away, normals = self._signed(points)
        slopes, residuals, weights = [], [], []
        for side in self._sides:
            own = np.flatnonzero(side)
            touching = own[np.argsort(away[own])[: max(1, int(_SHARE * len(own)))]]
            slopes.append(np.hstack([np.cross(points[touching] - centre, normals[touching]), normals[touching]]))
            residuals.append(away[touching])
            weights.append(np.full(len(touching), _SIGMA_MM**-2 / len(touching)))
        return np.vstack(slopes), np.concatenate(residuals), np.concatenate(weights)

    def depth_mm(self, T_upper_lower: Array) -> float:
        """Return how deep crowns run into one another where they do so most, but for a speck [mm]."""
        away, _ = self._signed(transform_points(T_upper_lower, self._lower.points))
        return max(0.0, -float(np.percentile(away, 0.2)))

    def _signed(self, points: Array) -> tuple[Array, Array]:
        """Return distances from the upper crowns, negative inside [mm], shape (N,), and the normals there (N, 3)."""
        distance, index = self._tree.query(points)
        normals = self._upper.normals[index]
        off = points - self._upper.points[index]
        behind = np.einsum("ij,ij->i", off, normals)
        inside = (behind < -0.7 * distance) & (distance < _REACH_MM) & ~self._upper.border[index]
        # Close by, the plane is a better surface than its nearest piece.
        away = np.where(distance < 1.0, behind, np.where(inside, -distance, distance))
        return away, normals
