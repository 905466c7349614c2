"""Rasterise projected triangle meshes on the CPU: silhouettes as bit-packed images, depth as 1/z.

The compiled functions release the GIL and have no state, so threads may call them concurrently. The compiled code is
cached on disk; argument types are fixed (C-contiguous float32 / int32 / uint64 arrays), so that another dtype raises a
TypeError instead of triggering a second compilation.

Conventions: pixel coordinates are OpenCV's, with the centre of the top left pixel at (0, 0). A buffer covers a region
of the image that has the buffer's shape and starts at pixel (x0, y0). A silhouette is a (h, words) uint64 array; bit
``x & 63`` of word ``x >> 6`` is pixel x of the region; bits beyond the width stay zero.

Edge rule: a pixel is covered iff its centre lies inside a projected triangle or on its border. Every edge is evaluated
from its upper end, so that both adjacent triangles get equal values and closed meshes have no cracks. Pixels covered
twice do not affect unions or nearest depths. (A top-left rule would drop centres exactly on the outline.)
"""

from __future__ import annotations

import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

from jawusd.base.arrays import Mask

_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
_ONE = np.uint64(1)
_LOW6 = 63
# Minimum depth [mm]; triangles with a closer corner, or one behind the camera, are not drawn.
_MIN_DEPTH = np.float32(1e-3)


def _array(dtype: types.Type, mutable: bool = False) -> types.Array:
    return types.Array(dtype, 2, "C", readonly=not mutable)


_POINTS = _array(types.float32)
_FACES = _array(types.int32)
_BITS = _array(types.uint64)
_BITS_OUT = _array(types.uint64, mutable=True)
_DEPTH_OUT = _array(types.float32, mutable=True)
_LABELS_OUT = _array(types.uint8, mutable=True)
_INT = types.int64

Singles = NDArray[np.float32]
Bits = NDArray[np.uint64]
_Edges = tuple[float, float, float, float, float, float, float, float, float]


@numba.njit(types.void(_POINTS, _POINTS, _DEPTH_OUT), nogil=True, cache=True)
def project(vertices: Singles, matrix: Singles, out: Singles) -> None:
    """Project vertices with a 3x4 matrix.

    Args:
        vertices: (V, 3) float32 [mm], in the coordinate frame that the matrix maps from.
        matrix: (3, 4) float32, K [R | t] @ T; maps homogeneous coordinates [mm] to (u z, v z, z).
        out: (V, 3) float32, receives u [px], v [px], depth z [mm]. u, v are undefined where z <= 0.
    """
    for i in range(vertices.shape[0]):
        x = vertices[i, 0]
        y = vertices[i, 1]
        z = vertices[i, 2]
        depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
        scale = np.float32(1.0) / depth if depth != 0 else np.float32(0.0)
        out[i, 0] = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) * scale
        out[i, 1] = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) * scale
        out[i, 2] = depth


@numba.njit(nogil=True, cache=True)
def _hidden(points: Singles, a: int, b: int, c: int, cull: bool) -> bool:
    """Return whether a triangle touches the camera plane or, with `cull`, is a back face (area >= 0, as y is down)."""
    if not (points[a, 2] > _MIN_DEPTH and points[b, 2] > _MIN_DEPTH and points[c, 2] > _MIN_DEPTH):
        return True
    if not cull:
        return False
    area = (points[b, 0] - points[a, 0]) * (points[c, 1] - points[a, 1]) - (points[b, 1] - points[a, 1]) * (
        points[c, 0] - points[a, 0]
    )
    return area >= 0


@numba.njit(nogil=True, cache=True)
def _edges(points: Singles, a: int, b: int, c: int) -> _Edges:
    """Sort a triangle's corners by v; return the corners and the three edge slopes du/dv (0 for level edges)."""
    ax = np.float64(points[a, 0])
    ay = np.float64(points[a, 1])
    bx = np.float64(points[b, 0])
    by = np.float64(points[b, 1])
    cx = np.float64(points[c, 0])
    cy = np.float64(points[c, 1])
    if ay > by:
        ax, ay, bx, by = bx, by, ax, ay
    if by > cy:
        bx, by, cx, cy = cx, cy, bx, by
    if ay > by:
        ax, ay, bx, by = bx, by, ax, ay
    slope_ac = (cx - ax) / (cy - ay) if cy > ay else 0.0
    slope_ab = (bx - ax) / (by - ay) if by > ay else 0.0
    slope_bc = (cx - bx) / (cy - by) if cy > by else 0.0
    return ax, ay, bx, by, cx, cy, slope_ac, slope_ab, slope_bc


