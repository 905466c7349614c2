"""Points on the visible contour of a projected scan: silhouette edges, scan borders and the gingival margin."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.tracking.contour.scan import CROWN, GUM, Faces, Scan

# Columns of a sample: point in scan coordinates [mm], pixel, outward unit normal in the image, contour length that the
# sample represents [px], inverse depth [1/mm]; then the effects of annotator bias on the position of the outline along
# its normal: fraction of tooth edge and of gum line [-], and motion per mm of gum line moved along the crown surface
# [px/mm].
X, Y, Z, U, V, NX, NY, LENGTH, INVERSE_DEPTH, EDGE_SHARE, GUM_SHARE, GUM_SLOPE = range(12)
COLUMNS = 12
HABITS = slice(EDGE_SHARE, COLUMNS)  # annotator bias shifts outlines by samples[:, HABITS] @ (edge px, gum px, gum mm)

# Distances from visible gum at which an outline starts to count as gum line, and at which it counts fully [mm]:
# boundaries of painted labels are blurred, since brushes are half a millimetre wide.
_GUM_FAR_MM, _GUM_NEAR_MM = 1.0, 0.55
# For scans without gum: cosines to the gum direction at which an outline starts to count as gum line, and at which it
# counts fully [-]. Only incisal edges and cusps are certainly free of gum, since papillae hide the sides of crowns.
_LEAST_FACING, _FULL_FACING = -0.6, -0.2
# Two samples are on the same outline if they lie within `_BESIDE_PX` and the cosine between their normals is at least
# `_SAME_WAY`. The inner sample is dropped if the outer one is farther out by `_OUTSIDE_PX` plus `_OUTSIDE_SLOPE` times
# their distance along the outline.
_BESIDE_PX, _OUTSIDE_PX, _OUTSIDE_SLOPE, _SAME_WAY = 1.5, 0.05, 0.35, 0.3


def contour_samples(
    scan: Scan,
    matrix: Array,
    eye: Array,
    labels: NDArray[np.uint8],
    inverse_depth: NDArray[np.float32],
    step_px: float,
    depth_tolerance_mm: float,
    towards_gum: Array | None = None,
) -> tuple[Array, int]:
    """Return the contour points at which the label changes from crown to another one, shape (n, COLUMNS).

    Silhouette samples come first; the second result is their number.

    Args:
        matrix: projection from scan coordinates [mm] to homogeneous px of the region, shape (3, 4).
        eye: camera centre in scan coordinates [mm], shape (3,).
        labels, inverse_depth: visible label (CROWN, GUM or 0) and inverse depth [1/mm] of every pixel, shape (h, w).
        step_px: maximum distance between samples.
        depth_tolerance_mm: maximum decrease in depth from a contour point to the surface just inside it, which
            otherwise hides the point.
        towards_gum: for scans without gum, unit vector (3,) in scan coordinates: outlines facing this way are gum line.
    """
    candidates = _silhouette(
        scan.vertices, scan.crown_faces, scan.planes, scan.edges, eye, matrix, step_px, labels.shape
    )
    facing = _in_picture(matrix, np.zeros(3) if towards_gum is None else towards_gum)
    px_per_mm = _px_per_mm(matrix, scan.centre)
    visible = _visible(candidates, labels, inverse_depth, depth_tolerance_mm, px_per_mm, facing)
    silhouette, margin = _outermost(visible, labels.shape), (scan.gingival_margin, scan.margin_directions)
    line = _gingival_margin(*margin, matrix, labels, inverse_depth, depth_tolerance_mm)
    return np.concatenate((silhouette, line)), len(silhouette)


@numba.njit(nogil=True, cache=True)
def _px_per_mm(matrix: Array, point: Array) -> float:
    """Return the image scale at a point (3,) of the scan [px/mm]."""
    depth = matrix[2, 0] * point[0] + matrix[2, 1] * point[1] + matrix[2, 2] * point[2] + matrix[2, 3]
    x = matrix[0, 1] * matrix[2, 2] - matrix[0, 2] * matrix[2, 1]
    y = matrix[0, 2] * matrix[2, 0] - matrix[0, 0] * matrix[2, 2]
    z = matrix[0, 0] * matrix[2, 1] - matrix[0, 1] * matrix[2, 0]
    return np.sqrt(x * x + y * y + z * z) / max(depth, 1e-9)


@numba.njit(nogil=True, cache=True)
def _in_picture(matrix: Array, direction: Array) -> Array:
    """Return the image components, right and down, of a direction (3,) in scan coordinates, shape (2,)."""
    away = matrix[2, :3] / np.sqrt((matrix[2, :3] ** 2).sum())
    out = np.empty(2)
    for k in range(2):
        axis = matrix[k, :3] - (matrix[k, :3] * away).sum() * away
        out[k] = (axis * direction).sum() / np.sqrt((axis**2).sum())
    return out


@numba.njit(nogil=True, cache=True, inline="always")
def pixel(matrix: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the pixel (u, v) and the depth [mm] of a point under a projection (3, 4)."""
    w = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / w
    v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / w
    return u, v, w


