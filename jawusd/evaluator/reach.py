"""Searches inside the bound: the nearest valid parameters, and inverse kinematics of the mandible's points."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import EvaluatorError
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.distances import carried, distance_residual
from jawusd.evaluator.models import JawModelForm
from jawusd.evaluator.rows import in_chunks
from jawusd.evaluator.solver import minimise

Array = NDArray[np.float64]

_SCAN_ROWS = 64  # rows compared with all candidates at once: 64 x 6,000 distances are 3 MB


class Reach:
    """Where the jaw can go, scanned once: the valid volume is not quite convex, so searches start at its best point.

    Args:
        model: The jaw model.
        bound: The valid volume.
    """

    def __init__(self, model: JawModelForm, bound: SliceHull) -> None:
        self._model, self._bound = model, bound

    @cached_property
    def _scan(self) -> tuple[Array, tuple[Array, Array]]:
        """Points (p, 3) [mm] all over the valid volume, and their motions."""
        points = self._bound.candidates()
        if not len(points):
            raise EvaluatorError(
                "the bound of this rig leaves no valid jaw parameters.", hint="Fit the model again with a wider margin."
            )
        return points, in_chunks(self._model.decode, points)

    def nearest(self, d: Array) -> Array:
        """Return the nearest points (n, 3) [mm] inside the bound; d (n, 3) itself where it is inside.

        Raises:
            EvaluatorError: the valid volume is empty.
        """
        valid = d.copy()
        out = np.flatnonzero(self._bound.excess(d) > 0)
        if not out.size:
            return valid
        points, _ = self._scan
        start = points[_nearest_rows(points, d[out])]
        identity = np.eye(3)

        def residual(x: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
            return x - d[out[rows]], np.broadcast_to(identity, (len(x), 3, 3))

        valid[out] = minimise(residual, start, self._bound)
        return valid

    def best_starts(self, vectors: Array, target: Array) -> Array:
        """Return the scanned points (n, 3) [mm] that bring the vectors (4, m) nearest to the targets (n, 3, m)."""
        points, motions = self._scan
        images = carried(*motions, vectors).reshape(len(points), -1)
        lost = np.isnan(target).any(axis=(1, 2))
        starts = points[_nearest_rows(images, target.reshape(len(target), images.shape[1]))]
        starts[lost] = np.nan
        return starts

    def pull(self, vectors: Array, target: Array, start: Array) -> Array:
        """Return the valid d (n, 3) [mm] that bring the vectors (4, m) locally nearest to the targets (n, 3, m).

        Args:
            vectors: Homogeneous points of the mandible at rest, anatomical frame [mm], scaled by their weights.
            target: Where they should go, scaled alike.
            start: First d [mm], inside the bound, shape (n, 3).
        """
        return minimise(distance_residual(self._model.decode_derivative, vectors, target), start, self._bound)


def nearest_distance(points: Array, queries: Array) -> Array:
    """Return the distance (n,) of queries (n, 3) to the nearest of the points (p, 3); inf without points."""
    if not len(points):
        return np.where(np.isnan(queries[:, 0]), np.nan, np.inf)
    return np.linalg.norm(queries - points[_nearest_rows(points, queries)], axis=1)


def _nearest_rows(points: Array, queries: Array) -> NDArray[np.intp]:
    """Return for each query (n, k) the number of the nearest point (p, k); 0 for NaN."""
    squared = np.einsum("pk,pk->p", points, points)
    found = np.zeros(len(queries), dtype=np.intp)
    for i in range(0, len(queries), _SCAN_ROWS):
        found[i : i + _SCAN_ROWS] = np.argmin(squared - 2.0 * queries[i : i + _SCAN_ROWS] @ points.T, axis=1)
    return found
