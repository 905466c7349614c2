"""The sampled decoder for readers that do not implement the exact model: a grid of twists, interpolated linearly."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array, Indices
from jawusd.evaluator.batching import as_rows, in_chunks
from jawusd.evaluator.motions import motion_matrix, motion_of_twist, motions_from_twists

_SINGLE_LIMIT_MM = 1e4


class SampledTable:
    """Twists of a rig sampled on a grid over d: ``pose(d) = exp(trilinear(d)) rest``.

    Parameters outside the grid are clamped to it.

    Attributes:
        grid_axes: Increasing sample positions of d1, d2, d3 [mm], three arrays of length >= 2.
        T_rest: T_skull_mandible of the closed bite, shape (4, 4).
    """

    def __init__(self, grid_axes: tuple[ArrayLike, ArrayLike, ArrayLike], twists: ArrayLike, T_rest: ArrayLike) -> None:
        """Build the table.

        Args:
            grid_axes: Increasing sample positions of d1, d2, d3 [mm].
            twists: Twists (omega [rad], v [mm]), skull frame, shape (n1, n2, n3, 6).
            T_rest: T_skull_mandible of the closed bite, shape (4, 4).

        Raises:
            ValueError: shapes that do not match, or positions that do not increase.
        """
        self.grid_axes = tuple(np.array(axis, dtype=np.float64) for axis in grid_axes)
        self.T_rest = np.array(T_rest, dtype=np.float64)
        twists = np.asarray(twists, dtype=np.float64)
        counts = tuple(len(axis) for axis in self.grid_axes)
        if twists.shape != (*counts, 6) or self.T_rest.shape != (4, 4):
            raise ValueError(
                f"twists must have shape {(*counts, 6)} and T_rest (4, 4), got {twists.shape} and {self.T_rest.shape}"
            )
        if len(counts) != 3 or any(len(axis) < 2 or (np.diff(axis) <= 0).any() for axis in self.grid_axes):
            raise ValueError("grid_axes must be three increasing arrays of at least two positions")
        # stores neighbours along d3 side by side, for half as many memory accesses
        self._pairs = np.concatenate([twists[:, :, :-1], twists[:, :, 1:]], axis=3)
        self._flat = self._pairs.reshape(-1, 12)
        self._positions = tuple(axis.tolist() for axis in self.grid_axes)

    def twist(self, d: ArrayLike) -> Array:
        """Return the interpolated twists (omega [rad], v [mm]), shape (..., 6), at d (..., 3) [mm]."""
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(self._twists, rows).reshape(*batch, 6)

    def pose(self, d: ArrayLike) -> Array:
        """Return the poses T_skull_mandible, shape (..., 4, 4), at d (..., 3) [mm]."""
        d = np.asarray(d, dtype=np.float64)
        if d.shape == (3,):
            x, y, z = d.tolist()
            if abs(x) + abs(y) + abs(z) < _SINGLE_LIMIT_MM:  # false for NaN and inf
                return motion_matrix(motion_of_twist(*self._single_twist(x, y, z))).dot(self.T_rest)
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(self._poses, rows).reshape(*batch, 4, 4)

    def _poses(self, d: Array) -> Array:
        T = (motions_from_twists(self._twists(d)).reshape(-1, 4) @ self.T_rest).reshape(-1, 4, 4)
        T[np.isnan(d[:, 0])] = np.nan
        return T

    def _twists(self, d: Array) -> Array:
        (i, a), (j, b), (k, c) = (_located(axis, d[:, column]) for column, axis in enumerate(self.grid_axes))
        _, n2, n3, _ = self._pairs.shape
        corner = (i * n2 + j) * n3 + k
        a, b = a[:, None], b[:, None]
        pair = (1 - a) * (1 - b) * self._flat[corner]
        pair += (1 - a) * b * self._flat[corner + n3]
        pair += a * (1 - b) * self._flat[corner + n2 * n3]
        pair += a * b * self._flat[corner + n2 * n3 + n3]
        return pair[:, :6] + c[:, None] * (pair[:, 6:] - pair[:, :6])

    def _single_twist(self, x: float, y: float, z: float) -> list[float]:
        (i, a), (j, b), (k, c) = (_located_one(axis, value) for axis, value in zip(self._positions, (x, y, z)))
        weights = np.array(((1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b))
        pair = weights.dot(self._pairs[i : i + 2, j : j + 2, k].reshape(4, 12)).tolist()
        return [low + c * (high - low) for low, high in zip(pair, pair[6:])]


def _located(knots: Array, x: Array) -> tuple[Indices, Array]:
    """Return the cell (n,) of each position x (n,), clamped to the knots, and the fraction (n,) within the cell."""
    cell = np.clip(knots.searchsorted(x, side="right") - 1, 0, len(knots) - 2)
    start = knots[cell]
    return cell, np.clip((x - start) / (knots[cell + 1] - start), 0.0, 1.0)


def _located_one(knots: list[float], x: float) -> tuple[int, float]:
    cell = min(max(bisect_right(knots, x) - 1, 0), len(knots) - 2)
    share = (x - knots[cell]) / (knots[cell + 1] - knots[cell])
    return cell, min(max(share, 0.0), 1.0)
