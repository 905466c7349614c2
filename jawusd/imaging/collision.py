"""How deep two solids run into each other, for many poses of one against the other."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.geometry.arrays import Array, Mask
from jawusd.geometry.se3 import se3_inverse
from jawusd.imaging.solid import DistanceGrid, distance_grid, outer_faces

#: Surfaces farther apart than this count as this far apart [mm].
FARTHEST_MM = 1.5

_STEP_MM = 0.25
_SAMPLE_MM = 0.5  # samples of a face lie no farther apart
_CLUSTER_MM = 1.2
_PARTS = 16  # of many poses, for threads
_GROUP_CELLS = 4  # clusters are grouped by so many cells per axis


@dataclass(frozen=True, eq=False)
class Samples:
    """Points of a surface in clusters, so that clusters that are far away are passed over at once.

    Attributes:
        points: in order of their clusters [mm], shape (P, 3).
        start: first point of every cluster, and the number of points at the end, shape (C + 1,).
        balls: centres of the clusters and distances of their farthest points [mm], shape (C, 4).
        group_start: first cluster of every group, and the number of clusters at the end, shape (G + 1,).
        groups: centres and radii of the groups [mm], shape (G, 4).
    """

    points: Array
    start: NDArray[np.int64]
    balls: Array
    group_start: NDArray[np.int64]
    groups: Array


@dataclass(frozen=True, eq=False)
class Solid:
    """One of two solids: its distances and its samples, in its own frame (y vertical)."""

    grid: DistanceGrid
    samples: Samples
    entering: float  # see `outer_faces`


@dataclass(frozen=True, eq=False)
class Pair:
    """Two solids that face each other, the upper one at rest."""

    upper: Solid
    lower: Solid

    def depth(self, T_upper_lower: Array) -> Array:
        """Return how deep the surfaces run into each other [mm], shape (n,), in poses (n, 4, 4).

        The largest distance of a point of one surface inside the other solid to that solid's surface; negative, down to
        -`FARTHEST_MM`, where they are apart.
        """
        return self._deepest(T_upper_lower, -FARTHEST_MM, np.inf)

    def is_deeper(self, T_upper_lower: Array, limit_mm: float) -> Mask:
        """Return where `depth` is more than a limit, shape (n,), without measuring by how much."""
        return self._deepest(T_upper_lower, max(limit_mm, -FARTHEST_MM), limit_mm) > limit_mm

    def _deepest(self, T_upper_lower: Array, least: float, enough: float) -> Array:
        """Return the depths where these are more than the least [mm], shape (n,); past `enough`, any such value."""
        there = np.ascontiguousarray(T_upper_lower)
        back = np.ascontiguousarray(se3_inverse(there))
        found = np.full(len(there), least)

        def deepen(first: int) -> None:
            part = slice(first, first + size)
            _deepen(found[part], there[part], enough, *_flat(self.upper.grid, self.lower.samples))
            _deepen(found[part], back[part], enough, *_flat(self.lower.grid, self.upper.samples))

        size = max(1, -(-len(found) // _PARTS))
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(deepen, range(0, len(found), size)))
        return found


def distances(grid: DistanceGrid, points: Array) -> Array:
    """Return the signed distances at points (n, 3) [mm], shape (n,); outside the grid at least `FARTHEST_MM`."""
    found = np.empty(len(points))
    _look_up_all(found, np.ascontiguousarray(points), grid.values, grid.origin, 1.0 / grid.step_mm)
    return found


def tips_box(corners: Array, up: float, height_mm: float) -> Array:
    """Return the box (2, 3) [mm] around a solid from its tips so far towards its base; see `solid`."""
    box = np.array([corners.min(axis=(0, 1)) - FARTHEST_MM, corners.max(axis=(0, 1)) + FARTHEST_MM])
    if up > 0:
        box[1, 1] = min(box[1, 1], box[0, 1] + height_mm + FARTHEST_MM)
    else:
        box[0, 1] = max(box[0, 1], box[1, 1] - height_mm - FARTHEST_MM)
    return box


def solid(corners: Array, up: float, box: Array) -> Solid:
    """Build a solid from triangles.

    Args:
        corners: triangles counter-clockwise seen from outside [mm], shape (F, 3, 3), y vertical.
        up: see `outer_faces`.
        box: where the solid matters, rows low and high [mm], shape (2, 3).
    """
    outer, entering = outer_faces(corners, up)
    grid = distance_grid(corners, outer, box, _STEP_MM, up)
    near = ((corners <= box[1]) & (corners >= box[0])).all(axis=2).any(axis=1)
    return Solid(grid, clustered(surface_points(corners[outer & near], _SAMPLE_MM)), entering)


def surface_points(corners: Array, apart_mm: float) -> Array:
    """Return points (P, 3) [mm] of triangles (F, 3, 3) no farther apart than given, corners among them."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.maximum(np.ceil(longest / apart_mm), 1).astype(int)
    found = [np.empty((0, 3))]
    for n in np.unique(parts):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        weights = np.stack([n - i - j, i, j], axis=-1)[i + j <= n] / n
        found.append(np.einsum("pk,fkc->fpc", weights, corners[parts == n]).reshape(-1, 3))
    return np.unique(np.round(np.concatenate(found), 6), axis=0)


