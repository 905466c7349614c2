"""The crown-gum line of a scan as 3-D segments, for scans in which crowns continue below the gum surface.

The visible border is then the curve in which the two surfaces intersect, which is not an edge of either mesh.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Indices, Mask

_SHORTEST_MM = 1e-3  # minimum length of a segment [mm]: shorter ones have no reliable direction


def crown_gum_segments(
    vertices: Array, crown_faces: NDArray[np.int32], gum_faces: NDArray[np.int32]
) -> tuple[Array, Array]:
    """Return the segments in which crown and gum triangles intersect, and directions across them on the crown.

    End points [mm] have shape (S, 2, 3). The directions, shape (S, 3), are unit vectors in the crown triangles,
    perpendicular to the segments. Segments shorter than 1 um are omitted.
    """
    if not len(crown_faces) or not len(gum_faces):
        return np.zeros((0, 2, 3)), np.zeros((0, 3))
    crown, gum = vertices[crown_faces], vertices[gum_faces]
    low = np.maximum(crown.min((0, 1)), gum.min((0, 1)))
    high = np.minimum(crown.max((0, 1)), gum.max((0, 1)))
    crown = np.ascontiguousarray(crown[_touching(crown, low, high)])
    gum = np.ascontiguousarray(gum[_touching(gum, low, high)])
    if not len(crown) or not len(gum):
        return np.zeros((0, 2, 3)), np.zeros((0, 3))
    size = np.ptp(np.concatenate([crown, gum]), axis=1)
    cell = max(float(np.median(size.max(1))) * 1.5, float((high - low).max()) / 256, 1e-9)
    cells = np.floor((high - low) / cell).astype(np.int64) + 1
    starts, items = _grid(gum, low, cell, cells)
    segments, owner = _cut(crown, gum, low, cell, cells, starts, items)
    long = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1) > _SHORTEST_MM
    segments, corners = segments[long], crown[owner[long]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across = np.cross(normal, segments[:, 1] - segments[:, 0])
    return segments, across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-18)


def _touching(triangles: Array, low: Array, high: Array) -> Mask:
    return (triangles.min(1) <= high).all(1) & (triangles.max(1) >= low).all(1)


@numba.njit(nogil=True, cache=True)
def _box(triangle: Array, low: Array, cell: float, count: Indices, first: Indices, last: Indices) -> None:
    """Write the first and last grid cell that the bounding box of a triangle overlaps."""
    for k in range(3):
        a = min(triangle[0, k], triangle[1, k], triangle[2, k])
        b = max(triangle[0, k], triangle[1, k], triangle[2, k])
        first[k] = min(max(int(np.floor((a - low[k]) / cell)), 0), count[k] - 1)
        last[k] = min(max(int(np.floor((b - low[k]) / cell)), 0), count[k] - 1)


@numba.njit(nogil=True, cache=True)
def _grid(triangles: Array, low: Array, cell: float, count: Indices) -> tuple[Indices, Indices]:
    """Sort triangles into grid cells: the members of cell c are items[starts[c]:starts[c + 1]]."""
    first = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    starts = np.zeros(count[0] * count[1] * count[2] + 1, np.int64)
    fill = starts
    items = starts
    for step in range(2):
        for t in range(len(triangles)):
            _box(triangles[t], low, cell, count, first, last)
            for i in range(first[0], last[0] + 1):
                for j in range(first[1], last[1] + 1):
                    for k in range(first[2], last[2] + 1):
                        c = (i * count[1] + j) * count[2] + k
                        if step == 0:
                            starts[c + 1] += 1
                        else:
                            items[fill[c]] = t
                            fill[c] += 1
        if step == 0:
            starts = np.cumsum(starts)
            items = np.empty(starts[-1], np.int64)
            fill = starts[:-1].copy()
    return starts, items


@numba.njit(nogil=True, cache=True)
def _cut(
    crown: Array, gum: Array, low: Array, cell: float, count: Indices, starts: Indices, items: Indices
) -> tuple[Array, Indices]:
    """Return the segments in which crown and gum triangles intersect, and indices of their crown triangles."""
    first = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    first_g = np.empty(3, np.int64)
    last_g = np.empty(3, np.int64)
    points = np.empty((6, 3))
    out = np.empty((1024, 2, 3))
    owner = np.empty(1024, np.int64)
    n = 0
    for t in range(len(crown)):
        _box(crown[t], low, cell, count, first, last)
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                for k in range(first[2], last[2] + 1):
                    c = (i * count[1] + j) * count[2] + k
                    for q in range(starts[c], starts[c + 1]):
                        g = items[q]
                        _box(gum[g], low, cell, count, first_g, last_g)
                        # The bounding boxes of both triangles may share several cells; the pair is tested only in the
                        # first of these.
                        if (
                            i != max(first[0], first_g[0])
                            or j != max(first[1], first_g[1])
                            or k != max(first[2], first_g[2])
                        ):
                            continue
                        if _common_segment(crown[t], gum[g], points):
                            if n == len(out):
                                grown = np.empty((2 * n, 2, 3))
                                grown[:n] = out
                                out = grown
                                owner = np.concatenate((owner, np.empty(n, np.int64)))
                            out[n] = points[:2]
                            owner[n] = t
                            n += 1
    return out[:n].copy(), owner[:n].copy()


@numba.njit(nogil=True, cache=True)
def _common_segment(a: Array, b: Array, points: Array) -> bool:
    """Write the end points of the segment in which two triangles intersect; return whether they intersect."""
    n = 0
    for e in range(3):
        if _pierce(a[e], a[(e + 1) % 3], b, points[n]):
            n += 1
        if _pierce(b[e], b[(e + 1) % 3], a, points[n]):
            n += 1
    if n < 2:
        return False
    far = 1
    widest = -1.0
    for i in range(1, n):
        d = 0.0
        for k in range(3):
            d += (points[i, k] - points[0, k]) ** 2
        if d > widest:
            widest = d
            far = i
    points[1] = points[far]
    return True


@numba.njit(nogil=True, cache=True)
def _pierce(p: Array, q: Array, triangle: Array, out: Array) -> bool:
    """Write the point in which segment pq crosses a triangle (Moeller & Trumbore 1997); return whether it does so."""
    dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    ax, ay, az = triangle[1, 0] - triangle[0, 0], triangle[1, 1] - triangle[0, 1], triangle[1, 2] - triangle[0, 2]
    bx, by, bz = triangle[2, 0] - triangle[0, 0], triangle[2, 1] - triangle[0, 1], triangle[2, 2] - triangle[0, 2]
    hx, hy, hz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
    det = ax * hx + ay * hy + az * hz
    if abs(det) < 1e-14:
        return False
    sx, sy, sz = p[0] - triangle[0, 0], p[1] - triangle[0, 1], p[2] - triangle[0, 2]
    u = (sx * hx + sy * hy + sz * hz) / det
    if u < 0 or u > 1:
        return False
    kx, ky, kz = sy * az - sz * ay, sz * ax - sx * az, sx * ay - sy * ax
    v = (dx * kx + dy * ky + dz * kz) / det
    if v < 0 or u + v > 1:
        return False
    t = (bx * kx + by * ky + bz * kz) / det
    if t < 0 or t > 1:
        return False
    out[0], out[1], out[2] = p[0] + t * dx, p[1] + t * dy, p[2] + t * dz
    return True
