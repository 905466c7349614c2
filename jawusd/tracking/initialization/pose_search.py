"""Brute-force search for the pose of one arch: orientations one by one, all translations at once.

For one orientation, a small translation mostly shifts the image of the arch. The fit to the mask as a function of that
shift is a correlation, which the fast Fourier transform computes for all shifts together. The objective of a
translation is the sum of the correlations of all cameras.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from jawusd.base.arrays import Array, Mask
from jawusd.formats.mesh import Mesh
from jawusd.geometry import make_transform, so3_exp, transform_point, transform_points
from jawusd.meshes.raster import unpack_bits
from jawusd.tracking.config import Mapper
from jawusd.tracking.contour.scan import CROWN, Scan, prepare_scan
from jawusd.tracking.contour.views import View

_CELL_MM = 1.2  # size of the cells in which vertices are merged [mm]
_BLUR_MM = 0.9  # blur of the outlines [mm], which keeps the coarse grid from missing the optimum
_UNCOVERED_PRICE = 1.0  # penalty per mm^2 of uncovered mask, in mm of matched outline [1/mm]


@dataclass(frozen=True)
class Grid:
    """A grid of poses around a guess."""

    yaw_rad: Array  # rotations about the up, left and front axes of the arch
    pitch_rad: Array
    roll_rad: Array
    reach_mm: tuple[float, float, float]  # maximum translation along the left, up and front axes, in both directions
    step_mm: float = 1.5  # spacing of the translations

    def turns(self) -> Iterator[Array]:
        """Yield the rotations in batches (N, 3, 3): all roll angles of one yaw and pitch."""
        rolls = so3_exp(self.roll_rad[:, None] * [0.0, 0.0, 1.0])
        for yaw in self.yaw_rad:
            for pitch in self.pitch_rad:
                yield so3_exp([0, yaw, 0]) @ so3_exp([pitch, 0, 0]) @ rolls

    def shifts(self) -> Array:
        """Return the translations to the left, up and forward [mm], shape (N, 3)."""
        axes = [np.arange(-r, r + self.step_mm / 2, self.step_mm) for r in self.reach_mm]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A promising pose: its objective [px] and T_world_arch, shape (4, 4)."""

    objective: float
    pose: Array


def coarse_scan(mesh: Mesh, name: str) -> Scan:
    """Return a teeth scan decimated for the search, with crowns and gum still separate."""
    cells = np.floor(mesh.vertices / _CELL_MM).astype(np.int64)
    _, chosen, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[mesh.faces]
    solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = np.unique(faces[solid], axis=0)
    colors = None if mesh.colors is None else mesh.colors[chosen]
    return prepare_scan(Mesh(mesh.vertices[chosen], faces.astype(np.int32), colors), name)


class ShiftCorrelation:
    """Correlates the rendered arch with its mask in one image, for all shifts at once."""

    def __init__(self, view: View, arch: int, px_per_mm: float, shifts: Array, at: Array) -> None:
        """Prepare the correlation for world translations `shifts` (N, 3) of a world point `at` (3,) [mm]."""
        # Shifts are rounded to whole pixels, since blurred outlines are insensitive to fractions of a pixel.
        pixels = np.rint(shifts @ _slope(view.matrix, at).T).astype(np.int64)
        picture = _template(view.masks[arch], view.masks[1 - arch], px_per_mm)
        some = np.abs(picture) > 1e-3
        y, x = np.flatnonzero(some.any(1)), np.flatnonzero(some.any(0))
        picture = picture[y[0] : y[-1] + 1, x[0] : x[-1] + 1]
        # Padding by the maximum shift prevents circular wrap-around onto the template.
        right, down = np.abs(pixels).max(0)
        picture = np.pad(picture, ((down, down), (right, right))).astype(np.float32)
        self._shape = picture.shape
        self._full = tuple(fft.next_fast_len(n, real=True) for n in picture.shape)
        self._template = fft.rfft2(picture, self._full)
        self._matrix = np.array([[1, 0, right - x[0]], [0, 1, down - y[0]], [0, 0, 1.0]]) @ view.matrix
        columns, rows = (pixels % self._full[::-1]).T
        self._places = rows * self._full[1] + columns

    def objectives(self, scan: Scan, poses: Array) -> NDArray[np.float32]:
        """Return the objectives of poses (P, 4, 4) under all shifts [px], shape (P, N)."""
        drawn = np.zeros((len(poses), *self._full), np.float32)
        for pose, picture in zip(poses, drawn, strict=True):
            depth, labels = np.zeros(self._shape, np.float32), np.zeros(self._shape, np.uint8)
            scan.draw(self._matrix @ pose, depth, labels)
            picture[: self._shape[0], : self._shape[1]] = labels == CROWN
        product = fft.rfft2(drawn, overwrite_x=True)
        np.conj(product, out=product)
        product *= self._template
        found = fft.irfft2(product, self._full, overwrite_x=True)
        return found.reshape(len(poses), -1)[:, self._places]


