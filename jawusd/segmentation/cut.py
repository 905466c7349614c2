"""Three-way minimal cut of a picture: upper teeth, lower teeth, everything else."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Mask

_TAU = _SIGMA = 0.35  # steps of the primal-dual iteration: their product times 8, the norm of the gradient, stays < 1


@numba.njit(nogil=True, cache=True)
def _iterate(
    cost: NDArray[np.float32],
    edge: NDArray[np.float32],
    u: NDArray[np.float32],
    spans: NDArray[np.int64],
    steps: int,
) -> None:
    """Run the first-order primal-dual iteration (Chambolle and Pock 2011) of the relaxed Potts energy.

    cost (3, h, w), edge (2, h, w) weights of the links to the right and down; u (3, h, w) in and out; spans (h, 2)
    columns of each row that are in play, all others stay as they are.
    """
    n, h, w = cost.shape
    px, py = np.zeros_like(u), np.zeros_like(u)
    bar = u.copy()
    for _ in range(steps):
        for k in range(n):
            for y in range(h):
                for x in range(spans[y, 0], spans[y, 1]):
                    gx = bar[k, y, x + 1] - bar[k, y, x] if x + 1 < w else np.float32(0.0)
                    gy = bar[k, y + 1, x] - bar[k, y, x] if y + 1 < h else np.float32(0.0)
                    a = px[k, y, x] + np.float32(_SIGMA) * gx
                    b = py[k, y, x] + np.float32(_SIGMA) * gy
                    la, lb = edge[0, y, x], edge[1, y, x]
                    px[k, y, x] = min(max(a, -la), la)
                    py[k, y, x] = min(max(b, -lb), lb)
        for y in range(h):
            for x in range(spans[y, 0], spans[y, 1]):
                v0 = v1 = v2 = np.float32(0.0)
                for k in range(3):
                    div = px[k, y, x] + py[k, y, x]
                    if x > 0:
                        div -= px[k, y, x - 1]
                    if y > 0:
                        div -= py[k, y - 1, x]
                    v = u[k, y, x] + np.float32(_TAU) * (div - cost[k, y, x])
                    if k == 0:
                        v0 = v
                    elif k == 1:
                        v1 = v
                    else:
                        v2 = v
                s0, s1, s2 = _to_simplex(v0, v1, v2)
                bar[0, y, x] = 2 * s0 - u[0, y, x]
                bar[1, y, x] = 2 * s1 - u[1, y, x]
                bar[2, y, x] = 2 * s2 - u[2, y, x]
                u[0, y, x], u[1, y, x], u[2, y, x] = s0, s1, s2


@numba.njit(nogil=True, cache=True)
def _to_simplex(a: np.float32, b: np.float32, c: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """Return the nearest three shares that are not negative and sum to one."""
    high = max(a, b, c)
    low = min(a, b, c)
    mid = a + b + c - high - low
    t = (a + b + c - np.float32(1.0)) / np.float32(3.0)
    if low - t < 0:
        t = (high + mid - np.float32(1.0)) * np.float32(0.5)
        if mid - t < 0:
            t = high - np.float32(1.0)
    zero = np.float32(0.0)
    return max(a - t, zero), max(b - t, zero), max(c - t, zero)


def cut_three_ways(
    cost: NDArray[np.float32],
    edge: NDArray[np.float32],
    start: NDArray[np.float32],
    free: Mask,
    steps: int,
) -> NDArray[np.float32]:
    """Return the shares of the labels, not negative, sum 1, shape (3, h, w), of the cheapest cut.

    The cost is that of the labels plus the weighted length of the borders between them: the convex relaxation of the
    Potts model with separate labels (Zach et al. 2008), links to the right and down.

    Args:
        cost: cost of each label per pixel, shape (3, h, w).
        edge: price of a border between a pixel and its right and lower neighbour, shape (2, h, w).
        start: first guess of the shares, shape (3, h, w).
        free: pixels whose label is open, shape (h, w); the others keep the first guess.
    """
    u = np.ascontiguousarray(start, np.float32).copy()
    spans = np.zeros((cost.shape[1], 2), np.int64)
    for y in np.flatnonzero(free.any(1)):
        columns = np.flatnonzero(free[y])
        spans[y] = columns[0], columns[-1] + 1
    # Each border is one of two labels, and counts once.
    half = np.ascontiguousarray(0.5 * edge, np.float32)
    _iterate(np.ascontiguousarray(cost, np.float32), half, u, spans, steps)
    return u
