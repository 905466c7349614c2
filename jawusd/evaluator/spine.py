"""The spine of a bound: a line inside it, towards which poses outside are moved.

The nearest valid point jumps where the bound is concave. Moving towards the spine instead is continuous: every section
across the spine is convex, so the path from a pose outside enters the section at exactly one point.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import EvaluatorError
from jawusd.evaluator.batching import in_chunks, pairs_in_chunks
from jawusd.evaluator.bounds import SliceHull, largest_share
from jawusd.evaluator.curves import interpolate_linear

INSET_MM = 0.01  # depth [mm] to which points are moved inside, so that lines between samples stay inside

_SLICES = 97
_CAP_MM = 0.3  # depth of the spine's ends below the surface; openings beyond the ends are clamped
_NEWTON, _BISECTIONS = 40, 40
_MIN_DEPTH = 0.25  # minimum depth of a spine moved into a box, relative to its original depth
_ENTRY_TOLERANCE_MM = 1e-10


@dataclass(frozen=True)
class Spine:
    """A line inside a bound, with one point (d2, d3) for every opening."""

    d1: Array  # increasing openings, shape (n,) [mm]
    middle: Array  # (d2, d3) at each opening, shape (n, 2) [mm]; the habitual path (0, 0) where that is deep inside

    @classmethod
    @lru_cache(maxsize=16)
    def of(cls, bound: SliceHull) -> Spine:
        """Find the spine of a bound; recent results are cached.

        Raises:
            EvaluatorError: the bound is empty.
        """
        d1, centres = bound.section_centres(_SLICES)
        depth = -distances(bound, np.column_stack([d1, centres]))
        deep = depth >= min(_CAP_MM, 0.5 * depth.max(initial=0.0))
        if not len(d1) or depth.max() <= 0:
            raise EvaluatorError("the bound of the rig is empty: no jaw parameters are valid.")
        d1, centres, depth = d1[deep], centres[deep], depth[deep]
        return cls(d1, _moved_inside(bound, d1, centres, np.zeros_like(centres), 0.5 * depth))

    def towards(self, bound: SliceHull, low: Array, high: Array) -> Spine:
        """Return the spine moved into a box of (d2, d3) [mm] as far as it stays deep inside the bound.

        Paths from points in the box to this spine stay in the box.
        """
        aim = np.clip(self.middle, low, high)
        depth = -distances(bound, np.column_stack([self.d1, self.middle]))
        return Spine(self.d1, _moved_inside(bound, self.d1, self.middle, aim, _MIN_DEPTH * depth))

    def at(self, d1: Array) -> tuple[Array, Array]:
        """Return the openings (n,) [mm] clipped to the spine, and its points there (n, 2) [mm]."""
        kept = np.clip(d1, self.d1[0], self.d1[-1])
        return kept, interpolate_linear(self.d1, self.middle, kept)


def distances(bound: SliceHull, d: Array) -> Array:
    """Return the signed distance (n,) [mm] of d (n, 3) to the bound, computed in chunks."""
    return in_chunks(bound.signed_distance, d)


def _moved_inside(bound: SliceHull, d1: Array, start: Array, aim: Array, depth: Array) -> Array:
    """Return the points (n, 2) [mm] at openings (n,) moved from ``start`` towards ``aim`` while they keep a depth."""
    free = -distances(bound, np.column_stack([d1, aim])) >= depth

    def shallow(share: Array) -> Mask:
        return -distances(bound, np.column_stack([d1, start + share[:, None] * (aim - start)])) < depth

    share = np.where(free, 1.0, largest_share(shallow, len(d1), _BISECTIONS))
    return start + share[:, None] * (aim - start)


def moved_to_spine(bound: SliceHull, spine: Spine, d: Array, least_mm: float = 0.0) -> Array:
    """Return d (n, 3) [mm], with rows of a margin below `least_mm` moved towards the spine, continuously in d.

    First d2 and d3 move towards the spine at that opening, then an opening beyond the ends of the spine moves towards
    them.
    """
    out = np.flatnonzero(distances(bound, d) > -least_mm)
    found = d.copy()
    if not out.size:
        return found
    depth = max(least_mm, INSET_MM)
    opening, middle = spine.at(d[out, 0])
    offset = d[out, 1:] - middle
    share = _entry(bound, np.column_stack([opening, middle]), np.column_stack([np.zeros(len(out)), offset]), depth)
    found[out] = np.column_stack([opening, middle + share[:, None] * offset])
    capped = out[opening != d[out, 0]]
    beyond = np.zeros((len(capped), 3))
    beyond[:, 0] = d[capped, 0] - found[capped, 0]

    def outside(share: Array) -> Mask:
        return distances(bound, found[capped] + share[:, None] * beyond) > -depth

    found[capped] += largest_share(outside, len(capped), _BISECTIONS)[:, None] * beyond
    return found


def _entry(bound: SliceHull, start: Array, offset: Array, depth: float) -> Array:
    """Return the largest fractions (n,) of offsets (n, 3) from points inside that keep a depth [mm], by Newton."""
    share = np.ones(len(start))
    active = np.arange(len(start))
    for _ in range(_NEWTON):
        at = start[active] + share[active, None] * offset[active]
        distance, gradient = pairs_in_chunks(bound.signed_distance_gradient, at)
        slope = np.einsum("ni,ni->n", gradient, offset[active])
        excess = distance + depth
        onward = (excess > _ENTRY_TOLERANCE_MM) & (slope > 0)
        active = active[onward]
        if not active.size:
            break
        share[active] = np.maximum(share[active] - excess[onward] / slope[onward], 0.0)
    return share