def search_arch(
    scan: Scan,
    arch: int,
    views: Sequence[View],
    px_per_mm: float,
    base: Array,
    hinge: Array,
    grid: Grid,
    map_: Mapper = map,
) -> list[Candidate]:
    """Return the best translation of every orientation of a grid, the best orientations first.

    Args:
        scan: coarse scan of the arch; views without a mask of it are ignored.
        px_per_mm: resolution of the views at the teeth.
        base: guessed T_world_axes of (left, up, front) axes with origin at the centre of rotation, shape (4, 4).
        hinge: T_axes_scan, from the scan frame to the same axes, shape (4, 4).
        map_: distributes the orientations among threads.
    """
    shifts = grid.shifts() @ base[:3, :3].T
    correlations = [
        ShiftCorrelation(view, arch, px_per_mm, shifts, base[:3, 3]) for view in views if view.present[arch]
    ]

    def best_translations(turns: Array) -> list[Candidate]:
        poses = base @ make_transform(turns, np.zeros(3)) @ hinge
        objectives = np.sum([correlation.objectives(scan, poses) for correlation in correlations], axis=0)
        best = objectives.argmax(axis=1)
        poses[:, :3, 3] += shifts[best]
        return [Candidate(float(row[k]), pose) for row, k, pose in zip(objectives, best, poses, strict=True)]

    found = [candidate for some in map_(best_translations, grid.turns()) for candidate in some]
    return sorted(found, key=lambda c: -c.objective)


def distinct(found: Sequence[Candidate], probes: Array, least_mm: float, most: int) -> list[Candidate]:
    """Return the first `most` candidates with mean distances between their probes (N, 3) above `least_mm`."""
    kept: list[Candidate] = []
    places = np.empty((most, len(probes), 3))
    for candidate in found:
        here = transform_points(candidate.pose, probes)
        if (np.linalg.norm(places[: len(kept)] - here, axis=-1).mean(1) > least_mm).all():
            places[len(kept)] = here
            kept.append(candidate)
            if len(kept) == most:
                break
    return kept


def _template(mask: NDArray[np.uint8], other: NDArray[np.uint8], px_per_mm: float) -> Array:
    """Return the image whose correlation with rendered crowns is their objective, up to a constant [px].

    The objective is the length of the outline that coincides with the mask's outline, minus a penalty for uncovered
    mask pixels. The length is the correlation of the blurred gradients of both images, normalised to 1 per pixel of a
    straight edge. Moving both derivatives to the mask turns it into -div(w grad m), with w = 0 where the outline is
    that of the other arch.
    """
    sigma = _BLUR_MM * px_per_mm * np.sqrt(2)  # combined blur of both outlines [px]
    inside = mask / 255.0
    own = 1.0 - ndimage.binary_dilation(other > 127, iterations=max(1, round(px_per_mm)))
    smooth = ndimage.gaussian_filter(inside, sigma)
    dy, dx = np.gradient(smooth)
    edges = -(np.gradient(own * dy, axis=0) + np.gradient(own * dx, axis=1)) * sigma * np.sqrt(2 * np.pi)
    return edges + _UNCOVERED_PRICE / px_per_mm * inside


def _slope(matrix: Array, point: Array) -> Array:
    """Return the derivative of the projected pixel with respect to the world point, shape (2, 3)."""
    h = matrix @ np.append(point, 1.0)
    return (matrix[:2, :3] - (h[:2] / h[2])[:, None] * matrix[2, :3]) / h[2]


def hinge_at_front(crowns: Array, T_anatomical_scan: Array) -> Array:
    """Return the transform from the scan frame to anatomical axes at the centre of the front teeth, shape (4, 4).

    `crowns` are crown vertices in the scan frame [mm], shape (N, 3); `T_anatomical_scan` has shape (4, 4).
    """
    points = transform_points(T_anatomical_scan, crowns)
    # front teeth up to the first premolars, which are usually visible
    front = points[points[:, 2] > points[:, 2].max() - 15.0]
    return make_transform(np.eye(3), -front.mean(0)) @ T_anatomical_scan


def shift_to_masks(scan: Scan, pose: Array, arch: int, views: Sequence[View], use: Mask) -> Array:
    """Return the translation (3,) perpendicular to the line of sight that aligns the centres of crowns and masks [mm].

    It moves teeth that were out of view close to their masks. Depth is not changed: lips hide different teeth in every
    view, so an estimate would be off by a centimetre or two. `pose` is T_world_scan, `use` the masks to use, shape (2,
    C). Without masks, the translation is zero.
    """
    centre = np.append(transform_point(pose, scan.centre), 1.0)
    H, g, sight = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for view in (view for view, used in zip(views, use[arch], strict=True) if used):
        height, width = view.masks.shape[1:]
        # The rendered area is three times the image size, since the teeth may be outside the image.
        bits = scan.silhouette(view.matrix @ view.T_delay[arch] @ pose, (3 * height, 3 * width), -width, -height)
        crowns, mask = unpack_bits(bits, 3 * width), view.masks[arch] > 127
        depth = view.matrix[2] @ centre
        if depth <= 0 or not crowns.any() or not mask.any():
            continue
        pixel = view.matrix[:2] @ centre / depth
        slope = (view.matrix[:2, :3] - pixel[:, None] * view.matrix[2, :3]) / depth
        miss = _middle(mask) - (_middle(crowns) - [width, height])
        H += slope.T @ slope
        g += slope.T @ miss
        sight += (centre[:3] - view.eye) / np.linalg.norm(centre[:3] - view.eye)
    if not sight.any():
        return np.zeros(3)
    across = np.linalg.svd(sight[None])[2][1:]  # two directions perpendicular to the mean line of sight
    return across.T @ np.linalg.solve(across @ H @ across.T, across @ g)


def _middle(picture: Mask) -> Array:
    """Return the mean position (x, y) of the set pixels, shape (2,)."""
    rows, columns = np.nonzero(picture)
    return np.array([columns.mean(), rows.mean()])