def clustered(points: Array) -> Samples:
    """Return points (P, 3) [mm] in clusters, and these in groups."""
    cell = np.floor(points / _CLUSTER_MM).astype(np.int64)
    group = cell // _GROUP_CELLS
    order = np.lexsort((*cell.T, *group.T))
    points, keys = np.ascontiguousarray(points[order]), np.concatenate([group, cell], axis=1)[order]
    starts = [_firsts(keys), _firsts(keys[:, :3])]
    balls, groups = (_balls(points, start) for start in starts)
    return Samples(points, starts[0], balls, np.searchsorted(starts[0], starts[1]), groups)


def _firsts(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return where the rows (P, k) change, and P at the end."""
    changes = np.ones(len(keys), dtype=bool)
    changes[1:] = (keys[1:] != keys[:-1]).any(axis=1)
    return np.append(np.flatnonzero(changes), len(keys))


def _balls(points: Array, start: NDArray[np.int64]) -> Array:
    """Return balls (n, 4) around runs of points: centre, radius [mm]."""
    if not len(points):
        return np.empty((0, 4))
    count = np.diff(start)
    centres = np.add.reduceat(points, start[:-1]) / count[:, None]
    away = np.linalg.norm(points - np.repeat(centres, count, axis=0), axis=1)
    return np.column_stack([centres, np.maximum.reduceat(away, start[:-1])])


# what compiled functions take of a grid and of the samples of the other arch
_Flat = tuple[NDArray[np.float32], Array, float, Array, NDArray[np.int64], Array, NDArray[np.int64], Array]


def _flat(grid: DistanceGrid, samples: Samples) -> _Flat:
    parts = (samples.points, samples.start, samples.balls, samples.group_start, samples.groups)
    return (grid.values, grid.origin, 1.0 / grid.step_mm, *parts)


@numba.njit(nogil=True, cache=True)
def _look_up(values: NDArray[np.float32], origin: Array, per_mm: float, x: float, y: float, z: float) -> float:
    """Return the distance at a point, linear between values; outside the grid at least FARTHEST_MM."""
    fx, fy, fz = (x - origin[0]) * per_mm, (y - origin[1]) * per_mm, (z - origin[2]) * per_mm
    nx, ny, nz = values.shape
    if not (0 <= fx < nx - 1 and 0 <= fy < ny - 1 and 0 <= fz < nz - 1):
        outside = max(-fx, fx - nx + 1, -fy, fy - ny + 1, -fz, fz - nz + 1, 0.0)
        return FARTHEST_MM + outside / per_mm
    i, j, k = int(fx), int(fy), int(fz)
    a, b, c = fx - i, fy - j, fz - k
    low = (values[i, j, k] * (1 - c) + values[i, j, k + 1] * c) * (1 - b) + (
        values[i, j + 1, k] * (1 - c) + values[i, j + 1, k + 1] * c
    ) * b
    high = (values[i + 1, j, k] * (1 - c) + values[i + 1, j, k + 1] * c) * (1 - b) + (
        values[i + 1, j + 1, k] * (1 - c) + values[i + 1, j + 1, k + 1] * c
    ) * b
    return low * (1 - a) + high * a


@numba.njit(nogil=True, cache=True)
def _look_up_all(found: Array, points: Array, values: NDArray[np.float32], origin: Array, per_mm: float) -> None:
    for i in range(len(points)):
        found[i] = _look_up(values, origin, per_mm, points[i, 0], points[i, 1], points[i, 2])


@numba.njit(nogil=True, cache=True)
def _away(M: Array, point: Array, values: NDArray[np.float32], origin: Array, per_mm: float) -> float:
    """Return the distance at the image of a point under M."""
    x, y, z = point[0], point[1], point[2]
    return _look_up(
        values,
        origin,
        per_mm,
        M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3],
        M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3],
        M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3],
    )


@numba.njit(nogil=True, cache=True)
def _deepen(
    depth: Array,
    T: Array,
    enough: float,
    values: NDArray[np.float32],
    origin: Array,
    per_mm: float,
    points: Array,
    start: NDArray[np.int64],
    balls: Array,
    group_start: NDArray[np.int64],
    groups: Array,
) -> None:
    """Raise each depth to that of the deepest of the points under T[i], or to any that is more than enough."""
    last = 0
    for i in range(len(T)):
        best, M = depth[i], T[i]
        # the group that was deepest in the pose before comes first: it leaves most others behind
        for turn in range(len(groups) + 1):
            if best > enough:
                break
            g = last if turn == 0 else turn - 1
            if groups[g, 3] - _away(M, groups[g], values, origin, per_mm) <= best:
                continue
            for c in range(group_start[g], group_start[g + 1]):
                if best > enough:
                    break
                if balls[c, 3] - _away(M, balls[c], values, origin, per_mm) <= best:
                    continue
                for p in range(start[c], start[c + 1]):
                    away = _away(M, points[p], values, origin, per_mm)
                    if -away > best:
                        best, last = -away, g
        depth[i] = best
