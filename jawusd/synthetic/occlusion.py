"""Contact of the two arches: vertical gaps between the occlusal surfaces in any pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jawusd.geometry import transform_points
from jawusd.geometry.arrays import Array
from jawusd.synthetic.dental_arch import DentalArch

_CELL_MM = 0.2
_SAMPLES_PER_EDGE = 5


class Occlusion:
    """The occlusal side of the upper crowns as a height map, and the vertices of the lower crowns."""

    def __init__(self, upper: DentalArch, lower: DentalArch) -> None:
        """Map the upper crowns; both arches in the scan frame, in occlusion."""
        samples = _samples(upper)
        self._low = samples[:, [0, 2]].min(0)
        cells = np.floor((samples[:, [0, 2]] - self._low) / _CELL_MM).astype(int)
        self._map = np.full(cells.max(0) + 1, np.inf)
        np.minimum.at(self._map, tuple(cells.T), samples[:, 1])
        self._points = lower.mesh.vertices
        self._tooth = lower.tooth

    def gaps(self, T_skull_mandible: ArrayLike) -> Array:
        """Return the smallest vertical gap of each lower tooth to the upper crowns [mm] in one pose (4, 4).

        Shape (2, 7), left 1..7 then right 1..7; negative inside a crown, inf for a tooth without an upper crown above.
        """
        teeth = [[side * (k + 1) for k in range(7)] for side in (1, -1)]
        return np.array([[self._gap(T_skull_mandible, self._points[self._tooth == k]) for k in half] for half in teeth])

    def gap(self, T_skull_mandible: ArrayLike) -> float:
        """Return the smallest vertical gap between the arches [mm] in one pose (4, 4)."""
        return self._gap(T_skull_mandible, self._points[self._tooth != 0])

    def _gap(self, T: ArrayLike, points: Array) -> float:
        moved = transform_points(T, points)
        cells = np.floor((moved[:, [0, 2]] - self._low) / _CELL_MM).astype(int)
        inside = np.all((cells >= 0) & (cells < self._map.shape), axis=1)
        if not inside.any():
            return float("inf")
        return float((self._map[tuple(cells[inside].T)] - moved[inside, 1]).min())


def _samples(arch: DentalArch) -> Array:
    """Points spread over all crown triangles, closer than a cell, (N, 3)."""
    faces = arch.mesh.faces[arch.tooth[arch.mesh.faces[:, 0]] != 0]
    corners = arch.mesh.vertices[faces]
    n = _SAMPLES_PER_EDGE
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    keep = i + j <= n
    u, v = i[keep] / n, j[keep] / n
    weights = np.stack([1.0 - u - v, u, v], -1)
    return np.einsum("pk,fkc->fpc", weights, corners).reshape(-1, 3)
