"""Crowns split into teeth: renderings of the teeth, and the outlines that are visible in a photograph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jawusd.base.arrays import Array
from jawusd.geometry import transform_points
from jawusd.meshes.raster import draw_depth_labels, project
from jawusd.tracking.contour.scan import Faces, Scan

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
    """Points on the visible outlines of all teeth in one image.

    Attributes:
        points: points on the crowns, scan coordinates of their own arch [mm], shape (N, 3).
        arch: 0 upper, 1 lower, shape (N,).
        tooth: tooth number from 1, continuing from the upper to the lower arch, shape (N,); connected teeth share a
            number.
        pixels: image positions [px], shape (N, 2).
        normals: unit normals pointing out of the tooth in the image, shape (N, 2).
        gum: 1 where the outline faces the gum of its arch, decreasing to 0 at a right angle [-], shape (N,).
    """

    points: Array
    arch: NDArray[np.int64]
    tooth: NDArray[np.int64]
    pixels: Array
    normals: Array
    gum: Array

    def take(self, index: NDArray[np.int64]) -> Outlines:
        """Return the points at given indices, which may repeat."""
        return Outlines(
            self.points[index],
            self.arch[index],
            self.tooth[index],
            self.pixels[index],
            self.normals[index],
            self.gum[index],
        )


def split_teeth(scan: Scan, T_anatomical_scan: Array, arch: int) -> Crowns:
    """Return the crowns of a scan as connected pieces, with a substitute gum surface if the scan has no gum.

    This surface occludes teeth on the far side of the arch in renderings, as gum does in photographs.

    Args:
        scan: one arch.
        T_anatomical_scan: scan to (left, up, front) axes, shape (4, 4).
        arch: 0 upper, 1 lower.
    """
    faces = scan.crown_faces
    pairs = (faces.ravel(), np.roll(faces, 1, axis=1).ravel())
    links = coo_array((np.ones(faces.size), pairs), [len(scan.vertices)] * 2)
    piece = connected_components(links, directed=False)[1][faces[:, 0]]
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

    Args:
        crowns, matrices: upper and lower crowns, with the projections from scan [mm] to homogeneous px, shape (3, 4).
        shape: height and width of the image [px].
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
    clear = np.linalg.norm(normals, axis=1) > 0
    return Outlines(points[clear], arch[clear], tooth[clear], pixels[clear], normals[clear], gum[clear])


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
