"""The bounds: which jaw parameters are anatomically possible.

The slice hull is a smooth signed distance in mm. Its section at an opening d1 is convex in (d2, d3), the intersection
of the half-planes ``n_k . (d2, d3) <= h_k(d1)``; d1 itself is limited to the captured openings. All constraints are
combined by a soft maximum,

    v_k = n_k . (d2, d3) - h_k(d1),   v_low = d1_first - d1,   v_high = d1 - d1_last,
    distance(d) = softness log sum exp(v / softness) - offset_mm,

which is negative inside, close to the distance in mm near the boundary, and smooth everywhere. The bound of the paper
is two outlines, in (d1, d2) and in (d1, d3), both of which must contain d (Yang et al. 2019).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import EvaluatorError
from jawusd.evaluator.curves import flat_ended
from jawusd.evaluator.formula import BoundFormula

_ARRAYS = ("slice_d1", "slice_directions", "slice_support", "slice_softness_mm", "slice_margin_mm")
# Minimum length of a range [mm]; keeps the normalisation invertible where a section shrinks to a point.
SMALLEST_REACH_MM = 0.5
_NEWTON_ITERATIONS = 60
_ROOT_TOLERANCE_MM = 1e-12
_CANDIDATE_SLICES = 48
# fractions of the distance from a section's centre to its outline; denser near the outline, where nearest points lie
_CANDIDATE_RADII = (0.4, 0.75, 0.9, 0.97, 1.0)


class SliceHull:
    """The slice hull of a rig.

    Attributes:
        supports: h_k(d1) [mm], constant outside the captured openings.
        directions: Unit normals n_k in (d2, d3) around the full circle, shape (K, 2).
        softness_mm: Radius of the rounded edges between half-spaces.
        offset_mm: Distance by which the bound extends beyond its supports.
        first_mm, last_mm: Smallest and largest captured opening.
        slopes: Derivatives of v_k, v_low and v_high by d, shape (K + 2, 3); 0 for v_k by d1, which depend on d1.
        formula: The same bound for one d, evaluated in Python floats.
    """

    def __init__(self, arrays: Mapping[str, Array]) -> None:
        """Build the bound from the named arrays of a rig."""
        knots = np.asarray(arrays["slice_d1"], dtype=float)
        self.supports = flat_ended(knots, np.asarray(arrays["slice_support"], dtype=float))
        self.directions = np.asarray(arrays["slice_directions"], dtype=float)
        self.softness_mm, self.offset_mm = float(arrays["slice_softness_mm"]), float(arrays["slice_margin_mm"])
        self.first_mm, self.last_mm = float(knots[0]), float(knots[-1])
        self.slopes = np.zeros((len(self.directions) + 2, 3))
        self.slopes[:-2, 1:], self.slopes[-2:, 0] = self.directions, (-1.0, 1.0)
        self.formula = BoundFormula({name: np.ravel(arrays[name]).tolist() for name in _ARRAYS})

    def signed_distance(self, d: Array) -> Array:
        """Return the signed distance (n,) of d (n, 3) to the bound [mm]; negative inside."""
        return self._joined(d, self.supports.value(d[:, 0]))[0]

    def signed_distance_gradient(self, d: Array) -> tuple[Array, Array]:
        """Return the signed distance (n,) [mm] and its gradient with respect to d, shape (n, 3)."""
        reach, reach_1 = self.supports.value_and_slope(d[:, 0])
        distance, weights = self._joined(d, reach)
        gradient = weights @ self.slopes
        gradient[:, 0] -= np.einsum("nk,nk->n", weights[:, :-2], reach_1)
        return distance, gradient

    def signed_distance_curvature(self, d: Array) -> tuple[Array, Array, Array]:
        """Return signed distance (n,), gradient (n, 3), and the part of the Hessian due to rounding, (n, 3, 3) [1/mm].

        Without the curvature of the supports along d1, it is positive semidefinite, so that solver steps point
        downhill.
        """
        reach, reach_1 = self.supports.value_and_slope(d[:, 0])
        distance, weights = self._joined(d, reach)
        slopes = np.empty((len(d), *self.slopes.shape))
        slopes[:] = self.slopes
        slopes[:, :-2, 0] = -reach_1
        gradient = (weights[:, None, :] @ slopes)[:, 0]
        slopes -= gradient[:, None, :]
        curvature = np.swapaxes(slopes, 1, 2) @ (slopes * (weights / self.softness_mm)[:, :, None])
        return distance, gradient, curvature

    def chord(self, d: Array, axis: int) -> tuple[Array, Array]:
        """Return the ends [mm] of the valid interval through d (n, 3) along axis 1 or 2; NaN where it is empty."""
        return self._chord_end(d, axis, -1.0), self._chord_end(d, axis, 1.0)

    def nearest_opening(self, d: Array) -> Array:
        """Return d (n, 3) [mm] with openings beyond the ends moved to the nearest valid one, if that is inside."""
        inner = d.copy()
        inner[:, 0] = np.clip(d[:, 0], self.first_mm, self.last_mm)
        closed = self.signed_distance(d) > 0
        moved = np.flatnonzero(closed & (inner[:, 0] != d[:, 0]) & (self.signed_distance(inner) < 0))
        found = d.copy()

        def outside(share: Array) -> Mask:
            return self.signed_distance(inner[moved] + share[:, None] * (d - inner)[moved]) > 0

        share = largest_share(outside, len(moved), _NEWTON_ITERATIONS)
        found[moved] = inner[moved] + share[:, None] * (d - inner)[moved]
        return found

    def _chord_end(self, d: Array, axis: int, sign: float) -> Array:
        # Newton from the edge of the unrounded polygon, which contains the rounded section: the signed distance is
        # convex along the line, so the iterates move inwards without overshooting unless the line misses the section.
        along, across = self.directions[:, axis - 1], self.directions[:, 2 - axis]
        room = self.supports.value(d[:, 0]) + self.offset_mm - d[:, 3 - axis, None] * across
        facing = along * sign > 0
        x = sign * np.min(room[:, facing] / np.abs(along[facing]), axis=1)
        point = d.copy()
        active = np.flatnonzero(np.isfinite(x))
        end = np.full(len(d), np.nan)
        for _ in range(_NEWTON_ITERATIONS):
            point[active, axis] = x[active]
            distance, gradient = self.signed_distance_gradient(point[active])
            slope = gradient[:, axis]
            done = np.abs(distance) <= _ROOT_TOLERANCE_MM
            end[active[done]] = x[active[done]]
            onward = ~done & (slope * sign > 0)
            x[active[onward]] -= distance[onward] / slope[onward]
            active = active[onward]
            if not active.size:
                break
        return end

    def section_centres(self, count: int) -> tuple[Array, Array]:
        """Return up to ``count`` openings (n,) [mm] within the bound, and the centres (n, 2) [mm] of the sections."""
        known = [(d1, outline.mean(axis=0)) for d1, outline in self._sharp_outlines(count)]
        return np.array([d1 for d1, _ in known]), np.array([middle for _, middle in known]).reshape(-1, 2)

    def candidates(self) -> Array:
        """Return starting points (n, 3) [mm] of searches, spread over the valid volume and denser near its surface.

        Raises:
            EvaluatorError: the valid volume is empty.
        """
        points = []
        for d1, outline in self._sharp_outlines(_CANDIDATE_SLICES):
            centre = outline.mean(axis=0)
            reach = np.concatenate([outline, 0.5 * (outline + np.roll(outline, 1, axis=0))]) - centre
            section = np.concatenate([[centre], *(centre + radius * reach for radius in _CANDIDATE_RADII)])
            points.append(np.column_stack([np.full(len(section), d1), section]))
        found = np.concatenate([np.empty((0, 3)), *points])
        valid = self.signed_distance(found) <= 0
        if not valid.any():
            raise EvaluatorError(
                "the bound of this rig leaves no valid jaw parameters.", hint="Fit the model again with a wider margin."
            )
        return found[valid]

    def _sharp_outlines(self, count: int) -> list[tuple[float, Array]]:
        """Return openings and the outlines (n, 2) of their unrounded sections that are not empty."""
        reach = self.offset_mm - self.softness_mm  # because of the rounding, sections shrink to points at both ends
        openings = np.linspace(self.first_mm - reach, self.last_mm + reach, count)
        found = [(d1, self._sharp_outline(d1)) for d1 in openings]
        return [(d1, outline) for d1, outline in found if len(outline)]

    def _sharp_outline(self, d1: float) -> Array:
        """Return the corners (n, 2) of the section's unrounded polygon at d1, in order of angle."""
        reach = self.supports.value(np.array([d1]))[0] + self.offset_mm
        i, j = np.triu_indices(len(self.directions), 1)
        a, b = self.directions[i], self.directions[j]
        cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        meet = np.abs(cross) > 1e-9
        i, j, a, b, cross = i[meet], j[meet], a[meet], b[meet], cross[meet]
        x = (reach[i] * b[:, 1] - reach[j] * a[:, 1]) / cross
        y = (reach[j] * a[:, 0] - reach[i] * b[:, 0]) / cross
        corners = np.stack([x, y], axis=1)
        corners = corners[(corners @ self.directions.T <= reach + 1e-9).all(axis=1)]
        from_centre = corners - corners.mean(axis=0) if len(corners) else corners
        return corners[np.argsort(np.arctan2(from_centre[:, 1], from_centre[:, 0]))]

    def _joined(self, d: Array, reach: Array) -> tuple[Array, Array]:
        """Return the signed distance (n,) [mm] and the weight (n, K + 2) of each half-space, for supports (n, K)."""
        v = np.empty((len(d), len(self.directions) + 2))
        np.matmul(d[:, 1:], self.directions.T, out=v[:, :-2])
        v[:, :-2] -= reach
        np.subtract(self.first_mm, d[:, 0], out=v[:, -2])
        np.subtract(d[:, 0], self.last_mm, out=v[:, -1])
        peak = v.max(axis=1)
        v -= peak[:, None]
        v /= self.softness_mm
        np.exp(v, out=v)
        total = v.sum(axis=1)
        v /= total[:, None]
        return peak + self.softness_mm * np.log(total) - self.offset_mm, v


