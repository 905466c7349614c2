"""Match contour samples with mask edges, eliminate smooth errors, and accumulate the normal equations."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.tracking.config import SmoothErrors
from jawusd.tracking.contour.equations import OutlineSums
from jawusd.tracking.contour.samples import (
    COLUMNS,
    EDGE_SHARE,
    INVERSE_DEPTH,
    LENGTH,
    NX,
    NY,
    U,
    V,
    X,
    Y,
    Z,
    is_nearer,
    value_at,
)

_GUM, _DISTANCE, _TERMS = 7, 9, 10  # columns of `LinearTerms.rows`, and their number
_EDGE = 127.5  # mask value at the outline, where half of the pixel area belongs to the teeth


@numba.njit(nogil=True, cache=True, inline="always")
def _sample(mask: NDArray[np.uint8], x: float, y: float) -> float:
    """Interpolate a uint8 image bilinearly; return 0 outside."""
    if x < 0 or y < 0 or x >= mask.shape[1] - 1 or y >= mask.shape[0] - 1:
        return 0.0
    i = int(x)
    j = int(y)
    a = x - i
    b = y - j
    return (mask[j, i] * (1 - a) + mask[j, i + 1] * a) * (1 - b) + (
        mask[j + 1, i] * (1 - a) + mask[j + 1, i + 1] * a
    ) * b


@numba.njit(nogil=True, cache=True)
def _nearest_edge(mask: NDArray[np.uint8], x: float, y: float, nx: float, ny: float, reach: float) -> float:
    """Return the signed distance [px] to the nearest edge where the mask ends, NaN without one, inf deep inside."""
    start = _sample(mask, x, y)
    outer = inner = start
    steps = int(np.ceil(reach))
    for k in range(1, steps + 1):
        best = np.inf
        value = _sample(mask, x + k * nx, y + k * ny)
        if outer >= _EDGE and value < _EDGE:
            best = k - 1 + (outer - _EDGE) / (outer - value)
        outer = value
        value = _sample(mask, x - k * nx, y - k * ny)
        if value >= _EDGE and inner < _EDGE:
            d = -k + (value - _EDGE) / (value - inner)
            if -d < best:
                best = d
        inner = value
        if best < np.inf:
            return best
    return np.inf if start >= _EDGE and outer >= _EDGE else np.nan


@numba.njit(nogil=True, cache=True)
def search_edges(
    samples: Array,
    mask: NDArray[np.uint8],
    other_mask: NDArray[np.uint8],
    other_inverse_depth: NDArray[np.float32],
    reach_px: float,
    tolerance_mm: float,
    cos_limit: float,
    out: Array,
) -> None:
    """Write the signed distance [px] from every contour sample to its mask edge.

    Args:
        samples: contour samples, shape (n, COLUMNS).
        mask, other_mask: masks of this arch and of the other one, 255 = teeth, shape (h, w).
        other_inverse_depth: rendered inverse depth of the other arch's scan [1/mm], 0 = empty, shape (h, w).
        reach_px: search distance in both directions.
        tolerance_mm: minimum depth difference for one arch to hide the other.
        cos_limit: minimum cosine between the normals of the sample and of the mask edge.
        out: receives the distances, positive outwards, shape (n,). NaN if the sample is hidden or no edge of its own
            arch is near; +inf if the mask extends over the whole reach.
    """
    for s in range(len(samples)):
        sample = samples[s]
        x, y, nx, ny, own = sample[U], sample[V], sample[NX], sample[NY], sample[INVERSE_DEPTH]
        out[s] = np.nan
        if is_nearer(value_at(other_inverse_depth, x, y), own, tolerance_mm):
            continue  # the other arch is in front of the sample
        d = _nearest_edge(mask, x, y, nx, ny, reach_px)
        if np.isfinite(d):
            ex = x + d * nx
            ey = y + d * ny
            gx = _sample(mask, ex + 1, ey) - _sample(mask, ex - 1, ey)
            gy = _sample(mask, ex, ey + 1) - _sample(mask, ex, ey - 1)
            if -(gx * nx + gy * ny) < cos_limit * np.sqrt(gx * gx + gy * gy):
                continue  # a mask edge that crosses the contour belongs to a lip or a neighbouring tooth
            if _sample(other_mask, ex + 2 * nx, ey + 2 * ny) > _EDGE:
                other = value_at(other_inverse_depth, ex + 2 * nx, ey + 2 * ny)
                if other == 0.0 or is_nearer(other, own, 0.25 * tolerance_mm):
                    continue  # the edge belongs to the other arch, which is in front
        out[s] = d


@numba.njit(nogil=True, cache=True)
def _slope(sample: Array, pose: Array, matrix: Array, centre: Array, jacobian: Array) -> None:
    """Write the derivative of a sample's normal displacement [px] with respect to a left twist about a world point."""
    a = pose[0, 0] * sample[X] + pose[0, 1] * sample[Y] + pose[0, 2] * sample[Z] + pose[0, 3]
    b = pose[1, 0] * sample[X] + pose[1, 1] * sample[Y] + pose[1, 2] * sample[Z] + pose[1, 3]
    c = pose[2, 0] * sample[X] + pose[2, 1] * sample[Y] + pose[2, 2] * sample[Z] + pose[2, 3]
    w = matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2] * c + matrix[2, 3]
    for k in range(3):
        along_x = sample[NX] * (matrix[0, k] - sample[U] * matrix[2, k])
        along_y = sample[NY] * (matrix[1, k] - sample[V] * matrix[2, k])
        jacobian[3 + k] = (along_x + along_y) / w
    a -= centre[0]
    b -= centre[1]
    c -= centre[2]
    jacobian[0] = b * jacobian[5] - c * jacobian[4]
    jacobian[1] = c * jacobian[3] - a * jacobian[5]
    jacobian[2] = a * jacobian[4] - b * jacobian[3]


