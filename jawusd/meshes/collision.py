"""Compute the penetration depth of two solids in many relative poses."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.geometry.points import welded
from jawusd.geometry.se3 import se3_inverse
from jawusd.meshes.solid import DistanceGrid, distance_grid, outer_faces

#: Maximum measured distance between solids [mm]; larger distances are truncated to it.
FARTHEST_MM = 1.5
#: Default grid step for surfaces with the curvature of teeth [mm].
STEP_MM = 0.25

_SAMPLE_MM = 0.5  # maximum spacing of surface samples
_BOXES_MM = (4.8, 2.4, 1.2, 0.6)  # edge lengths of the nested boxes in the tree of surface samples
_PARTS = 16  # number of chunks into which poses are split for threads


@dataclass(frozen=True, eq=False)
class Samples:
    """Points of a surface, sorted into a tree of boxes so that all points of a distant box are skipped at once."""

    points: Array  # the points, in the order of the smallest boxes [mm], shape (P, 3)
    # bounding sphere of the points of each box, centre and radius [mm], shape (B, 4). Boxes are in depth-first order
    balls: Array
    # for each box, the range of its points (first, one past the last; 0, 0 for boxes with children), and the index of
    # the next box that is not inside the box, shape (B, 3)
    nodes: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Solid:
    """Distance grid and surface samples of a solid, in the coordinate frame of the solid (y vertical)."""

    grid: DistanceGrid
    samples: Samples
    entering: float  # fraction of vertical lines whose first crossing enters the solid; see `outer_faces`


@dataclass(frozen=True, eq=False)
class Pair:
    """Two opposing solids; the upper one is fixed, the lower one moves."""

    upper: Solid
    lower: Solid

    def depth(self, T_upper_lower: Array) -> Array:
        """Return the penetration depth of the surfaces [mm], shape (n,), in poses (n, 4, 4).

        It is the largest distance of a surface point inside the other solid from that solid's surface. For separate
        surfaces it is negative, down to -`FARTHEST_MM`.
        """
        return self._deepest(T_upper_lower, -FARTHEST_MM, np.inf)

    def is_deeper(self, T_upper_lower: Array, limit_mm: float) -> Mask:
        """Return whether the depth exceeds a limit in each pose, shape (n,); faster than computing the depth itself."""
        return self._deepest(T_upper_lower, max(limit_mm, -FARTHEST_MM), limit_mm) > limit_mm

    def _deepest(self, T_upper_lower: Array, least: float, enough: float) -> Array:
        """Return the depths [mm], shape (n,), clamped to at least `least`; depths above `enough` are not exact."""
        there = np.ascontiguousarray(T_upper_lower)
        back = np.ascontiguousarray(se3_inverse(there))
        found = np.full(len(there), least)
        met = (self.upper.grid, self.lower.samples), (self.lower.grid, self.upper.samples)
        sides = [(_field(grid), own.points, own.balls, own.nodes) for grid, own in met]

        def deepen(first: int) -> None:
            part = slice(first, first + size)
            _deepen(found[part], there[part], enough, *sides[0])
            _deepen(found[part], back[part], enough, *sides[1])

        size = max(1, -(-len(found) // _PARTS))
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(deepen, range(0, len(found), size)))
        return found


def distances(grid: DistanceGrid, points: Array) -> Array:
    """Return the signed distances at points (n, 3) [mm], shape (n,); at least `FARTHEST_MM` outside the grid."""
    found = np.empty(len(points))
    _look_up_all(found, np.ascontiguousarray(points), _field(grid))
    return found


def tips_box(corners: Array, up: float, height_mm: float) -> Array:
    """Return the box (2, 3) [mm] around the part of a solid within `height_mm` of its tips; see `solid`."""
    box = np.array([corners.min(axis=(0, 1)) - FARTHEST_MM, corners.max(axis=(0, 1)) + FARTHEST_MM])
    if up > 0:
        box[1, 1] = min(box[1, 1], box[0, 1] + height_mm + FARTHEST_MM)
    else:
        box[0, 1] = max(box[0, 1], box[1, 1] - height_mm - FARTHEST_MM)
    return box


def solid(corners: Array, up: float, box: Array, step_mm: float = STEP_MM) -> Solid:
    """Build a solid from triangles.

    Args:
        corners: triangles counter-clockwise seen from outside [mm], shape (F, 3, 3), y vertical.
        up: see `outer_faces`.
        box: region in which the solid is sampled, its low and high corner [mm], shape (2, 3).
        step_mm: step of the distance grid; distances between its points are interpolated linearly.
    """
    outer, entering = outer_faces(corners, up)
    # Interpolating distances up to FARTHEST_MM requires exact values up to one cell diagonal farther away.
    grid = distance_grid(corners, outer, box, step_mm, up, FARTHEST_MM + 3.0**0.5 * step_mm)
    near = ((corners <= box[1]) & (corners >= box[0])).all(axis=2).any(axis=1)
    return Solid(grid, in_boxes(surface_points(corners[outer & near], _SAMPLE_MM)), entering)


def surface_points(corners: Array, apart_mm: float) -> Array:
    """Sample triangles (F, 3, 3) at points at most `apart_mm` apart, including corners; return points (P, 3) [mm]."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.maximum(np.ceil(longest / apart_mm), 1).astype(int)
    found = [np.empty((0, 3))]
    for n in np.unique(parts):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        weights = np.stack([n - i - j, i, j], axis=-1)[i + j <= n] / n
        found.append(np.einsum("pk,fkc->fpc", weights, corners[parts == n]).reshape(-1, 3))
    return welded(np.asarray(np.round(np.concatenate(found), 6), np.float64))[0]


