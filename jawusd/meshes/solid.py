"""Compute signed distance grids of scans, negative inside the crowns; scans may be open at the base.

Inside and outside are determined along vertical lines from the opposing jaw: a point is inside if the line has
entered more surfaces than it has left. Unlike parity, this winding number handles overlaps (Jacobson et al. 2013, ACM
TOG 32:33). The surface need not be closed, but must be consistently wound. Faces inside other parts, for example where
neighbouring teeth overlap, are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from jawusd.base.arrays import Array, Mask

_BUCKET_MM = 1.0  # cell size in the (x, z) plane of the triangle lookup
# Width of the band around triangles in which the nearest triangle is found exactly and then propagated.
_BAND_CELLS = 3.0
_DIAGONAL_CELLS = 3.0**0.5
_OFF_FACE_MM = 0.01  # offset of the point that tests whether a face is outside
# Offset of vertical lines that avoids vertices and edges at round coordinates.
_JITTER_MM = np.array([1.23e-4, 0.0, 2.71e-4])
_MOST_CROSSINGS = 256


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Signed distances at the points of a regular grid."""

    origin: Array  # position of the first grid point [mm], shape (3,)
    step_mm: float  # grid step along every axis
    values: NDArray[np.float32]  # signed distances [mm], negative inside, shape (nx, ny, nz), float32


class _Columns(NamedTuple):
    """Triangles by cells of the (x, z) plane: triangles over cell i are ``faces[start[i] : start[i + 1]]``."""

    low: Array
    shape: tuple[int, int]
    start: NDArray[np.int64]
    faces: NDArray[np.int64]


def outer_faces(corners: Array, up: float) -> tuple[Mask, float]:
    """Find the faces that bound a solid which is open on one side, and check their winding.

    Args:
        corners: triangles [mm], shape (F, 3, 3), y vertical.
        up: 1.0 if the solid is entered upwards (upper teeth), -1.0 if downwards (lower teeth).

    Returns:
        Which faces are outer faces, shape (F,), and the fraction of vertical lines that enter the solid at the first
        crossing: 1 for triangles that are counter-clockwise seen from outside, 0 for clockwise ones.
    """
    flipped = _upwards(corners, up)
    columns = _columns_of(flipped)
    normals = np.cross(flipped[:, 1] - flipped[:, 0], flipped[:, 2] - flipped[:, 0])
    length = np.linalg.norm(normals, axis=1)
    before = flipped.mean(axis=1) + _OFF_FACE_MM * normals / np.maximum(length, 1e-12)[:, None]
    count, first = _crossings(before + _JITTER_MM, flipped, columns)
    met = first[first != 0]
    entering = float((met > 0).mean()) if len(met) else 0.0
    return (count <= 0) & (length > 0), entering


def distance_grid(corners: Array, outer: Mask, box: Array, step_mm: float, up: float, far_mm: float) -> DistanceGrid:
    """Sample the signed distance to a solid: exact near its surface, sometimes slightly too large farther away.

    The error exceeds 0.01 mm at 0.4 % of points 0.5 to 1 mm inside teeth, and at 2 % of points 1 to 2 mm inside; it is
    0.12 mm at most.

    Args:
        corners: all triangles [mm], shape (F, 3, 3), y vertical, counter-clockwise seen from outside.
        outer, up: see `outer_faces`.
        box: extent of the grid, its low and high corner [mm], shape (2, 3).
        far_mm: distance outside the solid above which values need not be exact, only at least this large.
    """
    nx, ny, nz = (int(n) for n in np.ceil((box[1] - box[0]) / step_mm) + 1)
    kept = np.ascontiguousarray(corners[outer])
    nearest, away_cells = _spread(_nearest_faces(kept, box[0], step_mm, (nx, ny, nz), _BAND_CELLS))
    flipped = _upwards(corners, up)
    values = np.ones(nearest.shape, np.float32)
    _set_signs(values, flipped, box[0], step_mm, up, _columns_of(flipped))
    _set_distances(
        values, kept, nearest, away_cells, _walls(kept, box[0], step_mm, values.shape), box[0], step_mm, far_mm
    )
    return DistanceGrid(np.array(box[0]), step_mm, values)


def _spread(numbers: NDArray[np.int32]) -> tuple[NDArray[np.int32], Array]:
    """Return the nearest number that is not negative, and its distance [cells]; -1 and a large distance if none."""
    empty = numbers < 0
    if empty.all():
        return numbers, np.full(numbers.shape, float(sum(numbers.shape)))
    away, place = distance_transform_edt(empty, return_indices=True)
    return numbers[tuple(place)], away


