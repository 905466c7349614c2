"""Bring motions inside the bound, continuously and no faster than they were.

The nearest valid point jumps where the bound is hollow, and slides faster than the motion where it is bent. So a motion
is not projected but drawn towards the spine of the bound, a line from its lowest to its highest opening that stays well
inside: every section across it is convex, hence a pose outside has exactly one point where its way to the spine enters
the section, which moves continuously with the pose. Where the way along the bound is longer than the motion's own, it
is cut short across the inside; then the motion runs along it with what it may run at each moment, as near as possible
to where it would be (the mean of the two envelopes of McShane and Whitney 1934).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.base.errors import EvaluatorError
from jawusd.evaluator.batching import in_chunks, pairs_in_chunks
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.ways import INSET_MM, along, lengths, short_enough

MOST_STRETCH = 1.045  # a step inside may be this much longer than the motion's own: 5 %, with room for rounding

_SLICES = 97
_CAP_MM = 0.3  # depth of the spine's ends below the surface; there, the opening itself is limited
_NEWTON, _BISECTIONS = 40, 40
_FINE_MM = 0.2  # length of the pieces that a motion is looked at in
_MOST_PIECES = 400  # of one step
_STEEPEST = 5.0  # bound on how fast the margin changes along d: steps farther inside than this many lengths stay so
_LEAST_DEPTH = 0.25  # of the spine moved into a box, as a share of what it had
_STILL_MM = 1e-12
_USED = 0.998  # of the time for a way, which grows a little when it is looked at closer
_CHECKED_MM, _DOUBTFUL_MM, _MOST_ROUNDS, _ROUNDING_MM = 0.03, 1e-3, 8, 1e-9


class Inside(NamedTuple):
    """A motion inside the bound.

    Attributes:
        times: Times of its samples, those given among them, shape (n,); more only where straight lines between the
            samples given would leave the bound.
        d: Jaw parameters at these times [mm], linear in between, shape (n, 3).
        given: Which samples are those given, shape (n,).
    """

    times: Array
    d: Array
    given: Mask


@dataclass(frozen=True)
class Spine:
    """A line inside the bound, one point (d2, d3) for every opening.

    Attributes:
        d1: Openings, rising, shape (n,) [mm].
        middle: (d2, d3) at each, on the habitual path (0, 0) where that is well inside, shape (n, 2) [mm].
    """

    d1: Array
    middle: Array

    @classmethod
    @lru_cache(maxsize=16)
    def of(cls, bound: SliceHull) -> Spine:
        """Find the spine of a bound; that of one looked at before is kept.

        Raises:
            EvaluatorError: the bound is empty.
        """
        d1, centres = bound.section_centres(_SLICES)
        depth = -_distance(bound, np.column_stack([d1, centres]))
        deep = depth >= min(_CAP_MM, 0.5 * depth.max(initial=0.0))
        if not len(d1) or depth.max() <= 0:
            raise EvaluatorError("the bound of the rig is empty: no jaw parameters are valid.")
        d1, centres, depth = d1[deep], centres[deep], depth[deep]
        return cls(d1, _as_far_inside(bound, d1, centres, np.zeros_like(centres), 0.5 * depth))

    def towards(self, bound: SliceHull, low: Array, high: Array) -> Spine:
        """Return the spine moved into a box of (d2, d3) [mm], (2,) each, as far as it stays deep inside.

        Ways from points in the box to such a spine stay in the box.
        """
        aim = np.clip(self.middle, low, high)
        depth = -_distance(bound, np.column_stack([self.d1, self.middle]))
        return Spine(self.d1, _as_far_inside(bound, self.d1, self.middle, aim, _LEAST_DEPTH * depth))

    def at(self, d1: Array) -> tuple[Array, Array]:
        """Return the openings (n,) [mm] limited to those of the spine, and its points there (n, 2) [mm]."""
        kept = np.clip(d1, self.d1[0], self.d1[-1])
        return kept, np.stack([np.interp(kept, self.d1, column) for column in self.middle.T], axis=1)


def _as_far_inside(bound: SliceHull, d1: Array, start: Array, aim: Array, depth: Array) -> Array:
    """Return the points (n, 2) [mm] at openings (n,) from ``start`` towards ``aim``, as far as they keep a depth."""
    low, high = np.zeros(len(d1)), np.ones(len(d1))
    free = -_distance(bound, np.column_stack([d1, aim])) >= depth
    for _ in range(_BISECTIONS):
        share = 0.5 * (low + high)
        shallow = -_distance(bound, np.column_stack([d1, start + share[:, None] * (aim - start)])) < depth
        high, low = np.where(shallow, share, high), np.where(shallow, low, share)
    return start + np.where(free, 1.0, low)[:, None] * (aim - start)


def drawn_inside(bound: SliceHull, spine: Spine, d: Array, least_mm: float = 0.0) -> Array:
    """Return d (n, 3) [mm], and for those with a smaller margin than `least_mm` a point towards the spine.

    A continuous function of d: first d2 and d3 shrink towards the spine at that opening, then an opening beyond the
    ends of the spine is limited.
    """
    out = np.flatnonzero(_distance(bound, d) > -least_mm)
    found = d.copy()
    if not out.size:
        return found
    depth = max(least_mm, INSET_MM)
    opening, middle = spine.at(d[out, 0])
    way = d[out, 1:] - middle
    share = _entry(bound, np.column_stack([opening, middle]), np.column_stack([np.zeros(len(out)), way]), depth)
    found[out] = np.column_stack([opening, middle + share[:, None] * way])
    capped = out[opening != d[out, 0]]
    beyond = np.zeros((len(capped), 3))
    beyond[:, 0] = d[capped, 0] - found[capped, 0]
    low, high = np.zeros(len(capped)), np.ones(len(capped))
    for _ in range(_BISECTIONS):
        share = 0.5 * (low + high)
        far = _distance(bound, found[capped] + share[:, None] * beyond) > -depth
        high, low = np.where(far, share, high), np.where(far, low, share)
    found[capped] += low[:, None] * beyond
    return found


def _entry(bound: SliceHull, start: Array, way: Array, depth: float) -> Array:
    """Return the largest share (n,) of the ways (n, 3) from points inside that ends at a depth [mm] or deeper.

    Newton from the far end: the signed distance is convex along a way across a section, so no step goes too far.
    """
    share = np.ones(len(start))
    active = np.arange(len(start))
    for _ in range(_NEWTON):
        at = start[active] + share[active, None] * way[active]
        distance, gradient = pairs_in_chunks(bound.signed_distance_gradient, at)
        slope = np.einsum("ni,ni->n", gradient, way[active])
        left = distance + depth
        onward = (left > 1e-10) & (slope > 0)
        active = active[onward]
        if not active.size:
            break
        share[active] = np.maximum(share[active] - left[onward] / slope[onward], 0.0)
    return share


def kept_inside(bound: SliceHull, times: Array, d: Array, *, ends_stay: bool = False) -> Inside:
    """Bring a motion inside the bound, at its samples and in between.

    Args:
        times: Rising, shape (F,).
        d: Jaw parameters [mm], finite, linear between the times, shape (F, 3).
        ends_stay: Where every way inside is too long, run it faster than that, rather than to take time from the
            motion before and after.

    Returns:
        The motion inside: where it is inside all the time as given, elsewhere with no step more than 5 % longer than
        the motion's own.

    Raises:
        EvaluatorError: the bound is empty.
    """
    if len(d) == 1:
        return Inside(times, drawn_inside(bound, Spine.of(bound), d), np.array([True]))
    spine = Spine.of(bound).towards(bound, d[:, 1:].min(axis=0), d[:, 1:].max(axis=0))
    fine, wanted, given = _pieces(bound, times, d)
    drawn = drawn_inside(bound, spine, wanted, 0.0)
    between = ~given
    drawn[between] = drawn_inside(bound, spine, wanted[between], INSET_MM)
    outside = _distance(bound, wanted) > 0
    allowed = MOST_STRETCH * lengths(wanted)
    for first, last in _runs((drawn != wanted).any(axis=1)):
        run = slice(first, last + 1)
        if outside[run].any():
            drawn[run] = drawn_inside(bound, spine, short_enough(bound, drawn[run], allowed[run]))
            if not ends_stay:
                first, last = _with_time(drawn, allowed, first, last)
                run = slice(first, last + 1)
            drawn[run] = _in_pace(bound, spine, drawn[run], allowed[run], ends_stay)
    return _without_gaps(bound, spine, _thinned(bound, fine, drawn, given))


def _pieces(bound: SliceHull, times: Array, d: Array) -> tuple[Array, Array, Mask]:
    """Return times (n,), d (n, 3) and which are given: the samples, and short pieces where the bound is near."""
    length = np.linalg.norm(np.diff(d, axis=0), axis=1)
    margin = -_distance(bound, d)
    near = np.minimum(margin[:-1], margin[1:]) < _STEEPEST * length
    count = np.where(near, np.clip(np.ceil(length / _FINE_MM), 1, _MOST_PIECES), 1).astype(int)
    index = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)) / count[index]
    fine = np.append(times[index] + share * np.diff(times)[index], times[-1])
    wanted = np.concatenate([d[index] + share[:, None] * np.diff(d, axis=0)[index], d[-1:]])
    given = np.append(share == 0.0, True)
    return fine, wanted, given


def _distance(bound: SliceHull, d: Array) -> Array:
    return in_chunks(bound.signed_distance, d)


def _runs(moved: Mask) -> list[tuple[int, int]]:
    """Return first and last index of each run, with the neighbours that stay where they are."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], moved, [False]]).astype(np.int8)))
    return [(max(int(a) - 1, 0), min(int(b), len(moved) - 1)) for a, b in zip(edges[::2], edges[1::2])]