def largest_share(outside: Callable[[Array], Mask], count: int, iterations: int) -> Array:
    """Return, by bisection, the largest fractions (count,) in [0, 1] for which ``outside`` is false."""
    low, high = np.zeros(count), np.ones(count)
    for _ in range(iterations if count else 0):
        share = 0.5 * (low + high)
        out = outside(share)
        high, low = np.where(out, share, high), np.where(out, low, share)
    return low


class Ranges(NamedTuple):
    """Valid ranges of d2 and d3 [mm], each varied alone, shape (...); NaN where empty."""

    d2_min: Array
    d2_max: Array
    d3_min: Array
    d3_max: Array


class PolygonBound:
    """The bound of the paper: two alpha shapes."""

    def __init__(self, arrays: Mapping[str, Array]) -> None:
        """Build the bound from the named arrays of a rig."""
        # edges (e, 2, 2) of the outlines in (d1, d2) and in (d1, d3) [mm], each as its start and end point
        self.opening_lateral = _edges(arrays["polygon_d1d2"], arrays["polygon_d1d2_counts"])
        self.opening_protrusion = _edges(arrays["polygon_d1d3"], arrays["polygon_d1d3_counts"])

    def signed_distance(self, d: Array) -> Array:
        """Return the larger of the signed distances (n,) [mm] of d (n, 3) to the two outlines; negative inside both."""
        lateral = _distance_to_edges(d[:, [0, 1]], self.opening_lateral)
        return np.maximum(lateral, _distance_to_edges(d[:, [0, 2]], self.opening_protrusion))


