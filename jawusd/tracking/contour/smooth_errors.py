"""Smooth errors of outlines as nuisance parameters.

Errors of drawn outlines and of colour edges change little over a few millimetres, so neighbouring samples have nearly
the same error.
Least squares treats samples as independent, and gives such errors too much weight where the contour is long. Here, the
error is a smooth field over the image plus white noise: the field is interpolated bilinearly between nodes on a grid.
Their values have a normal prior, and are eliminated from the normal equations (generalised least squares; Aitken 1936).
What remains are differences over less than the node spacing, such as the two sides of a gap between teeth, in which
smooth errors cancel.
"""

from __future__ import annotations

import numba
import numpy as np

from jawusd.base.arrays import Array
from jawusd.tracking.config import SmoothErrors


@numba.njit(nogil=True, cache=True)
def without_smooth_errors(rows: Array, weights: Array, pixels: Array, smooth: SmoothErrors) -> Array:
    """Return the rows of samples minus their weighted least-squares fit by a smooth field, times the noise ratio.

    For rows X, weights W, interpolation weights B, prior precision p and noise ratio g, the result is
    g (X - B (B^T W B + p)^-1 B^T W X); its product with W X is the matrix of generalised normal equations.

    Args:
        rows: linear terms of every sample, shape (n, m).
        weights: weight of every sample [px], shape (n,).
        pixels: position of every sample in the image [px], shape (n, 2), not negative.
        smooth: model of the errors.
    """
    count, terms = rows.shape
    columns = int(pixels[:, 0].max() / smooth.spacing_px) + 2 if count else 0
    lines = int(pixels[:, 1].max() / smooth.spacing_px) + 2 if count else 0
    number = np.full(columns * lines, -1)  # index of every grid node among those that are used
    nodes, shares, used = np.empty((count, 4), np.int64), np.empty((count, 4)), 0
    for s in range(count):
        x, y = pixels[s, 0] / smooth.spacing_px, pixels[s, 1] / smooth.spacing_px
        i, j = int(x), int(y)
        for k in range(4):
            right, down = k % 2, k // 2
            place = (j + down) * columns + i + right
            if number[place] < 0:
                number[place] = used
                used += 1
            nodes[s, k] = number[place]
            shares[s, k] = abs(1 - right - (x - i)) * abs(1 - down - (y - j))
    normal, right_sides = np.zeros((used, used)), np.zeros((used, terms))
    for s in range(count):
        for k in range(4):
            share = weights[s] * shares[s, k]
            for q in range(4):
                normal[nodes[s, k], nodes[s, q]] += share * shares[s, q]
            for t in range(terms):
                right_sides[nodes[s, k], t] += share * rows[s, t]
    for k in range(used):
        normal[k, k] += smooth.prior_px
    field = np.linalg.solve(normal, right_sides)
    out = smooth.noise_ratio * rows
    for s in range(count):
        for k in range(4):
            for t in range(terms):
                out[s, t] -= smooth.noise_ratio * shares[s, k] * field[nodes[s, k], t]
    return out