@numba.njit(nogil=True, cache=True)
def _silhouette(
    vertices: Array,
    faces: Faces,
    planes: Array,
    edges: Faces,
    eye: Array,
    matrix: Array,
    step_px: float,
    shape: tuple[int, int],
) -> Array:
    """Sample edges between front and back faces, and all borders, inside the region."""
    front = np.empty(len(faces), np.bool_)
    for f in range(len(faces)):
        front[f] = planes[f, 0] * eye[0] + planes[f, 1] * eye[1] + planes[f, 2] * eye[2] > planes[f, 3]
    out = np.empty((4096, COLUMNS))
    n = 0
    for e in range(len(edges)):
        i, j, f, g = edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3]
        if g >= 0 and front[f] == front[g]:
            continue
        if g >= 0 and not front[f]:
            f = g
        ui, vi, wi = pixel(matrix, vertices[i, 0], vertices[i, 1], vertices[i, 2])
        uj, vj, wj = pixel(matrix, vertices[j, 0], vertices[j, 1], vertices[j, 2])
        if wi <= 0 or wj <= 0:
            continue
        if max(ui, uj) < 0 or max(vi, vj) < 0 or min(ui, uj) >= shape[1] or min(vi, vj) >= shape[0]:
            continue
        length = np.sqrt((uj - ui) ** 2 + (vj - vi) ** 2)
        if length < 1e-6:
            continue
        nx = (vj - vi) / length
        ny = (ui - uj) / length
        k = faces[f, 0]
        if k in (i, j):
            k = faces[f, 1]
        if k in (i, j):
            k = faces[f, 2]
        uk, vk, wk = pixel(matrix, vertices[k, 0], vertices[k, 1], vertices[k, 2])
        if nx * (uk - ui) + ny * (vk - vi) > 0:  # make the normal point away from the third corner of the face
            nx = -nx
            ny = -ny
        pieces = max(1, int(np.ceil(length / step_px)))
        if n + pieces > len(out):
            grown = np.empty((2 * len(out) + pieces, COLUMNS))
            grown[:n] = out[:n]
            out = grown
        for q in range(pieces):
            t = (q + 0.5) / pieces
            sample = out[n]
            for a in range(3):
                sample[a] = vertices[i, a] + t * (vertices[j, a] - vertices[i, a])
            sample[U], sample[V], w = pixel(matrix, sample[X], sample[Y], sample[Z])
            sample[NX], sample[NY] = nx, ny
            sample[LENGTH] = length / pieces
            sample[INVERSE_DEPTH] = 1.0 / w
            # A border of the crown mesh adjoins the gum, or lies where the gum was cut off.
            sample[GUM_SHARE] = 1.0 if g < 0 else 0.0
            sample[GUM_SLOPE] = _border_slope(vertices, i, j, k, sample, matrix, w) if g < 0 else 0.0
            n += 1
    return out[:n]


@numba.njit(nogil=True, cache=True)
def _border_slope(vertices: Array, i: int, j: int, k: int, sample: Array, matrix: Array, w: float) -> float:
    """Return the motion of border ij along its image normal per mm away from corner k of its triangle [px/mm]."""
    ex, ey, ez = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1], vertices[j, 2] - vertices[i, 2]
    tx, ty, tz = sample[X] - vertices[k, 0], sample[Y] - vertices[k, 1], sample[Z] - vertices[k, 2]
    along = (tx * ex + ty * ey + tz * ez) / max(ex * ex + ey * ey + ez * ez, 1e-18)
    tx, ty, tz = tx - along * ex, ty - along * ey, tz - along * ez
    length = np.sqrt(tx * tx + ty * ty + tz * tz)
    return _shift_px(sample, matrix, w, tx, ty, tz) / length if length > 1e-9 else 0.0


