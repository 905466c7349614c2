"""The paper's bound: an outline in (d1, d2) and one in (d1, d3), both of which must hold d (Yang et al. 2019)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array


@dataclass(frozen=True)
class PolygonBound:
    """The two alpha shapes of a rig.

    Attributes:
        opening_lateral: Edges of the outlines in (d1, d2) [mm], start and end, shape (e, 2, 2).
        opening_protrusion: Edges of the outlines in (d1, d3) [mm], shape (f, 2, 2).
    """

    opening_lateral: Array
    opening_protrusion: Array

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> PolygonBound:
        """Build the bound from the named arrays of a rig."""
        return cls(
            _edges(arrays["polygon_d1d2"], arrays["polygon_d1d2_counts"]),
            _edges(arrays["polygon_d1d3"], arrays["polygon_d1d3_counts"]),
        )

    def signed_distance(self, d: Array) -> Array:
        """Return how far outside the worse of the two outlines d (n, 3) lies [mm], shape (n,); negative inside."""
        lateral = _distance_to_edges(d[:, [0, 1]], self.opening_lateral)
        return np.maximum(lateral, _distance_to_edges(d[:, [0, 2]], self.opening_protrusion))


def _edges(vertices: Array, counts: Array) -> Array:
    """Return the edges (e, 2, 2) of closed rings given one after the other."""
    rings = np.split(vertices, np.cumsum(counts)[:-1].astype(int))
    return np.concatenate([np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings])


def _distance_to_edges(points: Array, edges: Array) -> Array:
    """Return the distance (n,) of points (n, 2) to the edges, negative inside by the even-odd rule; NaN for NaN."""
    start, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    x, y = points[:, 0, None], points[:, 1, None]
    rx, ry = x - start[:, 0], y - start[:, 1]
    length_squared = np.maximum(np.einsum("ei,ei->e", along, along), np.finfo(float).tiny)
    s = np.clip((rx * along[:, 0] + ry * along[:, 1]) / length_squared, 0.0, 1.0)
    distance = np.sqrt(np.min((rx - s * along[:, 0]) ** 2 + (ry - s * along[:, 1]) ** 2, axis=1))
    # a ray to +x crosses an edge whose ends lie on both sides of it, if the point is left of the edge
    crosses = (edges[:, 0, 1] > y) != (edges[:, 1, 1] > y)
    left = (rx * along[:, 1] < ry * along[:, 0]) == (along[:, 1] > 0)
    inside = np.count_nonzero(crosses & left, axis=1) % 2 == 1
    return np.where(inside, -distance, distance)
