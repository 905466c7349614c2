"""Distances between jaw poses, in mm on the mandible.

Two rigid motions differ at a point x by (R_a - R_b) x + (t_a - t_b), which is affine in x. The mean square over a set
of points therefore depends only on their mean and covariance, and the maximum is reached at a vertex of their convex
hull.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from jawusd.base.arrays import Array
from jawusd.evaluator.encoding import landmark_vectors, nearest_in_chart, vector_images
from jawusd.evaluator.models import JawModelForm
from jawusd.geometry import hat
from jawusd.geometry.so3 import nearest_rotation

_TOGETHER = 32  # number of poses per block, small enough that displacements stay in the CPU cache
_EVERY = 32  # stride through the hull vertices in `largest_at_least`


@dataclass(frozen=True)
class MandibleMetric:
    """Metric of pose differences: the displacement of a set of mandible points."""

    #: four homogeneous columns equivalent to the points, with the mean last (see `evaluator.encoding`), shape (4, 4)
    vectors: Array
    extremes: Array  # vertices of the convex hull of the points [mm], shape (H, 3)

    @classmethod
    def of_points(cls, points: Array) -> MandibleMetric:
        """Build the metric of mandible points at rest (N, 3), N >= 3, anatomical frame [mm]."""
        try:
            extremes = points[ConvexHull(points).vertices]
        except QhullError:  # fewer than four points, or coplanar points
            extremes = points
        return cls(landmark_vectors(points), extremes)

    def rms(self, M: Array, target: Array) -> Array:
        """Return the RMS distance [mm] between the points moved by M (N, 4, 4) and by target (N, 4, 4), shape (N,)."""
        difference = vector_images(*_parts(M), self.vectors) - vector_images(*_parts(target), self.vectors)
        return np.linalg.norm(difference, axis=(1, 2))

    def largest(self, M: Array, target: Array) -> Array:
        """Return the largest distance between any point moved by M (N, 4, 4) and by target [mm], shape (N,)."""
        return _farthest(M - target, self.extremes)

    def largest_at_least(self, M: Array, target: Array) -> Array:
        """Return a fast lower bound of `largest` [mm], shape (N,)."""
        return _farthest(M - target, self.extremes[::_EVERY])

    def nearest(self, model: JawModelForm, target: Array) -> tuple[Array, Array]:
        """Return the parameters (N, 3) [mm] and motions (N, 4, 4) of a model that are nearest to motions (N, 4, 4)."""
        x = nearest_in_chart(model, *_parts(target), self.vectors)
        return model.chart_parameters(x), model.chart_motion(x)

    def best_rotation(self, target: Array, incisor: Array, at: Array) -> Array:
        """Return the rotations (N, 3, 3) that best fit motions (N, 4, 4) with the incisal point fixed (Kabsch 1976).

        The incisal point (3,) at rest is fixed `at` positions (N, 3) [mm].
        """
        R, t = _parts(target)
        mean, root = self.vectors[:3, 3], self.vectors[:3, :3]
        arm = mean - incisor
        second = root @ root.T + np.outer(arm, mean)  # mean of (x - p) x^T
        moments = second @ np.swapaxes(R, 1, 2) + arm[:, None] * (t - at)[:, None, :]
        return np.swapaxes(nearest_rotation(moments), 1, 2)

    def about(self, point: Array) -> Array:
        """Return the inertia about a point: w^T I w = mean squared displacement under a rotation w [mm^2/rad^2]."""
        offset = self.vectors[:3, 3] - point
        second = self.vectors[:3, :3] @ self.vectors[:3, :3].T + np.outer(offset, offset)
        return np.trace(second) * np.eye(3) - second

    def twist_root(self) -> Array:
        """Return L (6, 6) with |L^T xi|^2 = mean squared displacement under a small twist xi at rest [mm^2]."""
        arms = np.concatenate([-hat(self.vectors[:3, :3].T), np.zeros((3, 3, 3))], axis=2)
        J = np.concatenate([arms, velocity_of(self.vectors[:3, 3])[None]])
        return np.linalg.cholesky(np.einsum("nij,nik->jk", J, J))


def _farthest(difference: Array, points: Array) -> Array:
    """Return the largest displacement [mm] (N,) of points (H, 3), given differences of motions (N, 4, 4)."""
    found = np.empty(len(difference))
    for first in range(0, len(found), _TOGETHER):
        D = difference[first : first + _TOGETHER]
        x, y, z = np.moveaxis(D[:, :3, :3] @ points.T + D[:, :3, 3:], 1, 0)
        found[first : first + _TOGETHER] = np.sqrt((x * x + y * y + z * z).max(-1))
    return found


def velocity_of(point: Array) -> Array:
    """Return the matrix (3, 6) that maps a twist (omega, v) to the velocity of a point [mm]."""
    return np.concatenate([-hat(point), np.eye(3)], axis=1)


def _parts(M: Array) -> tuple[Array, Array]:
    return M[:, :3, :3], M[:, :3, 3]