@numba.njit(nogil=True, cache=True)
def _interval(low: float, high: float, first: int, last: int) -> tuple[int, int]:
    """Return the first and last integer (i, j) in both [low, high] and [first, last]; i > j if none, or for NaN.

    Values are clamped as floats first: casting a NaN or a huge coordinate to an integer is undefined.
    """
    i = np.ceil(low)
    j = np.floor(high)
    if i < first:
        i = np.float64(first)
    if j > last:
        j = np.float64(last)
    if not i <= j:
        return 1, 0
    return int(i), int(j)


@numba.njit(nogil=True, cache=True)
def _span(edges: _Edges, y: int, first: int, last: int) -> tuple[int, int]:
    """Return the columns (i, j) of the first and last covered pixel of image row y, within columns [first, last]."""
    ax, ay, bx, by, cx, cy, slope_ac, slope_ab, slope_bc = edges
    if ay == cy:  # a degenerate triangle, projected to a line along the row
        return _interval(min(ax, bx, cx), max(ax, bx, cx), first, last)
    left = ax + (y - ay) * slope_ac
    right = ax + (y - ay) * slope_ab if y < by else bx + (y - by) * slope_bc
    if left > right:
        left, right = right, left
    return _interval(left, right, first, last)


@numba.njit(nogil=True, cache=True)
def _fill(row: Bits, i: int, j: int) -> None:
    """Set bits i to j (inclusive) of a bit row."""
    word = i >> 6
    last = j >> 6
    head = _ALL << np.uint64(i & _LOW6)
    tail = _ALL >> np.uint64(_LOW6 - (j & _LOW6))
    if word == last:
        row[word] |= head & tail
        return
    row[word] |= head
    for k in range(word + 1, last):
        row[k] = _ALL
    row[last] |= tail


@numba.njit(types.void(_POINTS, _FACES, _INT, _INT, _INT, types.boolean, _BITS_OUT), nogil=True, cache=True)
def draw_silhouette(
    points: Singles, faces: NDArray[np.int32], x0: int, y0: int, width: int, cull: bool, bits: Bits
) -> None:
    """Add the silhouette of projected triangles to a bit-row buffer.

    Args:
        points: (V, 3) float32, u [px], v [px], depth [mm] as `project` writes them.
        faces: (F, 3) int32, valid indices into points (not checked).
        x0, y0: image pixel at the buffer's top left corner.
        width: pixels per row; bits.shape[1] must be at least words_for(width).
        cull: whether to skip back faces; allowed for closed meshes with outward winding, where it changes nothing.
        bits: (h, words) uint64; clear it before the first call.

    Raises:
        ValueError: the buffer's rows are shorter than width.
    """
    if bits.shape[1] * 64 < width:
        raise ValueError("bits: the rows have fewer than `width` pixels")
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if _hidden(points, a, b, c, cull):
            continue
        edges = _edges(points, a, b, c)
        top, bottom = _interval(edges[1], edges[5], y0, y0 + bits.shape[0] - 1)
        for y in range(top, bottom + 1):
            i, j = _span(edges, y, x0, x0 + width - 1)
            if i <= j:
                _fill(bits[y - y0], i - x0, j - x0)


@numba.njit(nogil=True, cache=True)
def _inverse_depth_plane(points: Singles, a: int, b: int, c: int) -> tuple[float, float, float, float, float]:
    """Return 1/z at corner a, and its image gradient and range; 1/z is affine over a projected triangle."""
    ia = 1.0 / points[a, 2]
    ib = 1.0 / points[b, 2]
    ic = 1.0 / points[c, 2]
    bu = np.float64(points[b, 0]) - points[a, 0]
    bv = np.float64(points[b, 1]) - points[a, 1]
    cu = np.float64(points[c, 0]) - points[a, 0]
    cv = np.float64(points[c, 1]) - points[a, 1]
    area = bu * cv - bv * cu
    low = min(ia, ib, ic)
    high = max(ia, ib, ic)
    if area == 0.0:
        return high, 0.0, 0.0, high, high
    du = ((ib - ia) * cv - (ic - ia) * bv) / area
    dv = ((ic - ia) * bu - (ib - ia) * cu) / area
    return ia, du, dv, low, high


