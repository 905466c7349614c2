"""Encoding and searches inside the bound, compiled."""

from __future__ import annotations

import numpy as np

from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.models import JawModelForm
from jawusd.evaluator.reach import Reach
from jawusd.fast import rows
from jawusd.fast.arrays import owned
from jawusd.fast.descent import PARAMETERS, POINT
from jawusd.geometry.arrays import Array


class FastReach(Reach):
    """`Reach`, its searches compiled.

    Args:
        model: The jaw model.
        bound: The valid volume.
        packed_model: The numbers of both, see `packing`.
        packed_bound: Likewise.
    """

    def __init__(self, model: JawModelForm, bound: SliceHull, packed_model: Array, packed_bound: Array) -> None:
        super().__init__(model, bound)
        self._numbers = packed_model, packed_bound

    def _pull(self, vectors: Array, target: Array, start: Array) -> tuple[Array, Array]:
        return self._descended(PARAMETERS, np.ascontiguousarray(vectors), target, start)

    def _approach(self, wanted: Array, start: Array) -> tuple[Array, Array]:
        return self._descended(POINT, np.empty((4, 0)), wanted[:, :, None], start)

    def _descended(self, chart: int, vectors: Array, target: Array, start: Array) -> tuple[Array, Array]:
        found, cost = np.array(start, order="C"), np.empty(len(start))
        rows.descents(*self._numbers, chart, vectors, owned(target), found, cost)
        return found, cost
