"""Reshape batches of any shape to rows, and process rows in chunks that fit the processor cache."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array, Indices

Rows = TypeVar("Rows", Array, Indices)  # an array of rows, or of row indices

CHUNK_ROWS = 2048
LARGEST = 1e9  # maximum magnitude of values [mm]: far beyond any jaw, but small enough that cubes do not overflow


def as_floats(values: ArrayLike, name: str) -> Array:
    """Return values as float64; raises ValueError for complex numbers, text, or objects."""
    found = np.asarray(values)
    if found.dtype.kind not in "biuf":
        raise ValueError(f"{name} must be real numbers, got {found.dtype}")
    return np.asarray(found, dtype=np.float64)


def rows_of(values: ArrayLike, tail: tuple[int, ...], name: str) -> tuple[Array, tuple[int, ...]]:
    """Return values as float64 rows (n, *tail) and the batch shape; raises ValueError unless they end in ``tail``."""
    values = as_floats(values, name)
    if values.shape == tail:  # fast path for a single row
        return values[None], ()
    batch = values.shape[: values.ndim - len(tail)]
    if values.ndim < len(tail) or values.shape[len(batch) :] != tail:
        raise ValueError(f"{name} must have shape (..., {', '.join(map(str, tail))}), got {values.shape}")
    rows = values.reshape(-1, *tail) if values.size else np.empty((math.prod(batch), *tail))
    return rows, batch


def usable_rows(rows: Array) -> Array:
    """Return the rows (n, ...); a row becomes NaN if one of its values is not finite or exceeds 1e9."""
    usable = np.asarray((np.abs(rows) < LARGEST).all(axis=tuple(range(1, rows.ndim))))  # comparisons with NaN are false
    if usable.all():
        return rows
    return np.where(usable.reshape(-1, *(1,) * (rows.ndim - 1)), rows, np.nan)


def as_rows(values: ArrayLike, tail: tuple[int, ...], name: str) -> tuple[Array, tuple[int, ...]]:
    """Return values as rows and the batch shape, like `rows_of`; see `usable_rows` for rows that become NaN."""
    rows, batch = rows_of(values, tail, name)
    return usable_rows(rows), batch


def in_chunks(function: Callable[[Rows], Array], rows: Rows) -> Array:
    """Return ``function(rows)``, computed in chunks of `CHUNK_ROWS` rows to limit temporary memory."""
    if len(rows) <= CHUNK_ROWS:
        return function(rows)
    return np.concatenate([function(rows[i : i + CHUNK_ROWS]) for i in range(0, len(rows), CHUNK_ROWS)])


def pairs_in_chunks(function: Callable[[Rows], tuple[Array, Array]], rows: Rows) -> tuple[Array, Array]:
    """Return the two arrays of ``function(rows)``, computed in chunks as by `in_chunks`."""
    if len(rows) <= CHUNK_ROWS:
        return function(rows)
    parts = [function(rows[i : i + CHUNK_ROWS]) for i in range(0, len(rows), CHUNK_ROWS)]
    return np.concatenate([first for first, _ in parts]), np.concatenate([second for _, second in parts])


def as_points(points: ArrayLike, name: str) -> Array:
    """Return one point (3,) or several (P, 3) as float64; raises ValueError for wrong shapes or infinite values."""
    points = as_floats(points, name)
    if points.ndim not in (1, 2) or points.shape[-1] != 3 or not points.size:
        raise ValueError(f"{name} must have shape (3,) or (P, 3), got {points.shape}")
    if not np.isfinite(points).all():
        raise ValueError(f"{name} must be finite")
    return points


def as_keys(frames: ArrayLike, d_keys: ArrayLike) -> tuple[Array, Array]:
    """Return key times (K,), keys (K, 3); raises ValueError for wrong shapes, infinities, or times not increasing."""
    frames, keys = as_floats(frames, "frames"), as_floats(d_keys, "d_keys")
    if frames.ndim != 1 or not frames.size or keys.shape != (len(frames), 3):
        raise ValueError(f"frames must have shape (K,) and d_keys (K, 3), K >= 1, got {frames.shape} and {keys.shape}")
    if not (np.isfinite(frames).all() and np.isfinite(keys).all()):
        raise ValueError("frames and d_keys must be finite")
    if (np.diff(frames) <= 0).any():
        raise ValueError("frames must increase")
    return frames, keys