def in_boxes(points: Array) -> Samples:
    """Arrange points (P, 3) [mm] in a tree of boxes."""
    cells = [np.floor(points / edge).astype(np.int64) for edge in _BOXES_MM]
    order = np.lexsort([column for cell in reversed(cells) for column in cell.T])
    points = np.ascontiguousarray(points[order])
    starts = [_firsts(np.concatenate(cells[: size + 1], axis=1)[order]) for size in range(len(cells))]
    balls = np.concatenate([_balls(points, start) for start in starts])
    first, end = (np.concatenate([start[part] for start in starts]) for part in (slice(-1), slice(1, None)))
    size = np.repeat(np.arange(len(starts)), [len(start) - 1 for start in starts])
    order = np.lexsort([size, first])
    first, end, smallest = first[order], end[order], size[order] == len(starts) - 1
    nodes = np.column_stack([first * smallest, end * smallest, np.searchsorted(first, end)])
    return Samples(points, np.ascontiguousarray(balls[order]), nodes)


def _firsts(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices of the rows of (P, k) that differ from the previous row, followed by P."""
    changes = np.ones(len(keys), dtype=bool)
    changes[1:] = (keys[1:] != keys[:-1]).any(axis=1)
    return np.append(np.flatnonzero(changes), len(keys))


def _balls(points: Array, start: NDArray[np.int64]) -> Array:
    """Return the bounding spheres (n, 4) of runs of points: centre and radius [mm]."""
    if not len(points):
        return np.empty((0, 4))
    count = np.diff(start)
    centres = np.add.reduceat(points, start[:-1]) / count[:, None]
    away = np.linalg.norm(points - np.repeat(centres, count, axis=0), axis=1)
    return np.column_stack([centres, np.maximum.reduceat(away, start[:-1])])


class _Field(NamedTuple):
    """Distance grid for compiled functions: flattened values, number of points along each axis, origin, 1/step."""

    values: NDArray[np.float32]
    nx: int
    ny: int
    nz: int
    x: float
    y: float
    z: float
    per_mm: float


def _field(grid: DistanceGrid) -> _Field:
    (nx, ny, nz), (x, y, z) = grid.values.shape, grid.origin.tolist()
    return _Field(grid.values.ravel(), nx, ny, nz, x, y, z, 1.0 / grid.step_mm)


@numba.njit(nogil=True, cache=True, inline="always")
def _look_up(field: _Field, x: float, y: float, z: float) -> float:
    """Return the distance at a point, interpolated linearly; at least FARTHEST_MM outside the grid."""
    fx, fy, fz = (x - field.x) * field.per_mm, (y - field.y) * field.per_mm, (z - field.z) * field.per_mm
    nx, ny, nz = field.nx, field.ny, field.nz
    if not (0 <= fx < nx - 1 and 0 <= fy < ny - 1 and 0 <= fz < nz - 1):
        outside = max(-fx, fx - nx + 1, -fy, fy - ny + 1, -fz, fz - nz + 1, 0.0)
        return FARTHEST_MM + outside / field.per_mm
    i, j, k = int(fx), int(fy), int(fz)
    a, b, c = fx - i, fy - j, fz - k
    values = field.values
    # Unsigned indices avoid numba's check for negative indices.
    one, row, layer = np.uint64(1), np.uint64(nz), np.uint64(ny * nz)
    at = np.uint64((i * ny + j) * nz + k)
    low = (values[at] * (1 - c) + values[at + one] * c) * (1 - b) + (
        values[at + row] * (1 - c) + values[at + row + one] * c
    ) * b
    at += layer
    high = (values[at] * (1 - c) + values[at + one] * c) * (1 - b) + (
        values[at + row] * (1 - c) + values[at + row + one] * c
    ) * b
    return low * (1 - a) + high * a


@numba.njit(nogil=True, cache=True)
def _look_up_all(found: Array, points: Array, field: _Field) -> None:
    for i in range(len(points)):
        found[i] = _look_up(field, points[i, 0], points[i, 1], points[i, 2])


@numba.njit(nogil=True, cache=True, inline="always")
def _away(field: _Field, M: Array, x: float, y: float, z: float) -> float:
    """Return the distance at a point transformed by M."""
    return _look_up(
        field,
        M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3],
        M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3],
        M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3],
    )


@numba.njit(nogil=True, cache=True)
def _deepest_of(field: _Field, M: Array, points: Array, first: int, end: int, best: float) -> float:
    """Return the depth of the deepest point of a surface moved by M, or `best` if no point is deeper."""
    for p in range(first, end):
        best = max(best, -_away(field, M, points[p, 0], points[p, 1], points[p, 2]))
    return best


@numba.njit(nogil=True, cache=True)
def _deepen(
    depth: Array, T: Array, enough: float, field: _Field, points: Array, balls: Array, nodes: NDArray[np.int64]
) -> None:
    """Raise depth[i] to that of the deepest point of a surface moved by T[i], or to any value above `enough`."""
    last = 0
    for i in range(len(T) if len(nodes) else 0):
        M = T[i]
        # The box with the deepest point in the previous pose is tested first, since it prunes most other boxes.
        best = _deepest_of(field, M, points, nodes[last, 0], nodes[last, 1], depth[i])
        n = 0
        while n < len(nodes) and best <= enough:
            if balls[n, 3] - _away(field, M, balls[n, 0], balls[n, 1], balls[n, 2]) <= best:
                n = nodes[n, 2]
                continue
            deeper = _deepest_of(field, M, points, nodes[n, 0], nodes[n, 1], best)
            if deeper > best:
                best, last = deeper, n
            n += 1
        depth[i] = best
