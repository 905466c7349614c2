"""Batches as the compiled code takes them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.evaluator.rows import as_rows

Array = NDArray[np.float64]


def rows_of(values: ArrayLike, tail: tuple[int, ...], name: str) -> tuple[Array, tuple[int, ...]]:
    """Return values as contiguous, writable float64 rows (n, *tail) and the batch shape.

    Rows with a value that is not finite, or above 1e9, become all NaN.

    Raises:
        ValueError: the trailing axes are not ``tail``.
    """
    rows, batch = as_rows(values, tail, name)
    return np.require(rows, requirements=("C", "W")), batch
