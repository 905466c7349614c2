"""The sampled decoder (a table of twists for readers without the exact model), its error, and random samples of d.

The error of linear interpolation over a step h is h^2 / 8 times the second derivative. A grid whose density is
proportional to the square root of the curvature therefore spreads the error evenly (de Boor, A Practical Guide to
Splines, chapter XII).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import RigError
from jawusd.evaluator import JawRig
from jawusd.evaluator.batching import usable_rows
from jawusd.evaluator.kinds import ADDITIVE
from jawusd.geometry.se3 import se3_exp, transform_points

DEFAULT_SIZE = 33  # default number of knots per axis
SIZES = (17, 33, 65)
_VALID_SAMPLES = 10_000  # number of random valid d at which the error is measured
_FULL_CHECKS = 200  # number of d with the largest errors, which are checked at every vertex

_PROBES_PER_AXIS = 41  # number of values per axis of the grid that finds the box of valid d
_FINE = 161  # number of values per axis at which the curvature is measured
_COARSE = 13  # number of values along each of the two other axes
_NEAR_BOUND_MM = -0.5  # minimum margin of points whose curvature counts; negative, as cells extend beyond the bound
_SMOOTHING = 9  # width of the window that smooths the curvature, in steps of the fine grid
_FLOOR = 0.05  # lower limit of the curvature, as a fraction of its maximum
_POINTS = 40  # number of mandible points at which the curvature is measured


def valid_box(rig: JawRig) -> Array:
    """Return the box (3, 2) [mm] of the table: `d_range`, widened to all valid d; raises RigError if none is valid."""
    box = np.array(rig.d_range, dtype=np.float64)
    reach = 1.0 + rig.bound.offset_mm + rig.bound.softness_mm
    wide = box + np.array([-reach, reach])
    axes = [np.linspace(low, high, _PROBES_PER_AXIS) for low, high in wide]
    probes = grid_points(axes)
    valid = probes[rig.margin(probes) >= 0]
    if not len(valid):
        raise RigError("no parameters lie inside the bound of the model.")
    step = np.array([axis[1] - axis[0] for axis in axes])
    low, high = valid.min(axis=0) - step, valid.max(axis=0) + step
    return np.stack([np.minimum(box[:, 0], low), np.maximum(box[:, 1], high)], axis=1).clip(wide[:, :1], wide[:, 1:])


def grid_points(axes: Sequence[Array] | Array) -> Array:
    """Return the points (n1 * n2 * n3, 3) of a grid with these axis values."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def sample_valid(rig: JawRig, count: int, seed: int = 0) -> Array:
    """Return `count` random valid d, shape (count, 3) [mm], uniform over the volume inside the bound."""
    rng = np.random.default_rng(seed)
    box = valid_box(rig)
    found: list[Array] = []
    missing = count
    while missing > 0:
        d = rng.uniform(box[:, 0], box[:, 1], (4 * count, 3))
        d = d[rig.margin(d) >= 0][:missing]
        found.append(d)
        missing -= len(d)
    return np.concatenate(found)


