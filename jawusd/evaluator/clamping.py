"""Move motions inside the bound, continuously and at little more than their original speed.

Poses outside are moved towards the spine of the bound, a line inside it. This is continuous, while the nearest valid
point jumps where the bound is concave: every section across the spine is convex, so the path from a pose outside enters
the section at exactly one point. Where the resulting path is longer than the original one, it is shortened by shortcuts
through the interior. The motion then follows the path no faster than the original allows at each moment, as close as
possible to its original timing (the mean of the two envelopes of McShane and Whitney 1934).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import EvaluatorError
from jawusd.evaluator.batching import in_chunks, pairs_in_chunks
from jawusd.evaluator.bounds import SliceHull, largest_share
from jawusd.evaluator.curves import interpolate_linear

MAX_STRETCH = 1.045  # maximum factor by which a step may grow: 5 %, less an allowance for rounding

_SAMPLE_MM = 0.2  # sample spacing [mm] near the bound
_MAX_PIECES = 400  # maximum number of samples in one step
# Maximum gradient norm of the margin: a step stays inside if the margin at its ends is at least this times its length.
_STEEPEST = 5.0
_STILL_MM = 1e-12
_TIME_SHARE = 0.998  # fraction of the available time that a path may take; finer sampling lengthens the path slightly
# Lines between samples are checked at points `_CHECK_MM` apart, and more finely where the margin is below `_NEAR_MM`.
_CHECK_MM, _NEAR_MM, _MAX_ROUNDS, _ROUNDING_MM = 0.03, 1e-3, 8, 1e-9

_LINE_MM = 0.1  # sample spacing [mm] of shortcuts
_SHORTCUTS = 24  # number of end points tried at once for a shortcut
_TIGHT_POINTS, _TIGHT_ROUNDS, _TIGHT_GAIN_MM = 49, 20, 0.01
# Fractions of the way to the straight line by which a segment is moved, in the order tried.
_TIGHT_SHARES = (1.0, 0.5, 0.25, 0.1)

INSET_MM = 0.01  # depth [mm] to which points are moved inside, so that lines between samples stay inside

_SLICES = 97
_CAP_MM = 0.3  # depth of the spine's ends below the surface; openings beyond the ends are clamped
_NEWTON, _BISECTIONS = 40, 40
_MIN_DEPTH = 0.25  # minimum depth of a spine moved into a box, relative to its original depth
_ENTRY_TOLERANCE_MM = 1e-10


class Inside(NamedTuple):
    """A motion inside the bound."""

    times: Array  # sample times, shape (n,): the original ones, and more where lines between them would leave the bound
    d: Array  # jaw parameters at these times [mm], linear in between, shape (n, 3)
    given: Mask  # mask of the original samples, shape (n,)


def kept_inside(bound: SliceHull, times: Array, d: Array, *, ends_stay: bool = False) -> Inside:
    """Return a motion d (F, 3) [mm] clamped to the bound, also between its samples, with no step more than 5 % longer.

    `ends_stay`: where every path inside is too long, exceed this limit instead of retiming the motion before and after.

    Raises:
        EvaluatorError: the bound is empty.
    """
    if len(d) == 1:
        return Inside(times, moved_to_spine(bound, Spine.of(bound), d), np.array([True]))
    spine = Spine.of(bound).towards(bound, d[:, 1:].min(axis=0), d[:, 1:].max(axis=0))
    fine, wanted, given = _refined(bound, times, d)
    moved = moved_to_spine(bound, spine, wanted, 0.0)
    between = ~given
    moved[between] = moved_to_spine(bound, spine, wanted[between], INSET_MM)
    outside = distances(bound, wanted) > 0
    allowed = MAX_STRETCH * lengths(wanted)
    for first, last in _runs((moved != wanted).any(axis=1)):
        run = slice(first, last + 1)
        if outside[run].any():
            moved[run] = moved_to_spine(bound, spine, short_enough(bound, moved[run], allowed[run]))
            if not ends_stay:
                first, last = _widened(moved, allowed, first, last)
                run = slice(first, last + 1)
            moved[run] = _retimed(bound, spine, moved[run], allowed[run], ends_stay)
    return _without_gaps(bound, spine, _thinned(bound, fine, moved, given))


def _refined(bound: SliceHull, times: Array, d: Array) -> tuple[Array, Array, Mask]:
    """Return the motion sampled more finely near the bound: times (n,), d (n, 3), and which are original (n,)."""
    length = np.linalg.norm(np.diff(d, axis=0), axis=1)
    margin = -distances(bound, d)
    near = np.minimum(margin[:-1], margin[1:]) < _STEEPEST * length
    count = np.where(near, np.clip(np.ceil(length / _SAMPLE_MM), 1, _MAX_PIECES), 1).astype(int)
    index = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)) / count[index]
    fine = np.append(times[index] + share * np.diff(times)[index], times[-1])
    wanted = np.concatenate([d[index] + share[:, None] * np.diff(d, axis=0)[index], d[-1:]])
    given = np.append(share == 0.0, True)
    return fine, wanted, given


def _runs(moved: Mask) -> list[tuple[int, int]]:
    """Return the first and last index of each run of moved samples, including one unmoved neighbour on each side."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], moved, [False]]).astype(np.int8)))
    return [(max(int(a) - 1, 0), min(int(b), len(moved) - 1)) for a, b in zip(edges[::2], edges[1::2])]


