"""Where to sample a decoder: knots close together where the motion bends, so straight lines between them err least.

The error of linear interpolation over a step h is h^2 / 8 times the second derivative, so knots as dense as the square
root of the curvature spread it evenly (de Boor, A Practical Guide to Splines, chapter XII).
"""

from __future__ import annotations

import numpy as np

from jawusd.evaluator import JawRig
from jawusd.geometry.arrays import Array
from jawusd.geometry.se3 import transform_points

_FINE = 161  # places per axis at which the curvature is measured
_COARSE = 13  # places along the two other axes
_NEAR_BOUND_MM = -0.5  # parameters this far outside the bound still count: a cell reaches beyond it
_SMOOTHING = 9  # window over the curvature, in fine places
_FLOOR = 0.05  # share of the largest curvature that is assumed everywhere
_POINTS = 40


def sample_knots(rig: JawRig, box: Array, points: Array, size: int) -> tuple[Array, Array, Array]:
    """Return knots along d1, d2, d3.

    Args:
        rig: the exact model.
        box: range of each parameter [mm], shape (3, 2).
        points: mandible points whose motion counts, mandible coordinates [mm], shape (V, 3).
        size: knots per axis.

    Returns:
        Three rising arrays of `size` values [mm], from end to end of the box; 0 is one of them, so that the closed
        bite is exact.
    """
    points = points[:: max(1, len(points) // _POINTS)]
    return (
        _spread(rig, box, points, 0, size),
        _spread(rig, box, points, 1, size),
        _spread(rig, box, points, 2, size),
    )


def _spread(rig: JawRig, box: Array, points: Array, axis: int, size: int) -> Array:
    fine = np.linspace(*box[axis], _FINE)
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
    knots = np.interp(even, share, fine)
    knots[below] = 0.0
    return knots


def _curvature(rig: JawRig, box: Array, points: Array, axis: int) -> Array:
    """Return the largest second difference of any point along one axis of d, shape (_FINE,) [1/mm]."""
    axes = [np.linspace(*row, _FINE if i == axis else _COARSE) for i, row in enumerate(box)]
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
