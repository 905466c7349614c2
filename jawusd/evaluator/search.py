"""Searches inside the bound: for the nearest valid parameters, and inverse kinematics of points of the mandible."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array, Indices
from jawusd.evaluator.batching import pairs_in_chunks
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.encoding import Handles
from jawusd.evaluator.kernels import NumpyKernels
from jawusd.evaluator.models import JawModelForm
from jawusd.evaluator.solver import pulled_inside

# (row indices (k,), starts (k, 3)) -> minima (k, 3) and squared residuals (k,)
Search = Callable[[Indices, Array], tuple[Array, Array]]

_MAX_VALLEYS = 4
_RIPPLE_STEPS = (-2.0, -1.0, 1.0, 2.0)
_MAX_DRAG_MM = 3.0  # maximum change of d [mm] between two drag events; after a larger one, another basin may be better
_SCAN_ROWS = 64  # number of rows compared with all candidates at once; 64 x 6,000 distances take 3 MB


class IkResult(NamedTuple):
    """Result of `JawRig.ik`: d [mm], shape (..., 3), and the remaining distance [mm], shape (...)."""

    d: Array
    distance_mm: Array


class BoundedSearch:
    """Searches inside the bound, started from a cached scan of the valid volume.

    Sections at one opening are convex, but the valid volume is not: along d1 the cost may have several local minima
    ("valleys"), so a search is started in each of the lowest valleys.
    """

    def __init__(self, model: JawModelForm, bound: SliceHull, kernels: NumpyKernels) -> None:
        self._model, self._bound, self._kernels = model, bound, kernels

    @cached_property
    def _scan(self) -> _Scan:
        points = self._bound.candidates()
        return _Scan(points, *pairs_in_chunks(self._model.decode, points))

    def nearest(self, d: Array) -> Array:
        """Return the nearest points (n, 3) [mm] in the bound, d (n, 3) if inside; raises EvaluatorError without any."""
        valid = d.copy()
        out = np.flatnonzero(self._bound.signed_distance(d) > 0)
        if not out.size:
            return valid
        wanted = d[out]
        valid[out], _ = self._best(
            lambda rows, first: self._kernels.approach(wanted[rows], first), self._scan.points, wanted
        )
        return valid

    def solve_ik(self, handles: Handles, target: Array, start: Array) -> Array:
        """Return the local minima in whose basins the starts (n, 3) [mm] lie, which makes dragging continuous.

        A result far from its start is not part of a drag; the result of `solve_ik_multistart` replaces it if that one
        is better.
        """
        found, left = self._kernels.solve_ik(handles, target, start)
        far = np.flatnonzero(np.linalg.norm(found - start, axis=1) > _MAX_DRAG_MM)
        if far.size:
            best, least = self.solve_ik_multistart(handles, target[far])
            better = least < left[far]
            found[far[better]] = best[better]
        return found

    def solve_ik_multistart(self, handles: Handles, target: Array) -> tuple[Array, Array]:
        """Return valid d (n, 3) [mm] that move handles nearest to targets (n, 3, m), and squared distances (n,)."""
        images = handles.features(self._scan.images(handles.vectors), self._scan.points)
        wanted = handles.features(target, np.zeros((len(target), 3)))
        best, least = self._best(
            lambda rows, first: self._kernels.solve_ik(handles, target[rows], first), images, wanted
        )
        first, inside = pulled_inside(self._bound, (best[:, None] + self._ripples).reshape(-1, 3))
        first[~inside] = np.nan
        found, left = self._kernels.solve_ik(handles, np.repeat(target, len(self._ripples), axis=0), first)
        left = np.where(np.isnan(left), np.inf, left).reshape(len(best), len(self._ripples))
        choice = left.argmin(axis=1)
        each = np.arange(len(best))
        better = left[each, choice] < least
        best[better] = found.reshape(*left.shape, 3)[each, choice][better]
        return best, np.minimum(least, left[each, choice])

    @cached_property
    def _ripples(self) -> Array:
        """Steps (r, 3) [mm] across ripples of the bound, whose wavelength is the knot spacing of its supports."""
        spacing_mm = np.diff(self._bound.supports.knots).mean()
        return np.array([[step * spacing_mm, 0.0, 0.0] for step in _RIPPLE_STEPS])

    def _best(self, search: Search, features: Array, wanted: Array) -> tuple[Array, Array]:
        """Return the best d (n, 3) [mm] of searches in all valleys of features (p, k), and squared residuals (n,)."""
        best, least = np.full((len(wanted), 3), np.nan), np.full(len(wanted), np.inf)
        rows, starts = self._scan.valleys(features, wanted)
        found, cost = search(rows, starts)
        order = np.lexsort((cost, rows))  # sort by row, then by cost, with NaN last
        each, first = np.unique(rows[order], return_index=True)
        best[each], least[each] = found[order[first]], cost[order[first]]
        return best, least


class _Scan:
    """Points d (p, 3) [mm] spread over the valid volume, by slices in order of d1, and the rigid motion at each."""

    def __init__(self, points: Array, R: Array, t: Array) -> None:
        """Store the points and the rigid motion at each: R (p, 3, 3), t (p, 3) [mm]."""
        self.points, self._lengths = points, _squared_lengths(points)
        self._motions = np.concatenate([R, t[:, :, None]], axis=2).reshape(-1, 4)
        self._first = np.flatnonzero(np.diff(points[:, 0], prepend=-np.inf) > 0)

    def images(self, vectors: Array) -> Array:
        """Apply the motions to homogeneous vectors (4, m) [mm]; return an array of shape (p, 3, m)."""
        return (self._motions @ vectors).reshape(len(self.points), 3, vectors.shape[1])

    def valleys(self, features: Array, wanted: Array) -> tuple[Indices, Array]:
        """Return starting points for wanted features (n, k): row indices (m,), with repeats, and d (m, 3) [mm].

        A valley is a slice whose best point, by its features (p, k), is at least as good as those of both neighbouring
        slices; rows with NaN have none.
        """
        found = np.full((len(wanted), _MAX_VALLEYS), -1, dtype=np.intp)
        squared = self._lengths if features is self.points else _squared_lengths(features)
        for i in range(0, len(wanted), _SCAN_ROWS):
            distance = squared - 2.0 * wanted[i : i + _SCAN_ROWS] @ features.T
            found[i : i + _SCAN_ROWS] = self._deepest(distance)
        found[np.isnan(wanted).any(axis=1)] = -1
        rows, places = np.nonzero(found >= 0)
        return rows, self.points[found[rows, places]]

    def _deepest(self, distance: Array) -> Indices:
        """Return the index of the best point in each of the lowest valleys (n, v) of distances (n, p); -1 if none."""
        least = np.minimum.reduceat(distance, self._first, axis=1)
        walls = np.pad(least, ((0, 0), (1, 1)), constant_values=np.inf)
        valley = (least <= walls[:, :-2]) & (least <= walls[:, 2:])
        depth = np.where(valley, least, np.inf)
        order = np.argsort(depth, axis=1)[:, :_MAX_VALLEYS]
        found = np.full((len(distance), _MAX_VALLEYS), -1, dtype=np.intp)
        ends = np.append(self._first[1:], distance.shape[1])
        for row, slices in enumerate(order):
            for place, each in enumerate(slices[np.isfinite(depth[row, slices])]):
                first = self._first[each]
                found[row, place] = first + np.argmin(distance[row, first : ends[each]])
        return found


def nearest_distance(points: Array, queries: Array) -> Array:
    """Return the distance (n,) of queries (n, 3) to the nearest of the points (p, 3); inf without points."""
    if not len(points):
        return np.where(np.isnan(queries[:, 0]), np.nan, np.inf)
    squared = _squared_lengths(points)
    nearest = np.zeros(len(queries), dtype=np.intp)
    for i in range(0, len(queries), _SCAN_ROWS):
        nearest[i : i + _SCAN_ROWS] = np.argmin(squared - 2.0 * queries[i : i + _SCAN_ROWS] @ points.T, axis=1)
    return np.linalg.norm(queries - points[nearest], axis=1)


def _squared_lengths(points: Array) -> Array:
    return np.einsum("pk,pk->p", points, points)