@numba.njit(nogil=True, cache=True, inline="always")
def _shift_px(sample: Array, matrix: Array, w: float, tx: float, ty: float, tz: float) -> float:
    """Return the motion of a sample along its normal [px] if its point moves by (tx, ty, tz) [mm]."""
    depth = matrix[2, 0] * tx + matrix[2, 1] * ty + matrix[2, 2] * tz
    across = matrix[0, 0] * tx + matrix[0, 1] * ty + matrix[0, 2] * tz - sample[U] * depth
    down = matrix[1, 0] * tx + matrix[1, 1] * ty + matrix[1, 2] * tz - sample[V] * depth
    return (sample[NX] * across + sample[NY] * down) / w


@numba.njit(nogil=True, cache=True, inline="always")
def pixel_of(coordinate: float) -> int:
    """Return the index of the pixel that contains a coordinate."""
    return int(np.floor(coordinate + 0.5))


@numba.njit(nogil=True, cache=True, inline="always")
def value_at(picture: NDArray[np.float32] | NDArray[np.uint8], x: float, y: float) -> float:
    """Return the value of the pixel that contains an image position [px]; 0 outside the image."""
    i = pixel_of(x)
    j = pixel_of(y)
    if i < 0 or j < 0 or j >= picture.shape[0] or i >= picture.shape[1]:
        return 0
    return picture[j, i]


@numba.njit(nogil=True, cache=True, inline="always")
def is_nearer(seen: float, own: float, tolerance_mm: float) -> bool:
    """Return whether a rendered surface is in front of a sample by more than the tolerance; depths are inverse."""
    return seen * (1.0 - tolerance_mm * own) > own


@numba.njit(nogil=True, cache=True)
def _visible(
    samples: Array,
    labels: NDArray[np.uint8],
    inverse_depth: NDArray[np.float32],
    tolerance_mm: float,
    px_per_mm: float,
    facing_gum: Array,
) -> Array:
    """Keep samples with their surface just inside and no crown just outside; classify as tooth edge or gum line."""
    out = np.empty_like(samples)
    height, width = labels.shape
    shows_gum = facing_gum[0] == 0.0 and facing_gum[1] == 0.0
    n = 0
    for s in range(len(samples)):
        sample = samples[s]
        i = pixel_of(sample[U] - sample[NX])
        j = pixel_of(sample[V] - sample[NY])
        a = pixel_of(sample[U] + sample[NX])
        b = pixel_of(sample[V] + sample[NY])
        if min(i, a) < 0 or min(j, b) < 0 or max(i, a) >= width or max(j, b) >= height:
            continue
        if labels[b, a] == CROWN or labels[j, i] != CROWN:
            continue
        if is_nearer(inverse_depth[j, i], sample[INVERSE_DEPTH], tolerance_mm):
            continue
        out[n] = sample
        if out[n, GUM_SHARE] == 0.0:
            distance_mm = _gum_distance_px(labels, sample[U], sample[V], _GUM_FAR_MM * px_per_mm) / px_per_mm
            share = (_GUM_FAR_MM - distance_mm) / (_GUM_FAR_MM - _GUM_NEAR_MM)
            if not shows_gum:
                cosine = sample[NX] * facing_gum[0] + sample[NY] * facing_gum[1]
                share = max(share, (cosine - _LEAST_FACING) / (_FULL_FACING - _LEAST_FACING))
            out[n, GUM_SHARE] = min(max(share, 0.0), 1.0)
        out[n, EDGE_SHARE] = 1.0 - out[n, GUM_SHARE]
        n += 1
    return out[:n]


@numba.njit(nogil=True, cache=True)
def _outermost(samples: Array, shape: tuple[int, int]) -> Array:
    """Drop samples that lie inside the outline by less than one pixel, which is the resolution of `_visible`.

    At an edge with small or noisy faces, several silhouette lines can lie within a pixel. Only the outermost one is the
    outline; the others would bias it inwards by 0.03 to 0.05 px.
    """
    rows, columns = int(shape[0] / _BESIDE_PX) + 3, int(shape[1] / _BESIDE_PX) + 3
    last = np.full((rows, columns), -1, np.int32)  # index of the last sample in every cell
    before = np.empty(len(samples), np.int32)  # index of the previous sample in the same cell
    for s in range(len(samples)):
        j, i = int(samples[s, V] / _BESIDE_PX) + 1, int(samples[s, U] / _BESIDE_PX) + 1
        before[s] = last[j, i]
        last[j, i] = s
    out = np.empty_like(samples)
    n = 0
    for s in range(len(samples)):
        if not _has_one_outside(samples, s, last, before):
            out[n] = samples[s]
            n += 1
    return out[:n]


