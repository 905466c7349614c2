"""Batches as the compiled code takes them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jawusd.evaluator.rows import in_rows
from jawusd.geometry.arrays import Array


def rows_of(values: ArrayLike, tail: tuple[int, ...], name: str) -> tuple[Array, tuple[int, ...]]:
    """Return values as float64 rows (n, *tail) that the compiled code takes, and the batch shape.

    Raises:
        ValueError: the trailing axes are not ``tail``.
    """
    rows, batch = in_rows(values, tail, name)
    return owned(rows), batch


def owned(rows: Array) -> Array:
    """Return the rows, copied unless they are contiguous, aligned and writable."""
    return rows if rows.flags.carray else np.array(rows, order="C")
