"""Tooth outlines in photographs: the lines drawn by hand, and the outlines of rendered crowns, split into teeth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label, sum_labels

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.geometry import transform_points
from jawusd.meshes.raster import draw_depth_labels, project
from jawusd.meshes.scan_surface import components
from jawusd.tracking.contour.scan import Faces, Scan

_WIDTH_PX = 1.8  # standard deviation of the Gaussian blur, with which lines a few pixels wide form a single ridge
_FAINT = 0.12  # minimum ridge strength relative to that of the strongest ridges
_SHORTEST_PX = 60  # minimum length of isolated strokes; shorter strokes are ignored
_FEWEST_POINTS = 300


@dataclass(frozen=True, eq=False)
class Drawing:
    """The lines drawn in one photograph."""

    name: str  # name of the photograph, for messages
    pixels: Array  # points on the lines [px], about one pixel apart, shape (N, 2)
    normals: Array  # unit vectors across the lines, of arbitrary sign, shape (N, 2)
    size_px: tuple[int, int]  # width and height of the image

    def mirrored(self) -> Drawing:
        """Return the drawing with left and right exchanged."""
        flip = np.array([-1.0, 1.0])
        return Drawing(self.name, self.pixels * flip + [self.size_px[0] - 1.0, 0.0], self.normals * flip, self.size_px)

    def shrunk(self, factor: float) -> Drawing:
        """Return the drawing downscaled by a factor, with fewer points."""
        size = (max(1, round(self.size_px[0] * factor)), max(1, round(self.size_px[1] * factor)))
        every = slice(None, None, max(1, round(1.0 / factor)))
        pixels = (self.pixels[every] + 0.5) * factor - 0.5
        return Drawing(self.name, pixels, self.normals[every], size)


def read_lines(picture: NDArray[np.uint8], name: str) -> Drawing:
    """Extract the centrelines of the bright lines in a grey image (h, w).

    A centreline is a maximum of the smoothed image across the direction of strongest curvature, with sub-pixel
    accuracy (Steger, An unbiased detector of curvilinear structures, 1998, section 3).

    Raises:
        TrackingError: the image contains too few lines.
    """
    soft = gaussian_filter(picture.astype(np.float64), _WIDTH_PX)
    dy, dx = np.gradient(soft)
    dxy, dxx = np.gradient(dx)
    dyy = np.gradient(dy, axis=0)
    half, mixed = 0.5 * (dxx - dyy), dxy
    strength = -(0.5 * (dxx + dyy) - np.hypot(half, mixed))
    rows, columns = np.nonzero(strength > max(_FAINT * np.percentile(strength, 99.9), 1e-6))
    angle = 0.5 * np.arctan2(mixed, half)[rows, columns]
    # The directions of the most negative and of the largest curvature are perpendicular.
    nx, ny = -np.sin(angle), np.cos(angle)
    along = nx * dx[rows, columns] + ny * dy[rows, columns]
    step = along / strength[rows, columns]
    middle = (np.abs(step * nx) <= 0.5) & (np.abs(step * ny) <= 0.5)
    pixels = np.column_stack([columns + step * nx, rows + step * ny])[middle]
    normals = np.column_stack([nx, ny])[middle]
    line, ridge = np.zeros(picture.shape, bool), np.zeros(picture.shape, bool)
    line[rows[middle], columns[middle]], ridge[rows, columns] = True, True
    strokes, count = label(ridge, np.ones((3, 3)))
    lengths = sum_labels(line, strokes, np.arange(1, count + 1))
    keep = lengths[strokes[rows[middle], columns[middle]] - 1] >= _SHORTEST_PX
    if keep.sum() < _FEWEST_POINTS:
        raise TrackingError(
            f"{name}: the drawn lines cover {keep.sum()} px; at least {_FEWEST_POINTS} px are needed",
            hint="Draw bright lines along the outlines of the teeth on a black background.",
        )
    return Drawing(name, pixels[keep], normals[keep], (picture.shape[1], picture.shape[0]))


def features(pixels: Array, normals: Array, turn_px: float) -> Array:
    """Return features (x, y, cos 2a, sin 2a), shape (N, 4), whose distances combine position and direction.

    The distance between perpendicular directions is 2 `turn_px`; the sign of a normal is irrelevant.
    """
    double = np.column_stack([normals[:, 0] ** 2 - normals[:, 1] ** 2, 2 * normals[:, 0] * normals[:, 1]])
    return np.hstack([pixels, turn_px * double])


_FEWEST_FACES = 50  # minimum number of faces of a tooth; smaller pieces are scanning artefacts
_MOST_TEETH = 120  # maximum number of separate teeth per arch, since the labels of both arches are stored in one byte
# Strip of faces added where the scan has no gum: number of segments, start as a fraction of the crown height [-], and
# height [mm].
_WALL_PARTS, _WALL_FROM, _WALL_MM = 24, 0.75, 15.0
_SMOOTH_PX = 2.0  # standard deviation of the Gaussian that averages the direction of an outline


@dataclass(frozen=True, eq=False)
class Crowns:
    """One arch split into connected pieces: single teeth where the scan separates them, otherwise groups of teeth."""

    scan: Scan
    teeth: tuple[Faces, ...]  # faces of every tooth or group of connected teeth, each of shape (F, 3)
    to_gum: Array  # unit vector from the crowns to their gum, scan coordinates, shape (3,)


@dataclass(frozen=True, eq=False)
class Outlines:
    """Points on the visible outlines of all teeth in one image."""

    points: Array  # points on the crowns, scan coordinates of their own arch [mm], shape (N, 3)
    arch: NDArray[np.int64]  # 0 upper, 1 lower, shape (N,)
    pixels: Array  # image positions [px], shape (N, 2)
    normals: Array  # unit normals pointing out of the tooth in the image, shape (N, 2)
    gum: Array  # 1 where the outline faces the gum of its arch, decreasing to 0 at a right angle [-], shape (N,)

    def take(self, index: NDArray[np.int64]) -> Outlines:
        """Return the points at given indices, which may repeat."""
        return Outlines(*(values[index] for values in vars(self).values()))


def split_teeth(scan: Scan, T_anatomical_scan: Array, arch: int) -> Crowns:
    """Return the crowns of a scan as connected pieces, given T_anatomical_scan (4, 4); `arch` is 0 upper, 1 lower.

    In place of missing gum, faces along the middle of the arch hide the teeth behind them.
    """
    faces = scan.crown_faces
    piece = components(faces, len(scan.vertices))[faces[:, 0]]
    numbers, count = np.unique(piece, return_counts=True)
    large = numbers[count >= _FEWEST_FACES][:_MOST_TEETH]
    to_gum = T_anatomical_scan[1, :3] * (1.0 if arch == 0 else -1.0)
    if len(scan.gum_faces) == 0:
        scan = _with_wall(scan, T_anatomical_scan, to_gum)
    return Crowns(scan, tuple(np.ascontiguousarray(faces[piece == k]) for k in large), to_gum)


def _with_wall(scan: Scan, T_anatomical_scan: Array, to_gum: Array) -> Scan:
    """Return the scan with a strip of faces in place of the gum along the middle of its arch."""
    points = scan.crown_vertices()
    flat = transform_points(T_anatomical_scan, points)
    # The teeth are ordered by their angle as seen from inside the arch.
    angle = np.arctan2(flat[:, 0] - np.median(flat[:, 0]), flat[:, 2] - np.percentile(flat[:, 2], 25))
    bins = np.digitize(angle, np.linspace(angle.min(), angle.max(), _WALL_PARTS + 1)[1:-1])
    height = points @ to_gum
    feet = []
    for k in np.unique(bins):
        own = bins == k
        low, high = np.percentile(height[own], [5, 95])
        middle = points[own].mean(0)
        feet.append(middle + to_gum * (low + _WALL_FROM * (high - low) - middle @ to_gum))
    wall = np.vstack([feet, np.array(feet) + _WALL_MM * to_gum])
    first, n = np.arange(len(feet) - 1), len(feet)
    quads = np.vstack(
        [np.column_stack([first, first + 1, first + n]), np.column_stack([first + 1, first + n + 1, first + n])]
    )
    vertices = np.vstack([scan.vertices, wall])
    gum = np.ascontiguousarray(quads + len(scan.vertices), np.int32)
    return replace(scan, vertices=vertices, vertices_single=vertices.astype(np.float32), gum_faces=gum)


def draw_teeth(
    crowns: Sequence[Crowns], matrices: Sequence[Array], shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the inverse depth [1/mm] and the number of the visible tooth (0: none) at each pixel, shape (h, w) each.

    `matrices` (3, 4) project the upper and the lower scan [mm] to homogeneous px; `shape` is the height and width [px].
    """
    depth, labels = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    number = 0
    for arch, matrix in zip(crowns, matrices, strict=True):
        points = np.empty((len(arch.scan.vertices), 3), np.float32)
        project(arch.scan.vertices_single, matrix.astype(np.float32), points)
        for faces in arch.teeth:
            number += 1
            draw_depth_labels(points, faces, 0, 0, False, depth, labels, number)
        draw_depth_labels(points, arch.scan.gum_faces, 0, 0, False, depth, labels, 0)
    return depth, labels