def _with_time(path: Array, allowed: Array, first: int, last: int) -> tuple[int, int]:
    """Return the run widened to where the motion has had, and has, the time for its way; at most to all of it."""
    reach, end = max(last - first, 1), len(path) - 1
    while (first > 0 or last < end) and lengths(path[first : last + 1])[-1] > _USED * (allowed[last] - allowed[first]):
        first, last, reach = max(first - reach, 0), min(last + reach, end), 2 * reach
    return first, last


def _in_pace(bound: SliceHull, spine: Spine, path: Array, allowed: Array, ends_stay: bool) -> Array:
    """Return the points of a path (n, 3) that a motion may be at which may run so far (n,) [mm] up to each.

    The ends stay where they are, unless the time is too short for all of the way and they need not.
    """
    allowed = allowed - allowed[0]
    if (np.diff(lengths(path)) <= np.diff(allowed) + _STILL_MM).all():
        return path
    closer = _without_gaps(bound, spine, Inside(np.arange(float(len(path))), path, np.full(len(path), True)))
    whole_way = lengths(closer.d)
    way = whole_way[closer.given]
    if ends_stay and way[-1] > allowed[-1]:
        allowed = way[-1] * (allowed / allowed[-1] if allowed[-1] > 0 else np.linspace(0.0, 1.0, len(way)))
    above, below = way + allowed, way - allowed
    ahead = np.maximum(np.maximum.accumulate(above) - allowed, np.maximum.accumulate(below[::-1])[::-1] + allowed)
    behind = np.minimum(np.minimum.accumulate(below) + allowed, np.minimum.accumulate(above[::-1])[::-1] - allowed)
    at = 0.5 * (ahead + behind)
    if way[-1] <= allowed[-1]:
        at = np.clip(at, way[-1] - (allowed[-1] - allowed), allowed)
    return along(closer.d, whole_way, np.clip(at, 0.0, way[-1]))