@numba.njit(nogil=True, cache=True)
def _has_one_outside(samples: Array, s: int, last: NDArray[np.int32], before: NDArray[np.int32]) -> bool:
    """Return whether another sample on the same outline lies farther out than sample s."""
    u, v, nx, ny = samples[s, U], samples[s, V], samples[s, NX], samples[s, NY]
    j, i = int(v / _BESIDE_PX) + 1, int(u / _BESIDE_PX) + 1
    for row in range(j - 1, j + 2):
        for column in range(i - 1, i + 2):
            k = last[row, column]
            while k >= 0:
                du, dv = samples[k, U] - u, samples[k, V] - v
                along, outside = abs(du * ny - dv * nx), du * nx + dv * ny
                near = max(along, outside) < _BESIDE_PX and outside > _OUTSIDE_PX + _OUTSIDE_SLOPE * along
                if near and samples[k, NX] * nx + samples[k, NY] * ny > _SAME_WAY:
                    return True
                k = before[k]
    return False


@numba.njit(nogil=True, cache=True, inline="always")
def _gum_distance_px(labels: NDArray[np.uint8], u: float, v: float, reach_px: float) -> float:
    """Return the distance to the nearest gum pixel [px], clipped at `reach_px`."""
    i = pixel_of(u)
    j = pixel_of(v)
    height, width = labels.shape
    n = int(reach_px)
    best = reach_px * reach_px
    for dy in range(n + 1):  # search outwards until no remaining pixel can be nearer
        if dy * dy >= best:
            break
        for y in (j - dy, j + dy):
            if y < 0 or y >= height:
                continue
            for dx in range(n + 1):
                square = float(dx * dx + dy * dy)
                if square >= best:
                    break
                if (0 <= i - dx < width and labels[y, i - dx] == GUM) or (
                    0 <= i + dx < width and labels[y, i + dx] == GUM
                ):
                    best = square
                    break
    return np.sqrt(best)


@numba.njit(nogil=True, cache=True)
def _gingival_margin(
    segments: Array,
    directions: Array,
    matrix: Array,
    labels: NDArray[np.uint8],
    inverse_depth: NDArray[np.float32],
    tolerance_mm: float,
) -> Array:
    """Sample the gingival margin where crown is visible on one side and gum on the other; normals point to gum."""
    reach = 1.5  # distance [px] to the nearest pixels that lie entirely on one side of the margin
    out = np.empty((len(segments), COLUMNS))
    height, width = labels.shape
    n = 0
    for s in range(len(segments)):
        p = segments[s, 0]
        q = segments[s, 1]
        x, y, z = 0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1]), 0.5 * (p[2] + q[2])
        u, v, w = pixel(matrix, x, y, z)
        if w <= 0 or u < 3 or v < 3 or u > width - 4 or v > height - 4:
            continue
        up, vp, wp = pixel(matrix, p[0], p[1], p[2])
        uq, vq, wq = pixel(matrix, q[0], q[1], q[2])
        length = np.sqrt((uq - up) ** 2 + (vq - vp) ** 2)
        if length < 0.05:  # image length [px] below which a segment is viewed end-on, so its direction is undefined
            continue
        nx = reach * (vq - vp) / length
        ny = reach * (up - uq) / length
        first = labels[pixel_of(v + ny), pixel_of(u + nx)]
        second = labels[pixel_of(v - ny), pixel_of(u - nx)]
        if first == CROWN and second == GUM:
            nx = -nx
            ny = -ny
        elif first != GUM or second != CROWN:
            continue
        if is_nearer(inverse_depth[pixel_of(v - ny), pixel_of(u - nx)], 1.0 / w, tolerance_mm):
            continue
        if is_nearer(inverse_depth[pixel_of(v + ny), pixel_of(u + nx)], 1.0 / w, tolerance_mm):
            continue
        out[n, X], out[n, Y], out[n, Z], out[n, U], out[n, V] = x, y, z, u, v
        out[n, NX], out[n, NY], out[n, LENGTH], out[n, INVERSE_DEPTH] = nx / reach, ny / reach, length, 1.0 / w
        out[n, EDGE_SHARE], out[n, GUM_SHARE] = 0.0, 1.0
        # The slope is positive towards the gum, like the normal, whatever the sign of the direction.
        out[n, GUM_SLOPE] = abs(_shift_px(out[n], matrix, w, directions[s, 0], directions[s, 1], directions[s, 2]))
        n += 1
    return out[:n]
