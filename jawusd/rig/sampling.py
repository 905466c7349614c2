"""Samples of the parameters of a jaw model: the box around the valid ones, random ones, and the axes of a grid.

The error of linear interpolation over a step h is h^2 / 8 times the second derivative, so grid values as dense as the
square root of the curvature spread it evenly (de Boor, A Practical Guide to Splines, chapter XII).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import RigError
from jawusd.evaluator import JawRig
from jawusd.geometry.se3 import transform_points

_PROBES_PER_AXIS = 41

_FINE = 161  # values per axis at which the curvature is measured
_COARSE = 13  # values along the two other axes
_NEAR_BOUND_MM = -0.5  # parameters this far outside the bound still count: a cell reaches beyond it
_SMOOTHING = 9  # window over the curvature, in fine steps
_FLOOR = 0.05  # share of the largest curvature that is assumed everywhere
_POINTS = 40


def valid_box(rig: JawRig) -> Array:
    """Return the box (3, 2) [mm] of d that the table spans: `d_range`, widened to all d with a margin above zero.

    Raises:
        RigError: The bounds leave no valid parameters.
    """
    box = np.array(rig.d_range, dtype=np.float64)
    reach = 1.0 + rig.bound.offset_mm + rig.bound.softness_mm
    wide = box + np.array([-reach, reach])
    axes = [np.linspace(low, high, _PROBES_PER_AXIS) for low, high in wide]
    probes = grid_points(axes)
    valid = probes[rig.margin(probes) >= 0]
    if not len(valid):
        raise RigError("the bounds of the model leave no valid parameters.")
    step = np.array([axis[1] - axis[0] for axis in axes])
    low, high = valid.min(axis=0) - step, valid.max(axis=0) + step
    return np.stack([np.minimum(box[:, 0], low), np.maximum(box[:, 1], high)], axis=1).clip(wide[:, :1], wide[:, 1:])


def grid_points(axes: Sequence[Array] | Array) -> Array:
    """Return the points (n1 n2 n3, 3) of a grid with the given values along its axes."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def sample_valid(rig: JawRig, count: int, seed: int = 0) -> Array:
    """Return `count` valid d, shape (count, 3) [mm], spread evenly over the volume where the margin is not negative."""
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
    """Return values of d1, d2 and d3 between which linear interpolation errs least.

    Args:
        box: Range of each parameter [mm], shape (3, 2).
        points: Mandible points whose motion counts, mandible frame [mm], shape (V, 3).
        size: Number of values per axis.

    Returns:
        Three rising arrays (size,) [mm] that span the box; 0 is one of the values, so that the closed bite is exact.
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