def outlines_of(
    crowns: Sequence[Crowns], matrices: Sequence[Array], depth: NDArray[np.float32], labels: NDArray[np.uint8]
) -> Outlines:
    """Return the outlines in renderings of `draw_teeth`; they run between pixels and belong to the nearer tooth."""
    found = [_ends(depth, labels), _ends(depth.T, labels.T)]
    (x, y, inside_x, inside_y), (y2, x2, inside_y2, inside_x2) = found
    pixels = np.column_stack([np.r_[x, x2], np.r_[y, y2]])
    inside = np.r_[inside_y, inside_y2].astype(int), np.r_[inside_x, inside_x2].astype(int)
    tooth = labels[inside].astype(np.int64)
    arch = (tooth > len(crowns[0].teeth)).astype(np.int64)
    normals = np.zeros((len(tooth), 2))
    for number in np.unique(tooth):
        own = tooth == number
        normals[own] = _outward(labels == number, inside[0][own], inside[1][own])
    points, gum = np.empty((len(tooth), 3)), np.zeros(len(tooth))
    for r, (matrix, one) in enumerate(zip(matrices, crowns, strict=True)):
        own = arch == r
        at_depth = np.column_stack([pixels[own], np.ones(own.sum())]) / depth[inside][own, None]
        points[own] = np.linalg.solve(matrix[:, :3], (at_depth - matrix[:, 3]).T).T
        across = matrix[:2, :3] - pixels[own][:, :, None] * matrix[2, :3]
        ahead = across @ one.to_gum
        facing = (ahead * normals[own]).sum(1) / np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)
        gum[own] = np.maximum(facing, 0.0)
    clear = np.flatnonzero(np.linalg.norm(normals, axis=1) > 0)
    return Outlines(points, arch, pixels, normals, gum).take(clear)


