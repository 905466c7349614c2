"""The sampled table, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jawusd.evaluator.table import SampledTable
from jawusd.fast import grid
from jawusd.fast.arrays import rows_of
from jawusd.geometry.arrays import Array

_SINGLE_LIMIT_MM = 1e4


class FastTable(SampledTable):
    """`SampledTable`, compiled: the same results to 1e-10."""

    def __init__(self, knots: tuple[ArrayLike, ArrayLike, ArrayLike], twists: ArrayLike, T_rest: ArrayLike) -> None:
        """Build the table; arguments and errors as those of `SampledTable`."""
        super().__init__(knots, twists, T_rest)
        self._axes = np.concatenate([[len(axis) for axis in self.knots], self.T_rest.ravel(), *self.knots])
        self._cells = np.ascontiguousarray(self._flat)

    def twist(self, d: ArrayLike) -> Array:
        """Return the interpolated twists (omega [rad], v [mm]), shape (..., 6), at d (..., 3) [mm]."""
        rows, batch = rows_of(d, (3,), "d")
        out = np.empty((len(rows), 6))
        grid.table_twists(self._axes, self._cells, rows, out)
        return out.reshape(*batch, 6)

    def pose(self, d: ArrayLike) -> Array:
        """Return the poses T_skull_mandible, shape (..., 4, 4), at d (..., 3) [mm]."""
        d = np.asarray(d, dtype=np.float64)
        if d.shape == (3,):
            x, y, z = d.tolist()
            if abs(x) + abs(y) + abs(z) < _SINGLE_LIMIT_MM:  # False for NaN
                return grid.single_table_pose(self._axes, self._cells, x, y, z)
        rows, batch = rows_of(d, (3,), "d")
        out = np.empty((len(rows), 4, 4))
        grid.table_poses(self._axes, self._cells, rows, out)
        return out.reshape(*batch, 4, 4)