def _thinned(bound: SliceHull, times: Array, d: Array, given: Mask) -> Inside:
    """Return the samples given, and as many of the others as keep the lines between them inside."""
    keep = given.copy()
    while True:
        kept = np.flatnonzero(keep)
        gaps = np.flatnonzero(np.diff(kept) > 1)
        first, last = kept[gaps], kept[gaps + 1]
        leaves = _leaves(bound, d[first], d[last])
        if not leaves.any():
            return Inside(times[keep], d[keep], given[keep])
        keep[(first[leaves] + last[leaves]) // 2] = True


def _without_gaps(bound: SliceHull, spine: Spine, motion: Inside) -> Inside:
    """Return the motion with samples added where a line between two still leaves the bound: a last, thin slice."""
    for _ in range(_MOST_ROUNDS):
        times, d, given = motion
        leaves = np.flatnonzero(_leaves(bound, d[:-1], d[1:]))
        if not leaves.size:
            break
        middles = drawn_inside(bound, spine, 0.5 * (d[leaves] + d[leaves + 1]), INSET_MM)
        motion = Inside(
            np.insert(times, leaves + 1, 0.5 * (times[leaves] + times[leaves + 1])),
            np.insert(d, leaves + 1, middles, axis=0),
            np.insert(given, leaves + 1, False),
        )
    return motion


def _leaves(bound: SliceHull, start: Array, end: Array) -> Mask:
    """Tell which straight lines (n, 3) between points inside leave the bound."""
    length = np.linalg.norm(end - start, axis=1)
    margin = np.minimum(-_distance(bound, start), -_distance(bound, end))
    near = np.flatnonzero(margin < _STEEPEST * length)
    count = np.clip(np.ceil(length[near] / _CHECKED_MM), 4, 4 * _MOST_PIECES).astype(int)
    line = np.repeat(np.arange(len(near)), count)
    step = np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)
    share = (step + 0.5) / count[line]
    start, way, found = start[near], (end - start)[near], np.zeros(len(start), dtype=bool)
    distance = _distance(bound, start[line] + share[:, None] * way[line])
    first = np.cumsum(count) - count
    worst = np.maximum.reduceat(distance, first) if len(near) else distance
    doubtful = np.flatnonzero((worst > -_DOUBTFUL_MM) & (worst <= _ROUNDING_MM))
    at = share[first[doubtful] + _places(distance == worst[line], first, count)[doubtful]]
    for shift in np.linspace(-1.0, 1.0, 17):  # closer, around the place where the line is nearest to leaving
        closer = np.clip(at + shift / count[doubtful], 0.0, 1.0)
        nearer = _distance(bound, start[doubtful] + closer[:, None] * way[doubtful])
        worst[doubtful] = np.maximum(worst[doubtful], nearer)
    found[near[worst > _ROUNDING_MM]] = True
    return found


def _places(marked: Mask, first: Indices, count: Indices) -> Indices:
    """Return, for groups of consecutive entries, the place of a marked entry in each."""
    place = np.where(marked, np.arange(len(marked)), -1)
    return np.maximum.reduceat(place, first) - first if len(count) else first