def _widened(path: Array, allowed: Array, first: int, last: int) -> tuple[int, int]:
    """Return the run of samples, widened until its duration suffices for the path or it includes all samples."""
    reach, end = max(last - first, 1), len(path) - 1
    while first > 0 or last < end:
        if lengths(path[first : last + 1])[-1] <= _TIME_SHARE * (allowed[last] - allowed[first]):
            break
        first, last, reach = max(first - reach, 0), min(last + reach, end), 2 * reach
    return first, last


def _retimed(bound: SliceHull, spine: Spine, path: Array, allowed: Array, ends_stay: bool) -> Array:
    """Return the path (n, 3) retimed to grow no faster than ``allowed`` (n,) [mm], with fixed ends if possible."""
    allowed = allowed - allowed[0]
    if (np.diff(lengths(path)) <= np.diff(allowed) + _STILL_MM).all():
        return path
    closer = _without_gaps(bound, spine, Inside(np.arange(float(len(path))), path, np.full(len(path), True)))
    whole_length = lengths(closer.d)
    length = whole_length[closer.given]
    if ends_stay and length[-1] > allowed[-1]:
        allowed = length[-1] * (allowed / allowed[-1] if allowed[-1] > 0 else np.linspace(0.0, 1.0, len(length)))
    above, below = length + allowed, length - allowed
    ahead = np.maximum(np.maximum.accumulate(above) - allowed, np.maximum.accumulate(below[::-1])[::-1] + allowed)
    behind = np.minimum(np.minimum.accumulate(below) + allowed, np.minimum.accumulate(above[::-1])[::-1] - allowed)
    at = 0.5 * (ahead + behind)
    if length[-1] <= allowed[-1]:
        at = np.clip(at, length[-1] - (allowed[-1] - allowed), allowed)
    return along(closer.d, whole_length, np.clip(at, 0.0, length[-1]))


def _thinned(bound: SliceHull, times: Array, d: Array, given: Mask) -> Inside:
    """Return the original samples, and those added samples that keep the lines between samples inside the bound."""
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
    """Return the motion with samples added where the line between two samples still slightly leaves the bound."""
    for _ in range(_MAX_ROUNDS):
        times, d, given = motion
        leaves = np.flatnonzero(_leaves(bound, d[:-1], d[1:]))
        if not leaves.size:
            break
        middles = moved_to_spine(bound, spine, 0.5 * (d[leaves] + d[leaves + 1]), INSET_MM)
        motion = Inside(
            np.insert(times, leaves + 1, 0.5 * (times[leaves] + times[leaves + 1])),
            np.insert(d, leaves + 1, middles, axis=0),
            np.insert(given, leaves + 1, False),
        )
    return motion


def _leaves(bound: SliceHull, start: Array, end: Array) -> Mask:
    """Return which line segments from points (n, 3) inside the bound to other points (n, 3) leave the bound."""
    length = np.linalg.norm(end - start, axis=1)
    margin = np.minimum(-distances(bound, start), -distances(bound, end))
    near = np.flatnonzero(margin < _STEEPEST * length)
    count = np.clip(np.ceil(length[near] / _CHECK_MM), 4, 4 * _MAX_PIECES).astype(int)
    line = np.repeat(np.arange(len(near)), count)
    step = np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)
    share = (step + 0.5) / count[line]
    start, offset, found = start[near], (end - start)[near], np.zeros(len(start), dtype=bool)
    distance = distances(bound, start[line] + share[:, None] * offset[line])
    first = np.cumsum(count) - count
    worst = np.maximum.reduceat(distance, first) if len(near) else distance
    close = np.flatnonzero((worst > -_NEAR_MM) & (worst <= _ROUNDING_MM))
    place = np.where(distance == worst[line], np.arange(len(line)), -1)
    at = share[(np.maximum.reduceat(place, first) if len(near) else first)[close]]
    for shift in np.linspace(-1.0, 1.0, 17):  # look at points around the sample with the smallest margin
        closer = np.clip(at + shift / count[close], 0.0, 1.0)
        nearer = distances(bound, start[close] + closer[:, None] * offset[close])
        worst[close] = np.maximum(worst[close], nearer)
    found[near[worst > _ROUNDING_MM]] = True
    return found


