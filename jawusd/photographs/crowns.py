"""Crowns tooth by tooth: their pictures, and the outlines that a photograph would show of them."""

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

_FEWEST_FACES = 50  # pieces with fewer faces are crumbs of the scan
_MOST_TEETH = 120  # per arch: labels of both arches are bytes
# The wall in place of gum: parts along the row, where on the height of the crowns it begins [-], how high it is [mm].
_WALL_PARTS, _WALL_FROM, _WALL_MM = 24, 0.75, 15.0
_SMOOTH_PX = 2.0  # over which the direction of an outline is averaged


@dataclass(frozen=True, eq=False)
class Crowns:
    """Hold one arch as separate pieces: teeth where the scan has them apart, else the whole row."""

    scan: Scan
    teeth: tuple[Faces, ...]  # crown faces of every piece, each of shape (F, 3)
    to_gum: Array  # unit vector from the crowns to their gum, scan coordinates, shape (3,)


@dataclass(frozen=True, eq=False)
class Outlines:
    """Hold points on the visible outlines of all teeth in one picture.

    Attributes:
        points: on the crowns, scan coordinates of their own arch [mm], shape (N, 3).
        arch: 0 upper, 1 lower, shape (N,).
        tooth: number of the piece, counted through both arches from 1, shape (N,).
        pixels: where they are in the picture [px], shape (N, 2).
        normals: unit vectors out of the tooth in the picture, shape (N, 2).
        gum: 1 where the outline faces its gum, 0 from a right angle on [-], shape (N,).
    """

    points: Array
    arch: NDArray[np.int64]
    tooth: NDArray[np.int64]
    pixels: Array
    normals: Array
    gum: Array

    def take(self, index: NDArray[np.int64]) -> Outlines:
        """Return some of the points, which may repeat."""
        return Outlines(
            self.points[index],
            self.arch[index],
            self.tooth[index],
            self.pixels[index],
            self.normals[index],
            self.gum[index],
        )


def split_teeth(scan: Scan, T_anatomical_scan: Array, arch: int) -> Crowns:
    """Return the crowns of a scan as connected pieces, with a wall in place of gum where the scan has none.

    Without it, teeth of the far side would be seen where gum hides them.

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
    """Return the scan with a wall of gum that stands on the middle of its row of teeth."""
    points = scan.crown_vertices()
    flat = transform_points(T_anatomical_scan, points)
    # Seen from amid the arch, teeth follow one another by angle.
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
    """Return inverse depth [1/mm] and the number of the tooth seen (0: none) at every pixel, shape (h, w) each.

    Args:
        crowns, matrices: upper and lower, with their projections from scan [mm] to homogeneous px, shape (3, 4).
        shape: height and width of the picture [px].
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
    """Return where teeth end in a picture drawn by `draw_teeth`: between pixels, on the tooth that is in front."""
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
    """Return where teeth end along rows: column and row of the end, column and row of the pixel on the tooth."""
    rows, columns = np.nonzero(labels[:, 1:] != labels[:, :-1])
    right_is_near = depth[rows, columns + 1] > depth[rows, columns]
    # Gum in front has number 0: what ends there is the tooth behind it.
    right_is_near = np.where(labels[rows, columns] == 0, True, right_is_near & (labels[rows, columns + 1] > 0))
    row = rows.astype(np.float64)
    return np.asarray(columns + 0.5, np.float64), row, (columns + right_is_near).astype(np.float64), row


def _outward(tooth: NDArray[np.bool_], rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Array:
    """Return unit vectors out of a tooth (h, w) at pixels, (x, y), shape (N, 2); 0 where none is clear."""
    reach = int(4 * _SMOOTH_PX)
    top, left = max(0, rows.min() - reach), max(0, columns.min() - reach)
    part = tooth[top : rows.max() + reach + 1, left : columns.max() + reach + 1].astype(np.float32)
    soft = gaussian_filter(part, _SMOOTH_PX, mode="nearest")
    dy, dx = np.gradient(soft)
    out = -np.column_stack([dx[rows - top, columns - left], dy[rows - top, columns - left]]).astype(float)
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.where(length > 1e-3, out / np.maximum(length, 1e-9), 0.0)