@numba.njit(
    types.void(_POINTS, _FACES, _INT, _INT, types.boolean, _DEPTH_OUT, _LABELS_OUT, types.uint8),
    nogil=True,
    cache=True,
)
def draw_depth_labels(
    points: Singles,
    faces: NDArray[np.int32],
    x0: int,
    y0: int,
    cull: bool,
    inverse_depth: Singles,
    labels: NDArray[np.uint8],
    label: int,
) -> None:
    """Draw projected triangles into a nearest-surface buffer and record which mesh is visible.

    Args:
        points, faces, x0, y0, cull: as for `draw_silhouette`.
        inverse_depth: (h, w) float32, 1/z [1/mm], 0 = empty; clear it before the first call. Ties keep the old value.
        labels: (h, w) uint8, receives `label` where the mesh is nearest; an empty (0, 0) array disables this.

    Raises:
        ValueError: labels is neither empty nor as large as inverse_depth.
    """
    keep_labels = labels.shape[0] > 0
    if keep_labels and labels.shape != inverse_depth.shape:
        raise ValueError("labels: the array must be empty or have the shape of inverse_depth")
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if _hidden(points, a, b, c, cull):
            continue
        edges = _edges(points, a, b, c)
        top, bottom = _interval(edges[1], edges[5], y0, y0 + inverse_depth.shape[0] - 1)
        if top > bottom:
            continue
        corner, du, dv, low, high = _inverse_depth_plane(points, a, b, c)
        for y in range(top, bottom + 1):
            i, j = _span(edges, y, x0, x0 + inverse_depth.shape[1] - 1)
            row = inverse_depth[y - y0]
            start = corner + dv * (y - points[a, 1])
            for x in range(i, j + 1):
                # Clamp: on slivers, the ill-conditioned gradient would extrapolate beyond the values at the
                # corners.
                value = np.float32(min(max(start + du * (x - points[a, 0]), low), high))
                if value > row[x - x0]:
                    row[x - x0] = value
                    if keep_labels:
                        labels[y - y0, x - x0] = label


@numba.njit(types.uint64(types.uint64), nogil=True, cache=True)
def _popcount(x: np.uint64) -> np.uint64:
    """Count the set bits of a word (H. S. Warren, Hacker's Delight, fig. 5-2; LLVM compiles this to popcnt)."""
    x = x - ((x >> _ONE) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (x * np.uint64(0x0101010101010101)) >> np.uint64(56)


def count_bits(bits: Bits) -> int:
    """Count the set pixels of a (h, words) uint64 bit-row image."""
    return int(np.bitwise_count(bits).sum())


@numba.njit(_INT(_BITS, _BITS), nogil=True, cache=True)
def count_and_not(first: Bits, second: Bits) -> np.int64:
    """Count the pixels that are set in `first` but not in `second`; both have shape (h, words), uint64.

    Raises:
        ValueError: the two images differ in shape.
    """
    if first.shape != second.shape:
        raise ValueError("the two bit-packed images have different shapes")
    total = np.uint64(0)
    for y in range(first.shape[0]):
        for k in range(first.shape[1]):
            total += _popcount(first[y, k] & ~second[y, k])
    return np.int64(total)


def words_for(width: int) -> int:
    """Return the number of 64-bit words in a row of ``width`` pixels."""
    return (width + 63) // 64


def pack_bits(mask: Mask | NDArray[np.uint8]) -> Bits:
    """Pack a (h, w) image (non-zero = set) into (h, words) uint64 bit rows.

    Raises:
        ValueError: mask is not two-dimensional.
    """
    if mask.ndim != 2:
        raise ValueError(f"mask: the shape is {mask.shape}; expected (h, w)")
    height, width = mask.shape
    padded = np.zeros((height, words_for(width) * 64), bool)
    padded[:, :width] = mask != 0
    return np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64, copy=False)


def unpack_bits(bits: Bits, width: int) -> Mask:
    """Unpack (h, words) uint64 bit rows into a (h, width) bool image.

    Raises:
        ValueError: the rows are shorter than width.
    """
    if bits.ndim != 2 or bits.shape[1] * 64 < width:
        raise ValueError(f"bits: the shape is {bits.shape}; expected (h, n) with n >= {words_for(width)}")
    bytes_ = np.ascontiguousarray(bits.astype("<u8", copy=False)).view(np.uint8)
    return np.unpackbits(bytes_, axis=1, bitorder="little")[:, :width].view(bool)
