"""Paper Fig. 13: random poses of a model within its bounds, and their distances from the captured poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array
from jawusd.evaluator.bounds import PolygonBound, SliceHull
from jawusd.evaluator.encoding import vector_images
from jawusd.fitting.bounds import PLANES, alpha_shapes, fit_slice_hull, valid_box
from jawusd.fitting.metric import MandibleMetric

POSES = 1000
BOX, POLYGONS, SLICES = "static: box", "dynamic: two polygons", "dynamic: slice hull"

# Size and number of batches; bounds that fill less than 0.5 % of their box give fewer than `POSES` poses.
_BATCH, _BATCHES = 4000, 50


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of one model's parameters."""

    box: Array  # captured range of each parameter [mm], shape (3, 2)
    polygons: PolygonBound  # alpha shapes as in the paper
    rings: tuple[tuple[Array, ...], tuple[Array, ...]]  # rings of `polygons` in (d1, d2) and (d1, d3) [mm], each (n, 2)
    slices: SliceHull  # the slice hull
    slices_box: Array  # bounding box of the slice hull [mm], shape (3, 2)

    @classmethod
    def of(cls, d: Array, alpha: float) -> Bounds:
        """Build the bounds of captured parameters d (N, 3) [mm]; `alpha` as in `FittingConfig`."""
        shapes = alpha_shapes(d, alpha)
        lateral, protrusive = (tuple(np.split(shapes[name], shapes[f"{name}_counts"].cumsum()[:-1])) for name in PLANES)
        hull, _ = fit_slice_hull(d)
        box = np.stack([d.min(0), d.max(0)], axis=1)
        polygons = PolygonBound.from_arrays(shapes)
        return cls(box, polygons, (lateral, protrusive), SliceHull.from_arrays(hull), valid_box(hull))

    def draw(self, rng: np.random.Generator) -> dict[str, Array]:
        """Return up to `POSES` uniformly distributed parameters (n, 3) [mm] within each bound, keyed by its name."""
        return {
            BOX: _spread(self.box, lambda d: np.full(len(d), -1.0), rng),
            POLYGONS: _spread(self.box, self.polygons.signed_distance, rng),
            SLICES: _spread(self.slices_box, self.slices.signed_distance, rng),
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
    """Return the largest vertex distance (n,) [mm] of motions (n, 4, 4) to the nearest captured motion (N, 4, 4)."""
    # The rms distance is Euclidean in these columns and never exceeds the largest vertex distance, so only captured
    # poses whose rms distance is below the best largest distance so far can be nearer.
    at, places = _columns(metric, motion), _columns(metric, captured)
    tree = cKDTree(places)
    guess = tree.query(at)[1]
    best = metric.largest(motion, captured[guess])
    for row, found in enumerate(tree.query_ball_point(at, best)):
        near = captured[found]
        near = near[metric.largest_at_least(motion[row], near) <= best[row]]
        best[row] = metric.largest(motion[row], near).min(initial=best[row])
    return best


def captured_reference(metric: MandibleMetric, captured: Array, folds: int) -> Array:
    """Return the distance [mm] of each captured motion (N, 4, 4) to the nearest motion in another part of the take.

    The motions are in temporal order; the take is split into `folds` contiguous parts.
    """
    fold = np.arange(len(captured)) * folds // len(captured)
    parts = [distance_to_nearest(metric, captured[fold == k], captured[fold != k]) for k in range(folds)]
    return np.concatenate(parts)


def _columns(metric: MandibleMetric, motion: Array) -> Array:
    return vector_images(motion[:, :3, :3], motion[:, :3, 3], metric.vectors).reshape(len(motion), -1)
