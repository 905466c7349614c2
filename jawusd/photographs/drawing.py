"""Lines drawn by hand along the teeth in a photograph, represented by points with directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label, sum_labels
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError

_WIDTH_PX = 1.8  # standard deviation of the Gaussian blur, with which lines a few pixels wide form a single ridge
_FAINT = 0.12  # minimum ridge strength relative to that of the strongest ridges
_SHORTEST_PX = 60  # minimum length of isolated strokes; shorter strokes are ignored
_FEWEST_POINTS = 300


@dataclass(frozen=True, eq=False)
class Drawing:
    """The lines drawn in one photograph.

    Attributes:
        name: name of the photograph, for messages.
        pixels: points on the lines [px], about one pixel apart, shape (N, 2).
        normals: unit vectors across the lines, of arbitrary sign, shape (N, 2).
        size_px: width and height of the image.
    """

    name: str
    pixels: Array
    normals: Array
    size_px: tuple[int, int]

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


def nearest(these: Array, others: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return, for each feature in `these`, the distance and index of the nearest feature in `others`."""
    distance, index = cKDTree(others).query(these)
    return distance, index