def grid_axes(rig: JawRig, box: Array, points: Array, size: int) -> tuple[Array, Array, Array]:
    """Return values (size,) [mm] of d1, d2 and d3 over a box (3, 2) that minimise the error of linear interpolation.

    They contain 0, so that the closed bite is exact. The error counts at mandible points (V, 3) [mm], mandible frame.
    """
    points = points[:: max(1, len(points) // _POINTS)]
    return _axis(rig, box, points, 0, size), _axis(rig, box, points, 1, size), _axis(rig, box, points, 2, size)


def _axis(rig: JawRig, box: Array, points: Array, axis: int, size: int) -> Array:
    fine = np.linspace(box[axis, 0], box[axis, 1], _FINE)
    bend = np.convolve(
        np.pad(_curvature(rig, box, points, axis), _SMOOTHING // 2, mode="edge"),
        np.hanning(_SMOOTHING) / np.hanning(_SMOOTHING).sum(),
        mode="valid",
    )
    density = np.sqrt(bend + _FLOOR * bend.max() + np.finfo(float).tiny)
    share = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    rest = np.interp(0.0, fine, share)
    below = int(np.clip(round((size - 1) * rest / share[-1]), 1, size - 2))
    even = np.concatenate([np.linspace(0.0, rest, below + 1), np.linspace(rest, share[-1], size - below)[1:]])
    values = np.interp(even, share, fine)
    values[below] = 0.0
    return values


def _curvature(rig: JawRig, box: Array, points: Array, axis: int) -> Array:
    """Return the largest second difference of any point along one axis of d, shape (_FINE,) [1/mm]."""
    axes = [np.linspace(low, high, _FINE if i == axis else _COARSE) for i, (low, high) in enumerate(box)]
    d = np.moveaxis(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), axis, 0)
    near = rig.margin(d) >= _NEAR_BOUND_MM
    bend = np.zeros(_FINE)
    step = axes[axis][1] - axes[axis][0]
    for j in range(d.shape[1]):
        moved = transform_points(rig.pose(d[:, j]), points)
        second = np.linalg.norm(moved[2:] - 2 * moved[1:-1] + moved[:-2], axis=-1).max(-1) / step**2
        bend[1:-1] = np.maximum(bend[1:-1], np.where(near[1:-1, j], second, 0.0).max(-1))
    bend[[0, -1]] = bend[[1, -2]]
    return bend


@dataclass(frozen=True, eq=False)
class DecoderTable:
    """Twists sampled over d; ValueError is raised if shapes do not match or values do not increase."""

    format: str  # "grid" (twists over the three axes) or "curves" (three curves that are summed)
    axes: tuple[Array, Array, Array]  # values of d1, d2, d3 [mm], each array increasing
    #: twists (omega [rad], v [mm]) in the skull frame, float32: (n1, n2, n3, 6), or (n1 + n2 + n3, 6)
    twists: NDArray[np.float32]
    max_error_mm: float = 0.0  # largest distance of a vertex from the exact model
    error_samples: int = 0  # number of valid d at which `max_error_mm` was measured

    def __post_init__(self) -> None:
        counts = tuple(len(axis) for axis in self.axes)
        wanted = (*counts, 6) if self.format == "grid" else (sum(counts), 6)
        if self.twists.shape != wanted:
            raise ValueError(f"twists of a {self.format} {counts} must have shape {wanted}, got {self.twists.shape}")
        if any(len(axis) < 2 or (np.diff(axis) <= 0).any() for axis in self.axes):
            raise ValueError("the axes must be three increasing arrays of at least two values")

    def twist(self, d: ArrayLike) -> Array:
        """Return interpolated twists, shape (n, 6), at d (n, 3) [mm] clamped to the range of the knots."""
        d = np.asarray(d, dtype=np.float64)
        if self.format == "curves":
            parts = np.split(self.twists.astype(np.float64), np.cumsum([len(axis) for axis in self.axes])[:2])
            curves = zip(parts, self.axes, d.T, strict=True)
            columns = [[np.interp(x, axis, column) for column in part.T] for part, axis, x in curves]
            return np.sum(columns, axis=0).T
        d = usable_rows(d)
        (i, a), (j, b), (k, c) = (_located(axis, column) for axis, column in zip(self.axes, d.T, strict=True))
        near, far = (
            (1 - a) * (1 - b) * self.twists[i, j, last]
            + (1 - a) * b * self.twists[i, j + 1, last]
            + a * (1 - b) * self.twists[i + 1, j, last]
            + a * b * self.twists[i + 1, j + 1, last]
            for last in (k, k + 1)
        )
        return np.asarray(near + c * (far - near))

    def pose(self, d: ArrayLike, T_rest: Array) -> Array:
        """Return poses T_skull_mandible, shape (n, 4, 4), at d (n, 3) [mm]: exp(twist) times the rest pose."""
        return se3_exp(self.twist(d)) @ T_rest


def _located(axis: Array, x: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the cell (n,) of each x (n,) clamped to an axis, and the fraction of the way through it (n, 1)."""
    cell = np.clip(axis.searchsorted(x, side="right") - 1, 0, len(axis) - 2)
    return cell, np.clip((x - axis[cell]) / (axis[cell + 1] - axis[cell]), 0.0, 1.0)[:, None]


def build_table(rig: JawRig, vertices: Array, size: int = DEFAULT_SIZE) -> DecoderTable:
    """Sample a rig with 17, 33 or 65 values per axis, and measure the error at vertices (V, 3) [mm], mandible frame.

    The table is a grid, or three curves for an additive model, which has no cross terms.

    Raises:
        RigError: An unsupported size, or bounds that allow no parameters.
    """
    if size not in SIZES:
        raise RigError(
            f"a table of {size} knots per axis is not supported; it must be one of {', '.join(map(str, SIZES))}."
        )
    axes = grid_axes(rig, valid_box(rig), vertices[extreme_vertices(vertices)], size)
    if rig.kind == ADDITIVE:
        twists = np.concatenate([rig.twist(np.outer(axis, np.eye(3)[i])) for i, axis in enumerate(axes)])
    else:
        twists = _balanced_twists(rig, axes)
    table = DecoderTable("curves" if rig.kind == ADDITIVE else "grid", axes, twists.astype(np.float32))
    # the error of linear interpolation is largest in the middle of the cells
    middles = grid_points([0.5 * (axis[1:] + axis[:-1]) for axis in axes])
    samples = np.concatenate([middles[rig.margin(middles) >= 0], sample_valid(rig, _VALID_SAMPLES)])
    return replace(table, max_error_mm=table_error(rig, table, vertices, samples), error_samples=len(samples))


def _balanced_twists(rig: JawRig, axes: tuple[Array, Array, Array]) -> Array:
    """Return twists at the knots, shape (n1, n2, n3, 6), shifted to balance the errors of interpolation.

    Interpolating exact values gives errors of one sign, largest in the middle of the cells. Half of it, averaged over
    both cells along each axis, is subtracted at the knots. The closed bite stays exact.
    """
    exact = rig.twist(grid_points(axes)).reshape(*map(len, axes), 6)
    out = exact.copy()
    for i, axis in enumerate(axes):
        middles = [0.5 * (axis[1:] + axis[:-1]) if k == i else other for k, other in enumerate(axes)]
        found = np.moveaxis(rig.twist(grid_points(middles)).reshape(*map(len, middles), 6), i, 0)
        knots, taken = np.moveaxis(exact, i, 0), np.moveaxis(out, i, 0)
        error = np.concatenate([[np.zeros_like(knots[0])], found - 0.5 * (knots[1:] + knots[:-1])])
        error[0] = error[1]  # knots at the ends of an axis belong to only one cell
        after = np.concatenate([error[1:], error[-1:]])
        taken += 0.25 * (error + after)
    closed = tuple(int(np.searchsorted(axis, 0.0)) for axis in axes)
    out[closed] = exact[closed]
    return out


def table_error(rig: JawRig, table: DecoderTable, vertices: Array, d: Array) -> float:
    """Return the largest distance [mm] between table and model at any vertex (V, 3), over parameters d (n, 3).

    It is convex in the vertex, so the worst parameters are found with the extreme vertices.
    """
    exact = rig.pose(d)
    read = table.pose(d, rig.T_rest)
    rough = largest_distance(exact, read, vertices[extreme_vertices(vertices)])
    worst = np.argsort(rough)[-_FULL_CHECKS:]
    return float(largest_distance(exact[worst], read[worst], vertices).max())


def landmark_distance(rig: JawRig, T_a: Array, T_b: Array) -> Array:
    """Return the largest landmark distance [mm], shape (n,), between two sets of poses (n, 4, 4)."""
    return np.linalg.norm(transform_points(T_a - T_b, rig.landmarks), axis=-1).max(axis=-1)


def largest_distance(T_a: Array, T_b: Array, points: Array) -> Array:
    """Return the largest distance [mm], (n,), of points (V, 3) under two sets of poses (n, 4, 4): a quadratic form."""
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
    """Return the indices of those vertices (V, 3) that are extreme in one of 400 directions."""
    i = np.arange(400) + 0.5
    height, turn = 1 - 2 * i / len(i), np.pi * (1 + 5**0.5) * i  # Fibonacci sphere
    radius = np.sqrt(1 - height**2)
    directions = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    return np.unique(np.argmax(directions @ vertices.T, axis=1))
