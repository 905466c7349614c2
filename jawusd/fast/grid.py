"""Compiled: the sampled table of `jawusd.evaluator.table` over rows.

`axes` holds the numbers of knots of d1, d2, d3, then T_rest (4, 4), then the knots [mm]; `pairs` the twists of
neighbours along d3 side by side, (n1 n2 (n3 - 1), 12).
"""

from __future__ import annotations

import numpy as np

from jawusd.fast.forms import interval
from jawusd.fast.rigid import device, move
from jawusd.fast.rows import compiled, usable

REST, KNOTS = 3, 19


@device
def _located(axes, first, count, x):
    """Return the cell of position x and the share of the way through it, x clamped to the knots."""
    knots = axes[first:]
    cell = min(max(interval(knots, count, x) - 1, 0), count - 2)
    share = (x - knots[cell]) / (knots[cell + 1] - knots[cell])
    return cell, min(max(share, 0.0), 1.0)


@device
def _interpolate(axes, pairs, d1, d2, d3, twist):
    n1, n2, n3 = int(axes[0]), int(axes[1]), int(axes[2])
    i, a = _located(axes, KNOTS, n1, d1)
    j, b = _located(axes, KNOTS + n1, n2, d2)
    k, c = _located(axes, KNOTS + n1 + n2, n3, d3)
    corner = (i * n2 + j) * (n3 - 1) + k
    lower, upper = pairs[corner], pairs[corner + n3 - 1]
    far_lower, far_upper = pairs[corner + n2 * (n3 - 1)], pairs[corner + (n2 + 1) * (n3 - 1)]
    p, q, r, s = (1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b
    for x in range(6):
        low = p * lower[x] + q * upper[x] + r * far_lower[x] + s * far_upper[x]
        high = p * lower[6 + x] + q * upper[6 + x] + r * far_lower[6 + x] + s * far_upper[6 + x]
        twist[x] = low + c * (high - low)


@device
def _pose(axes, pairs, d1, d2, d3, twist, M, out):
    _interpolate(axes, pairs, d1, d2, d3, twist)
    move(twist, M)
    for k in range(4):
        q0, q1, q2, q3 = axes[REST + k], axes[REST + 4 + k], axes[REST + 8 + k], axes[REST + 12 + k]
        for i in range(3):
            out[i, k] = M[i, 0] * q0 + M[i, 1] * q1 + M[i, 2] * q2 + M[i, 3] * q3
        out[3, k] = q3


@compiled("f8[:,::1](f8[::1], f8[:,::1], f8, f8, f8)")
def single_table_pose(axes, pairs, d1, d2, d3):
    """Return the pose (4, 4) at one d [mm]."""
    out = np.empty((4, 4))
    _pose(axes, pairs, d1, d2, d3, np.empty(6), np.empty((3, 4)), out)
    return out


@compiled("void(f8[::1], f8[:,::1], f8[:,::1], f8[:,:,::1])")
def table_poses(axes, pairs, d, out):
    """Write the poses (n, 4, 4) at d (n, 3) [mm] to out."""
    twist, M = np.empty(6), np.empty((3, 4))
    for row in range(len(d)):
        if usable(d[row, 0], d[row, 1], d[row, 2]):
            _pose(axes, pairs, d[row, 0], d[row, 1], d[row, 2], twist, M, out[row])
        else:
            out[row] = np.nan


@compiled("void(f8[::1], f8[:,::1], f8[:,::1], f8[:,::1])")
def table_twists(axes, pairs, d, out):
    """Write the twists (n, 6) at d (n, 3) [mm] to out."""
    for row in range(len(d)):
        if usable(d[row, 0], d[row, 1], d[row, 2]):
            _interpolate(axes, pairs, d[row, 0], d[row, 1], d[row, 2], out[row])
        else:
            out[row] = np.nan