def _ends(depth: NDArray[np.float32], labels: NDArray[np.uint8]) -> tuple[Array, Array, Array, Array]:
    """Return where teeth end along pixel rows: column and row of the boundary, and of the tooth pixel beside it."""
    rows, columns = np.nonzero(labels[:, 1:] != labels[:, :-1])
    right_is_near = depth[rows, columns + 1] > depth[rows, columns]
    # If gum, which has number 0, is in front, the outline belongs to the tooth behind it.
    right_is_near = np.where(labels[rows, columns] == 0, True, right_is_near & (labels[rows, columns + 1] > 0))
    row = rows.astype(np.float64)
    return np.asarray(columns + 0.5, np.float64), row, (columns + right_is_near).astype(np.float64), row


def _outward(tooth: NDArray[np.bool_], rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Array:
    """Return unit vectors (x, y) that point out of a tooth mask (h, w) at pixels, shape (N, 2); 0 where ambiguous."""
    reach = int(4 * _SMOOTH_PX)
    top, left = max(0, rows.min() - reach), max(0, columns.min() - reach)
    part = tooth[top : rows.max() + reach + 1, left : columns.max() + reach + 1].astype(np.float32)
    soft = gaussian_filter(part, _SMOOTH_PX, mode="nearest")
    dy, dx = np.gradient(soft)
    out = -np.column_stack([dx[rows - top, columns - left], dy[rows - top, columns - left]]).astype(float)
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.where(length > 1e-3, out / np.maximum(length, 1e-9), 0.0)