def _walls(corners: Array, origin: Array, step: float, shape: tuple[int, ...]) -> Array:
    """Return the grid's first and last cells (2, 3) on axes along which triangles extend beyond it, else infinity."""
    last = np.array(shape) - 1
    low, high = (corners.reshape(-1, 3) - origin).min(axis=0), (corners.reshape(-1, 3) - origin).max(axis=0)
    return np.array([np.where(low < 0, 0.0, -np.inf), np.where(high > step * last, last, np.inf)])


def _upwards(corners: Array, up: float) -> Array:
    """Return triangles turned so that the open side is up, with unchanged winding."""
    if up > 0:
        return np.ascontiguousarray(corners)
    return np.ascontiguousarray((corners * [1.0, -1.0, 1.0])[:, ::-1])


def _columns_of(corners: Array) -> _Columns:
    low, high = corners.min(axis=1)[:, [0, 2]], corners.max(axis=1)[:, [0, 2]]
    origin = low.min(axis=0) - 1e-6
    first, last = (np.floor((ends - origin) / _BUCKET_MM).astype(np.int64) for ends in (low, high))
    shape = last.max(axis=0) + 1
    count = np.prod(last - first + 1, axis=1)
    face = np.repeat(np.arange(len(corners)), count)
    within = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    width = (last - first + 1)[face, 1]
    square = (first[face, 0] + within // width) * shape[1] + first[face, 1] + within % width
    order = np.argsort(square, kind="stable")
    start = np.searchsorted(square[order], np.arange(shape[0] * shape[1] + 1))
    return _Columns(origin, (int(shape[0]), int(shape[1])), start, face[order])


@numba.njit(nogil=True, cache=True)
def _crossing(corners: Array, f: int, x: float, z: float) -> tuple[int, float]:
    """Intersect a vertical line with a triangle; return 1 (enters), -1 (leaves) or 0 (misses), and the height."""
    ax, ay, az = corners[f, 0, 0] - x, corners[f, 0, 1], corners[f, 0, 2] - z
    bx, by, bz = corners[f, 1, 0] - x, corners[f, 1, 1], corners[f, 1, 2] - z
    cx, cy, cz = corners[f, 2, 0] - x, corners[f, 2, 1], corners[f, 2, 2] - z
    u, v, w = bx * cz - cx * bz, cx * az - ax * cz, ax * bz - bx * az
    area = u + v + w  # negated y component of the triangle's normal
    if not ((u >= 0 and v >= 0 and w >= 0) or (u <= 0 and v <= 0 and w <= 0)) or area == 0:
        return 0, 0.0
    return (1 if area > 0 else -1), (u * ay + v * by + w * cy) / area


@numba.njit(nogil=True, cache=True)
def _over(columns: _Columns, x: float, z: float) -> tuple[int, int]:
    """Return the range of ``columns.faces`` that may lie on a vertical line, empty outside the columns."""
    low, shape, start, _ = columns
    i, k = int(np.floor((x - low[0]) / _BUCKET_MM)), int(np.floor((z - low[1]) / _BUCKET_MM))
    if i < 0 or k < 0 or i >= shape[0] or k >= shape[1]:
        return 0, 0
    return start[i * shape[1] + k], start[i * shape[1] + k + 1]


@numba.njit(nogil=True, cache=True)
def _crossings(points: Array, corners: Array, columns: _Columns) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the winding number at each point, and the type of the lowest crossing below it (1 enters, -1 leaves)."""
    count = np.zeros(len(points), np.int64)
    first = np.zeros(len(points), np.int64)
    for p in range(len(points)):
        lowest = np.inf
        begin, end = _over(columns, points[p, 0], points[p, 2])
        for j in range(begin, end):
            kind, height = _crossing(corners, columns.faces[j], points[p, 0], points[p, 2])
            if kind != 0 and height < points[p, 1]:
                count[p] += kind
                if height < lowest:
                    lowest = height
                    first[p] = kind
    return count, first


@numba.njit(nogil=True, cache=True)
def _set_signs(
    values: NDArray[np.float32], corners: Array, origin: Array, step: float, up: float, columns: _Columns
) -> None:
    heights, kinds = np.empty(_MOST_CROSSINGS), np.empty(_MOST_CROSSINGS, np.int64)
    nx, ny, nz = values.shape
    for i in range(nx):
        x = origin[0] + i * step + _JITTER_MM[0]
        for k in range(nz):
            z = origin[2] + k * step + _JITTER_MM[2]
            found = 0
            begin, end = _over(columns, x, z)
            for j in range(begin, end):
                kind, height = _crossing(corners, columns.faces[j], x, z)
                if kind != 0 and found < _MOST_CROSSINGS:
                    heights[found], kinds[found] = height, kind
                    found += 1
            for y in range(ny):
                at = up * (origin[1] + y * step)
                count = 0
                for j in range(found):
                    if heights[j] < at:
                        count += kinds[j]
                if count > 0:
                    values[i, y, k] = -values[i, y, k]


@numba.njit(nogil=True, cache=True)
def _squared_distance(corners: Array, f: int, x: float, y: float, z: float) -> float:
    """Return the squared distance of a point to a triangle (Ericson 2005, Real-time collision detection, 5.1.5)."""
    ax, ay, az = corners[f, 0, 0], corners[f, 0, 1], corners[f, 0, 2]
    ux, uy, uz = corners[f, 1, 0] - ax, corners[f, 1, 1] - ay, corners[f, 1, 2] - az
    vx, vy, vz = corners[f, 2, 0] - ax, corners[f, 2, 1] - ay, corners[f, 2, 2] - az
    px, py, pz = x - ax, y - ay, z - az
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    pu, pv = px * ux + py * uy + pz * uz, px * vx + py * vy + pz * vz
    area = uu * vv - uv * uv
    s, t = pu * vv - pv * uv, pv * uu - pu * uv
    if area > 0 and s >= 0 and t >= 0 and s + t <= area:
        s, t = s / area, t / area
        return (px - s * ux - t * vx) ** 2 + (py - s * uy - t * vy) ** 2 + (pz - s * uz - t * vz) ** 2
    best = np.inf
    for edge in range(3):  # otherwise, the nearest point lies on an edge of the triangle
        if edge == 0:
            s, t = min(max(pu / uu, 0.0), 1.0), 0.0
        elif edge == 1:
            s, t = 0.0, min(max(pv / vv, 0.0), 1.0)
        else:
            along = (pv - pu + uu - uv) / max(uu - 2 * uv + vv, 1e-300)
            t = min(max(along, 0.0), 1.0)
            s = 1.0 - t
        best = min(best, (px - s * ux - t * vx) ** 2 + (py - s * uy - t * vy) ** 2 + (pz - s * uz - t * vz) ** 2)
    return best


@numba.njit(nogil=True, cache=True)
def _nearest_faces(
    corners: Array, origin: Array, step: float, shape: tuple[int, int, int], band: float
) -> NDArray[np.int32]:
    """Return the index of the nearest triangle for grid points near a triangle, -1 elsewhere, shape (nx, ny, nz)."""
    nearest = np.full(shape, -1, np.int32)
    # Beyond the band, a triangle whose box contains a grid point may not be the nearest one.
    best = np.full(shape, np.float32((band * step) ** 2), np.float32)
    for f in range(len(corners)):
        low, high = np.empty(3, np.int64), np.empty(3, np.int64)
        for c in range(3):
            a, b = corners[f, :, c].min(), corners[f, :, c].max()
            low[c] = max(0, int(np.ceil((a - origin[c]) / step - band)))
            high[c] = min(shape[c] - 1, int(np.floor((b - origin[c]) / step + band)))
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for k in range(low[2], high[2] + 1):
                    found = _squared_distance(
                        corners, f, origin[0] + i * step, origin[1] + j * step, origin[2] + k * step
                    )
                    if found < best[i, j, k]:
                        best[i, j, k], nearest[i, j, k] = found, f
    return nearest


@numba.njit(nogil=True, cache=True)
def _set_distances(
    values: NDArray[np.float32],
    corners: Array,
    nearest: NDArray[np.int32],
    away_cells: Array,
    walls: Array,
    origin: Array,
    step: float,
    far: float,
) -> None:
    """Multiply signs by the distance to the nearest of the triangles stored at a grid point and its six neighbours.

    Positive distances that are certainly above `far` are replaced by a lower bound.
    """
    nx, ny, nz = nearest.shape
    for i in range(nx):
        for j in range(ny):
            to_wall = min(i - walls[0, 0], walls[1, 0] - i, j - walls[0, 1], walls[1, 1] - j)
            for k in range(nz):
                own = found = nearest[i, j, k]
                # Lower bound of the distance: distance to the nearest grid point of the band around the surface, plus
                # the width `_BAND_CELLS` of the band, less a cell diagonal.
                least = step * min(
                    away_cells[i, j, k] + _BAND_CELLS - _DIAGONAL_CELLS, to_wall, k - walls[0, 2], walls[1, 2] - k
                )
                if own < 0 or (values[i, j, k] > 0 and least > far):
                    values[i, j, k] *= least
                    continue
                x, y, z = origin[0] + i * step, origin[1] + j * step, origin[2] + k * step
                best = _squared_distance(corners, own, x, y, z)
                for di, dj, dk in ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)):
                    a, b, c = i + di, j + dj, k + dk
                    if a < 0 or b < 0 or c < 0 or a >= nx or b >= ny or c >= nz:
                        continue
                    other = nearest[a, b, c]
                    if other in (own, found):
                        continue
                    squared = _squared_distance(corners, other, x, y, z)
                    if squared < best:
                        best, found = squared, other
                values[i, j, k] *= np.sqrt(best)