class LinearTerms(NamedTuple):
    """Linear terms of the n samples within the gate."""

    # Derivative with respect to a twist (6), effects of annotator bias (tooth edge, gum line in px and mm), and
    # distance to the mask edge, shape (n, 10).
    rows: Array
    weights: Array  # Tukey weight times contour length [px], shape (n,)
    pixels: Array  # position in the image [px], not negative, shape (n, 2)


@numba.njit(nogil=True, cache=True)
def linear_terms(
    samples: Array,
    distances: Array,
    limits: tuple[float, float, float],
    where: tuple[Array, Array, Array],
    sums: OutlineSums,
    r: int,
    c: int,
) -> LinearTerms:
    """Return the linear terms of the samples of one arch r in one view c; add their lengths and scores to sums.

    The residual d of a sample with image normal n decreases by n . du if the sample moves by du in the image; du is
    caused by a left twist (omega, v) of the arch about a centre (Drummond & Cipolla 2002 use the same distances).

    Args:
        samples, distances: input and output of `search_edges`, shapes (n, COLUMNS) and (n,).
        limits: residuals above which the Tukey weight and the contribution to the score are zero [px]; and the weight,
            at the former, of samples deep inside the mask.
        where: scan to world (4, 4), world [mm] to homogeneous px (3, 4), centre of the twist in the world (3,) [mm].
    """
    gate_px, score_gate_px, pull = limits
    pose, matrix, centre = where
    rows, weights, pixels = np.empty((len(samples), _TERMS)), np.empty(len(samples)), np.empty((len(samples), 2))
    n = 0
    for s in range(len(samples)):
        d = distances[s]
        if np.isnan(d):
            continue
        sample = samples[s]
        if np.isinf(d):
            if pull == 0.0:
                continue
            d = gate_px
            weight = pull
        else:
            e = 1.0 - (d / score_gate_px) ** 2
            if e > 0:
                sums.score_px[r, c] += e * e * e * sample[LENGTH]
            e = 1.0 - (d / gate_px) ** 2
            if e <= 0:
                continue
            weight = e * e
            sums.matched_px[r, c] += sample[LENGTH]
        weights[n] = weight * sample[LENGTH]
        pixels[n, 0], pixels[n, 1] = max(sample[U], 0.0), max(sample[V], 0.0)
        _slope(sample, pose, matrix, centre, rows[n])
        for a in range(COLUMNS - EDGE_SHARE):
            rows[n, 6 + a] = sample[EDGE_SHARE + a]
        rows[n, _DISTANCE] = d
        n += 1
    return LinearTerms(rows[:n], weights[:n], pixels[:n])