def lengths(path: Array) -> Array:
    """Return the cumulative length (n,) of a path (n, 3)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def along(path: Array, length: Array, at: Array) -> Array:
    """Return the points (m, 3) of a path (n, 3) at arc lengths ``at`` (m,), given its cumulative lengths (n,)."""
    keep = np.concatenate([[True], np.diff(length) > 0])
    return interpolate_linear(length[keep], path[keep], at)


def short_enough(bound: SliceHull, path: Array, allowed: Array) -> Array:
    """Return a path (n, 3) inside the bound, shortened through its interior where it exceeds ``allowed`` (n,)."""
    most = allowed[-1] - allowed[0]
    if lengths(path)[-1] <= most:
        return path
    shorter = _cut_short(bound, path)
    shorter = _tightened(bound, shorter, most)
    length = lengths(shorter)
    share = (allowed - allowed[0]) / most if most > 0 else np.linspace(0.0, 1.0, len(path))
    return along(shorter, length, share * length[-1])


def _cut_short(bound: SliceHull, path: Array) -> Array:
    """Return the corners (m, 3) of a shorter path: each corner is joined to the farthest one visible from it."""
    corners, i, last = [0], 0, len(path) - 1
    while i < last:
        tried = np.unique(np.linspace(i + 1, last, _SHORTCUTS).astype(int))
        visible = tried[_clear(bound, path[i], path[tried])]
        i = int(max(visible.max(initial=i + 1), i + 1))
        corners.append(i)
    return path[corners]


def _tightened(bound: SliceHull, corners: Array, most_mm: float) -> Array:
    """Return a path (n, 3) between the same ends, its segments straightened, long ones first, down to ``most_mm``."""
    length = lengths(corners)
    path = along(corners, length, np.union1d(np.linspace(0.0, length[-1], _TIGHT_POINTS), length))
    for _ in range(_TIGHT_ROUNDS):
        before = lengths(path)[-1]
        half = len(path) // 2
        while half:
            for a in range(0, len(path) - 2 * half, max(half // 2, 1)):
                _flatten(bound, path[a : a + 2 * half + 1])
            half //= 2
        length = lengths(path)[-1]
        if length <= most_mm or length > before - _TIGHT_GAIN_MM:
            break
    return path


def _flatten(bound: SliceHull, segment: Array) -> None:
    """Move a segment of a path (n, 3), in place, towards the straight line between its ends, if the bound allows."""
    line = np.linspace(segment[0], segment[-1], len(segment))
    tried = segment + np.array(_TIGHT_SHARES)[:, None, None] * (line - segment)
    points = np.concatenate([tried[:, 1:-1], 0.5 * (tried[:, 1:] + tried[:, :-1])], axis=1)
    distance = bound.signed_distance(points.reshape(-1, 3)).reshape(points.shape[:2])
    clear = (distance <= -0.5 * INSET_MM).all(axis=1)
    if clear.any():
        segment[:] = tried[int(np.argmax(clear))]


def _clear(bound: SliceHull, start: Array, ends: Array) -> Mask:
    """Return which line segments from a point (3,) to other points (m, 3) stay inside the bound."""
    count = int(np.clip(np.ceil(np.linalg.norm(ends - start, axis=1).max() / _LINE_MM), 2, 400))
    share = np.linspace(0.0, 1.0, count + 1)[1:-1]
    points = start + share[:, None, None] * (ends - start)
    distance = bound.signed_distance(points.reshape(-1, 3)).reshape(len(share), len(ends))
    return np.asarray((distance <= -0.5 * INSET_MM).all(axis=0))


@dataclass(frozen=True)
class Spine:
    """A line inside a bound, with one point (d2, d3) for every opening."""

    d1: Array  # increasing openings, shape (n,) [mm]
    middle: Array  # (d2, d3) at each opening, shape (n, 2) [mm]; the habitual path (0, 0) where that is deep inside

    @classmethod
    @lru_cache(maxsize=16)
    def of(cls, bound: SliceHull) -> Spine:
        """Find the spine of a bound; recent results are cached. Raises EvaluatorError if the bound is empty."""
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
