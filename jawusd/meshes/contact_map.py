"""What articulating paper would show: both arches from their biting sides, coloured by how near the other teeth are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.formats.contact import DEEP, TOUCHING
from jawusd.geometry.se3 import se3_inverse, transform_points
from jawusd.meshes.collision import Solid, distances
from jawusd.meshes.contact import Teeth

Picture = NDArray[np.uint8]

_ENAMEL, _PAPER = np.array([236.0, 229.0, 212.0]), 255
_LIGHT = np.array([0.3, 0.87, -0.4])
_FLOOR_MM = 11.0  # below the tips, what is seen is gum or nothing


@dataclass(frozen=True, eq=False)
class _Arch:
    """The biting side of an arch as a height map.

    Attributes:
        points: Surface points, frame of the solid [mm], shape (n, 3).
        pixels: Their rows and columns in the picture, shape (n, 2).
        shade: Brightness, shape (n,).
        size: Rows and columns of the picture.
    """

    points: Array
    pixels: NDArray[np.int64]
    shade: Array
    size: tuple[int, int]


class ContactMap:
    """Draw the marks of any pose on the teeth of one person."""

    def __init__(self, teeth: Teeth) -> None:
        """Look at both arches."""
        self._teeth = teeth
        self._arches = _arch(teeth.pair.upper, 1.0), _arch(teeth.pair.lower, -1.0)

    def draw(self, T_skull_mandible: Array) -> Picture:
        """Return the upper arch beside the lower one, fronts up, the subject's left on the right, RGB (h, w, 3)."""
        A, pair = self._teeth.T_anatomical_skull, self._teeth.pair
        T = A @ T_skull_mandible @ se3_inverse(A @ self._teeth.T_rest)
        upper, lower = self._arches
        sides = (
            self._picture(upper, distances(pair.lower.grid, transform_points(se3_inverse(T), upper.points))),
            self._picture(lower, distances(pair.upper.grid, transform_points(T, lower.points))),
        )
        height = max(len(side) for side in sides)
        padded = [np.pad(s, ((0, height - len(s)), (4, 4), (0, 0)), constant_values=_PAPER) for s in sides]
        return np.concatenate(padded, axis=1).repeat(2, axis=0).repeat(2, axis=1)

    def _picture(self, arch: _Arch, apart: Array) -> Picture:
        colors = arch.shade[:, None] * _ENAMEL
        closed = max(self._teeth.closed_mm, 0.0)
        apart = apart + min(self._teeth.closed_mm, 0.0)  # scans that leave a gap in the closed bite touch there
        for mark in reversed(TOUCHING):
            colors[apart < mark.apart_mm] = mark.color
        colors[apart < DEEP.apart_mm - closed] = DEEP.color
        out = np.full((*arch.size, 3), _PAPER, np.uint8)
        out[arch.pixels[:, 0], arch.pixels[:, 1]] = np.clip(colors, 0, 255).astype(np.uint8)
        return out


def _arch(solid: Solid, up: float) -> _Arch:
    """Return where vertical lines from the other jaw first meet a solid."""
    grid = solid.grid
    values = grid.values if up > 0 else grid.values[:, ::-1]
    inside = values < 0
    layer = inside.argmax(axis=1)
    i, k = np.nonzero(inside.any(axis=1) & (layer > 0))
    j = layer[i, k]
    before, after = values[i, j - 1, k].astype(float), values[i, j, k].astype(float)
    place = j - after / (after - before)  # of the surface, in layers
    row = place if up > 0 else values.shape[1] - 1 - place
    height = np.full(values.shape[::2], np.nan)
    height[i, k] = place * grid.step_mm
    near = height[i, k] < np.nanmin(height) + _FLOOR_MM
    points = grid.origin + grid.step_mm * np.stack([i, row, k], axis=1)
    pixels = np.stack([values.shape[2] - 1 - k, i], axis=1)
    return _Arch(
        points[near], pixels[near], _shade(height, grid.step_mm)[i, k][near], (values.shape[2], values.shape[0])
    )


def _shade(height: Array, step_mm: float) -> Array:
    """Return the brightness of a height map (nx, nz) [mm], shape (nx, nz), lit from behind."""
    known: Mask = np.isfinite(height)
    filled = np.where(known, height, np.nanmax(height))
    x, z = np.gradient(filled, step_mm)
    normal = np.stack([x, np.ones_like(x), z], axis=-1) / np.sqrt(1.0 + x**2 + z**2)[..., None]
    return np.asarray(0.3 + 0.75 * np.clip(normal @ _LIGHT, 0.0, 1.0))