def _edges(vertices: Array, counts: Array) -> Array:
    """Return the edges (e, 2, 2) of consecutive closed rings."""
    rings = np.split(vertices, np.cumsum(counts)[:-1].astype(int))
    return np.concatenate([np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings])


def _distance_to_edges(points: Array, edges: Array) -> Array:
    """Return the signed distance (n,) of points (n, 2) to edges, negative inside (even-odd rule); NaN for NaN."""
    start, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    x, y = points[:, 0, None], points[:, 1, None]
    rx, ry = x - start[:, 0], y - start[:, 1]
    length_squared = np.maximum(np.einsum("ei,ei->e", along, along), np.finfo(float).tiny)
    s = np.clip((rx * along[:, 0] + ry * along[:, 1]) / length_squared, 0.0, 1.0)
    distance = np.sqrt(np.min((rx - s * along[:, 0]) ** 2 + (ry - s * along[:, 1]) ** 2, axis=1))
    # a ray from the point to +x crosses an edge if its ends lie on both sides of the ray, and the point to its left
    crosses = (edges[:, 0, 1] > y) != (edges[:, 1, 1] > y)
    left = (rx * along[:, 1] < ry * along[:, 0]) == (along[:, 1] > 0)
    inside = np.count_nonzero(crosses & left, axis=1) % 2 == 1
    return np.where(inside, -distance, distance)