@numba.njit(nogil=True, cache=True)
def without_smooth_errors(rows: Array, weights: Array, pixels: Array, smooth: SmoothErrors) -> Array:
    """Return the rows of samples minus their weighted least-squares fit by a smooth field, times the noise ratio.

    Errors of drawn outlines and of colour edges change little over a few millimetres. Least squares treats samples as
    independent, and gives such errors too much weight where the contour is long. Here, the error is a smooth field,
    interpolated bilinearly between nodes on a grid, plus white noise. The nodes have a normal prior, and are eliminated
    from the normal equations (generalised least squares; Aitken 1936). What remains are differences over less than the
    node spacing, such as the two sides of a gap between teeth, in which smooth errors cancel.

    For rows X, weights W, interpolation weights B, prior precision p and noise ratio g, the result is
    g (X - B (B^T W B + p)^-1 B^T W X); its product with W X is the matrix of generalised normal equations.

    `rows`, shape (n, m), `weights` and `pixels` are as in `LinearTerms`.
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


@numba.njit(nogil=True, cache=True)
def accumulate(terms: LinearTerms, rest: Array, sums: OutlineSums, r: int, c: int) -> None:
    """Add the weighted normal equations of one arch r in one view c to sums.

    `rest` are the rows of the terms without smooth outline errors, or the rows themselves, shape (n, 10).
    """
    rows, weights, _ = terms
    matrix = np.zeros((_TERMS, _TERMS))
    weight = square = 0.0
    for s in range(len(rows)):
        w = weights[s]
        for i in range(_TERMS):
            for k in range(i + 1):
                matrix[i, k] += w * rows[s, i] * rest[s, k]
        weight += w
        square += w * rows[s, _DISTANCE] ** 2
    for i in range(_TERMS):
        for k in range(i):
            matrix[k, i] = matrix[i, k]
    sums.precision[r, c] += matrix[:6, :6]
    sums.gradient[r, c] += matrix[:6, _DISTANCE]
    sums.habit_slope[r, c] += matrix[6:_DISTANCE, :6]
    sums.habit_distance[r, c] += matrix[6:_DISTANCE, _DISTANCE]
    sums.habit_weight[r, c] += matrix[6:_DISTANCE, 6:_DISTANCE]
    sums.weight[r, c] += weight
    sums.square[r, c] += square


@numba.njit(nogil=True, cache=True)
def scatter_of_tiles(terms: LinearTerms, rest: Array, tile_px: int) -> tuple[Array, Array]:
    """Return the sum of s s^T over image tiles, shape (6, 6), where s is the sum of w J d over the samples in a tile.

    The second result uses the gum fraction instead of d: the effect of a gum line that is one pixel off in each tile.

    Outline errors are correlated along the contour, so they are summed within a tile before they are squared. The ratio
    of the result to the normal matrix gives the correlation length (cluster-robust covariance, Liang & Zeger 1986).

    `rest` is as for `accumulate`; the square tiles are larger than the correlation length.
    """
    rows, weights, pixels = terms
    across = int(pixels[:, 0].max() / tile_px) + 1 if len(pixels) else 0
    down = int(pixels[:, 1].max() / tile_px) + 1 if len(pixels) else 0
    scatter, gum = np.zeros((down * across, 6)), np.zeros((down * across, 6))
    for s in range(len(rows)):
        tile = int(pixels[s, 1] / tile_px) * across + int(pixels[s, 0] / tile_px)
        for k in range(6):
            scatter[tile, k] += weights[s] * rest[s, _DISTANCE] * rows[s, k]
            gum[tile, k] += weights[s] * rest[s, _GUM] * rows[s, k]
    return scatter.T @ scatter, gum.T @ gum
