"""The sampled decoder: a table of twists for readers that do not know the exact model, and its error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import RigError
from jawusd.evaluator import JawRig
from jawusd.evaluator.schema import ADDITIVE
from jawusd.evaluator.table import SampledTable
from jawusd.geometry.se3 import se3_exp, transform_points
from jawusd.rig.sampling import grid_axes, grid_points, sample_valid, valid_box

DEFAULT_SIZE = 33
SIZES = (17, 33, 65)
_VALID_SAMPLES = 10_000
_FULL_CHECKS = 200


@dataclass(frozen=True, eq=False)
class DecoderTable:
    """Twists sampled over d.

    Attributes:
        format: "grid" (twists over the three axes) or "curves" (three curves, to be added).
        axes: Values of d1, d2, d3 [mm], each array increasing.
        twists: Twists (omega [rad], v [mm]) in the skull frame, float32: (n1, n2, n3, 6), or (n1 + n2 + n3, 6).
        max_error_mm: Largest distance to the exact model found at any vertex.
        error_samples: Number of valid d at which it was measured.
    """

    format: str
    axes: tuple[Array, Array, Array]
    twists: NDArray[np.float32]
    max_error_mm: float = 0.0
    error_samples: int = 0

    def __post_init__(self) -> None:
        counts = tuple(len(axis) for axis in self.axes)
        wanted = (*counts, 6) if self.format == "grid" else (sum(counts), 6)
        if self.twists.shape != wanted:
            raise ValueError(f"twists of a {self.format} {counts} must have shape {wanted}, got {self.twists.shape}")

    def twist(self, d: ArrayLike) -> Array:
        """Return interpolated twists, shape (n, 6), at d (n, 3) [mm], d clamped to the knots."""
        d = np.asarray(d, dtype=np.float64)
        if self.format == "curves":
            parts = np.split(self.twists.astype(np.float64), np.cumsum([len(axis) for axis in self.axes])[:2])
            curves = zip(parts, self.axes, d.T, strict=True)
            columns = [[np.interp(x, axis, column) for column in part.T] for part, axis, x in curves]
            return np.sum(columns, axis=0).T
        return SampledTable(self.axes, self.twists, np.eye(4)).twist(d)

    def pose(self, d: ArrayLike, T_rest: Array) -> Array:
        """Return poses T_skull_mandible, shape (n, 4, 4), at d (n, 3) [mm]: exp(twist) times the rest pose."""
        return se3_exp(self.twist(d)) @ T_rest


def build_table(rig: JawRig, vertices: Array, size: int = DEFAULT_SIZE) -> DecoderTable:
    """Sample a rig and measure the table's error.

    Args:
        vertices: Mandible vertices (V, 3), mandible frame [mm], at which the error is measured.
        size: Values per axis, 17, 33 or 65.

    Returns:
        A grid, or three curves for an additive model, whose sum is exact between the axes.

    Raises:
        RigError: The size is not offered, or the bounds leave nothing valid.
    """
    if size not in SIZES:
        raise RigError(f"a table of {size} knots per axis is not offered; allowed are {', '.join(map(str, SIZES))}.")
    axes = grid_axes(rig, valid_box(rig), vertices[extreme_vertices(vertices)], size)
    if rig.kind == ADDITIVE:
        twists = np.concatenate([rig.twist(np.outer(axis, np.eye(3)[i])) for i, axis in enumerate(axes)])
        table = DecoderTable("curves", axes, twists.astype(np.float32))
    else:
        twists = _between(rig, axes)
        table = DecoderTable("grid", axes, twists.astype(np.float32))
    # the error of linear interpolation peaks in the middle of the cells
    middles = grid_points([0.5 * (axis[1:] + axis[:-1]) for axis in axes])
    samples = np.concatenate([middles[rig.margin(middles) >= 0], sample_valid(rig, _VALID_SAMPLES)])
    error = table_error(rig, table, vertices, samples)
    return DecoderTable(table.format, table.axes, table.twists, error, len(samples))


def _between(rig: JawRig, axes: tuple[Array, Array, Array]) -> Array:
    """Return twists at the knots, shape (n1, n2, n3, 6), from which linear interpolation errs to both sides alike.

    Interpolated exact values err to one side, most in the middle of the cells; half of what they err there, as the mean
    of both cells along each axis, is taken off at the knots. The closed bite stays exact.
    """
    exact = rig.twist(grid_points(axes)).reshape(*map(len, axes), 6)
    out = exact.copy()
    for i, axis in enumerate(axes):
        middles = [0.5 * (axis[1:] + axis[:-1]) if k == i else other for k, other in enumerate(axes)]
        found = np.moveaxis(rig.twist(grid_points(middles)).reshape(*map(len, middles), 6), i, 0)
        knots, taken = np.moveaxis(exact, i, 0), np.moveaxis(out, i, 0)
        error = np.concatenate([[np.zeros_like(knots[0])], found - 0.5 * (knots[1:] + knots[:-1])])
        error[0] = error[1]  # cells at the ends have one neighbour
        after = np.concatenate([error[1:], error[-1:]])
        taken += 0.25 * (error + after)
    closed = tuple(int(np.searchsorted(axis, 0.0)) for axis in axes)
    out[closed] = exact[closed]
    return out


def table_error(rig: JawRig, table: DecoderTable, vertices: Array, d: Array) -> float:
    """Return the largest distance [mm] between table and model at any vertex (V, 3), over parameters d (n, 3).

    The distance is a convex function of the vertex, so vertices that are extreme in some direction find the worst
    parameters; those are then checked at every vertex.
    """
    exact = rig.pose(d)
    read = table.pose(d, rig.T_rest)
    rough = largest_distance(exact, read, vertices[extreme_vertices(vertices)])
    worst = np.argsort(rough)[-_FULL_CHECKS:]
    return float(largest_distance(exact[worst], read[worst], vertices).max())


def landmark_distance(rig: JawRig, T_a: Array, T_b: Array) -> Array:
    """Return the largest distance [mm] of a landmark between two sets of poses (n, 4, 4), shape (n,)."""
    return np.linalg.norm(transform_points(T_a - T_b, rig.landmarks), axis=-1).max(axis=-1)


def largest_distance(T_a: Array, T_b: Array, points: Array) -> Array:
    """Return the largest distance [mm], shape (n,), of points (V, 3) under two sets of poses (n, 4, 4).

    |(T_a - T_b) p|^2 is a quadratic form in (p, 1): ten numbers per pose and per point, one matrix product.
    """
    D = (T_a - T_b)[:, :3, :]
    Q = np.swapaxes(D, 1, 2) @ D
    rows, columns = np.triu_indices(4)
    form = Q[:, rows, columns] * np.where(rows == columns, 1.0, 2.0)
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    monomials = (homogeneous[:, rows] * homogeneous[:, columns]).T
    chunk = max(1, 4_000_000 // len(points))
    squares = [(form[i : i + chunk] @ monomials).max(axis=1) for i in range(0, len(form), chunk)]
    return np.sqrt(np.maximum(np.concatenate(squares), 0.0))


def extreme_vertices(vertices: Array) -> NDArray[np.int64]:
    """Return the indices of vertices (V, 3) that lie farthest in one of about 400 directions."""
    i = np.arange(400) + 0.5
    height, turn = 1 - 2 * i / len(i), np.pi * (1 + 5**0.5) * i  # Fibonacci sphere
    radius = np.sqrt(1 - height**2)
    directions = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    return np.unique(np.argmax(directions @ vertices.T, axis=1))
