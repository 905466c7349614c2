"""Paper Fig. 13: random poses of a model within its bounds, and how far they are from what was captured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.distances import carried
from jawusd.evaluator.polygons import PolygonBound
from jawusd.fitting.alpha_shape import alpha_shape
from jawusd.fitting.metric import MandibleMetric
from jawusd.fitting.slice_hull import fit_slice_hull, valid_box
from jawusd.geometry.arrays import Array

POSES = 1000
BOX, POLYGONS, SLICES = "static: box", "dynamic: two polygons", "dynamic: slice hull"

_BATCH, _BATCHES = 4000, 50  # a bound that fills less than a half percent of its box gives fewer poses


@dataclass(frozen=True, eq=False)
class Bounds:
    """Hold the bounds of one model.

    Attributes:
        box: captured range of each parameter [mm], shape (3, 2).
        polygons: the paper's alpha shapes.
        rings: their outlines in (d1, d2) and (d1, d3) [mm], each ring (n, 2).
        slices: the slice hull.
        slices_box: the box that holds the slice hull [mm], shape (3, 2).
    """

    box: Array
    polygons: PolygonBound
    rings: tuple[tuple[Array, ...], tuple[Array, ...]]
    slices: SliceHull
    slices_box: Array

    @classmethod
    def of(cls, d: Array, alpha: float) -> Bounds:
        """Build the bounds of captured parameters d (N, 3) [mm]; `alpha` as in `FittingConfig`."""
        arrays, rings = {}, []
        for name, axes in (("polygon_d1d2", [0, 1]), ("polygon_d1d3", [0, 2])):
            vertices, counts = alpha_shape(d[:, axes], alpha)
            arrays |= {name: vertices, f"{name}_counts": counts}
            rings.append(tuple(np.split(vertices, np.cumsum(counts)[:-1])))
        hull, _ = fit_slice_hull(d)
        box = np.stack([d.min(0), d.max(0)], axis=1)
        polygons = PolygonBound.from_arrays(arrays)
        return cls(box, polygons, (rings[0], rings[1]), SliceHull.from_arrays(hull), valid_box(hull))

    def draw(self, rng: np.random.Generator) -> dict[str, Array]:
        """Return up to `POSES` parameters (n, 3) [mm] spread evenly over each bound, by its name."""
        return {
            BOX: _spread(self.box, lambda d: np.full(len(d), -1.0), rng),
            POLYGONS: _spread(self.box, self.polygons.excess, rng),
            SLICES: _spread(self.slices_box, self.slices.excess, rng),
        }


def _spread(box: Array, excess: Callable[[Array], Array], rng: np.random.Generator) -> Array:
    kept = np.empty((0, 3))
    for _ in range(_BATCHES):
        d = box[:, 0] + rng.random((_BATCH, 3)) * (box[:, 1] - box[:, 0])
        kept = np.concatenate([kept, d[excess(d) <= 0]])
        if len(kept) >= POSES:
            break
    return kept[:POSES]


def distance_to_nearest(metric: MandibleMetric, motion: Array, captured: Array) -> Array:
    """Return the largest vertex distance to the captured pose for which it is smallest.

    Args:
        metric: the mandible metric.
        motion: poses, shape (n, 4, 4).
        captured: captured poses, shape (N, 4, 4).

    Returns:
        Distances [mm], shape (n,).
    """
    # The rms distance is Euclidean in these columns and never above the largest one, so that only captured poses
    # within the best known largest distance can be nearer.
    at, places = _columns(metric, motion), _columns(metric, captured)
    tree = cKDTree(places)
    guess = tree.query(at)[1]
    best = metric.largest(motion, captured[guess])
    for row, near in enumerate(tree.query_ball_point(at, best)):
        if near:
            best[row] = min(best[row], metric.largest(motion[row], captured[near]).min())
    return best


def captured_reference(metric: MandibleMetric, captured: Array, folds: int) -> Array:
    """Return for each captured pose the distance to the nearest one outside its own contiguous part of the take.

    Args:
        metric: the mandible metric.
        captured: captured poses in the order of time, shape (N, 4, 4).
        folds: number of parts.

    Returns:
        Distances [mm], shape (N,).
    """
    fold = np.arange(len(captured)) * folds // len(captured)
    parts = [distance_to_nearest(metric, captured[fold == k], captured[fold != k]) for k in range(folds)]
    return np.concatenate(parts)


def _columns(metric: MandibleMetric, motion: Array) -> Array:
    return carried(motion[:, :3, :3], motion[:, :3, 3], metric.vectors).reshape(len(motion), -1)
