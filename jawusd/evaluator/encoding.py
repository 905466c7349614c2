"""Encoding: the jaw parameters whose pose is nearest to a measured one, by landmark distance in mm.

The distance between two poses is ``residual_mm = sqrt(mean_k |T l_k - T' l_k|^2)`` over the rig's landmarks l_k. With
their mean c and scatter ``mean (l_k - c)(l_k - c)^T = B B^T`` it is exactly

    residual_mm^2 = |(T - T') (c, 1)|^2 + sum_j |(T - T') (b_j, 0)|^2,

so four homogeneous vectors replace any number of landmarks. Vectors are columns: a point is (p, 1), a direction (b, 0).
Encoding minimises the distance by damped Gauss-Newton with the model's analytic derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array, Indices
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.models import JawModelForm
from jawusd.evaluator.motions import RigFrames
from jawusd.evaluator.solver import Residual, minimise
from jawusd.geometry.se3 import make_transform, se3_inverse, se3_left_jacobian_inverse, se3_log, transform_points
from jawusd.geometry.so3 import hat

# x (k, 3) -> rotations (k, 3, 3), translations (k, 3), spatial derivatives (k, 6, 3)
Derivative = Callable[[Array], tuple[Array, Array, Array]]

# Weight of the depth of a handle along the viewing direction, relative to distances perpendicular to it. The weight
# matters only at the bound: elsewhere, two perpendicular equations and one for the depth determine d.
_DEPTH_WEIGHT = 0.1
_MIN_PRECISION = 1e-12  # minimum precision of d in every direction, relative to the trace of the precision


def landmark_vectors(landmarks: Array) -> Array:
    """Return the four homogeneous vectors (4, 4), one per column, that represent the landmarks (n, 3) [mm]."""
    centre = landmarks.mean(axis=0)
    scatter = (landmarks - centre).T @ (landmarks - centre) / len(landmarks)
    variance, axes = np.linalg.eigh(scatter)
    vectors = np.zeros((4, 4))
    vectors[:3, :3] = axes * np.sqrt(np.maximum(variance, 0.0))
    vectors[:, 3] = [*centre, 1.0]
    return vectors


class Handles(NamedTuple):
    """Points of the mandible that inverse kinematics moves to targets."""

    #: homogeneous points of the mandible at rest, anatomical frame [mm], scaled by their weights, shape (4, m)
    vectors: Array
    #: unit vectors along which distances to the targets do not count, anatomical frame, shape (3, m); 0 for points
    #: whose whole distance counts; None if all are such points
    sight: Array | None = None

    @classmethod
    def of(cls, points: Array, weights: ArrayLike | None, sight: Array) -> Handles:
        """Return handles at points (H, 3) [mm] at rest, anatomical frame; sums of their squares are weighted means.

        Args:
            weights: Weights, shape (H,); None for equal ones.
            sight: Directions along which distances do not count, anatomical frame, shape (H, 3), of any length or 0.

        Raises:
            ValueError: weights of a wrong shape, negative, not finite or all zero.
        """
        share = np.ones(len(points)) if weights is None else np.asarray(weights, dtype=np.float64)
        if share.shape != (len(points),) or not np.isfinite(share).all() or (share < 0).any() or share.sum() == 0:
            raise ValueError(f"weights must be {len(points)} numbers >= 0, not all zero, got {share.tolist()}")
        vectors = np.column_stack([points, np.ones(len(points))]).T * np.sqrt(share / share.sum())
        if not sight.any():
            return cls(vectors)
        length = np.linalg.norm(sight, axis=1, keepdims=True)
        return cls(vectors, (sight / np.where(length > 0, length, 1.0)).T)

    @property
    def depths(self) -> Array:
        """Return rows (m, 3) that map d to weighted offsets of the handles from the habitual path along `sight`."""
        if self.sight is None:
            return np.zeros((0, 3))
        # d2 and d3 displace the incisal point from the habitual path along the anatomical x and z axes
        along = np.stack([np.zeros(self.sight.shape[1]), self.sight[0], self.sight[2]], axis=1)
        return _DEPTH_WEIGHT * self.vectors[3][:, None] * along

    def across(self, values: Array) -> Array:
        """Return vectors (n, 3, m) or their derivatives (n, 3, m, 3) without their components along `sight`."""
        if self.sight is None:
            return values
        along = np.einsum("am,nam...->nm...", self.sight, values)
        return values - np.einsum("am,nm...->nam...", self.sight, along)

    def features(self, images: Array, d: Array) -> Array:
        """Return images (n, 3, m) [mm] without depth and, with `sight`, the depths of d: (n, 3 m) or (n, 4 m)."""
        seen = self.across(images).reshape(len(images), 3 * self.vectors.shape[1])
        return seen if self.sight is None else np.concatenate([seen, d @ self.depths.T], axis=1)


def vector_images(R: Array, t: Array, vectors: Array) -> Array:
    """Apply motions R (n, 3, 3), t (n, 3) [mm] to homogeneous vectors (4, m); return shape (n, 3, m)."""
    return R @ vectors[:3] + t[:, :, None] * vectors[3]


def point_velocities(R: Array, t: Array, S: Array, points: Array) -> Array:
    """Return the derivatives (n, p, 3, 3) by d of points (p, 3) [mm] moved by R (n, 3, 3), t (n, 3), S (n, 6, 3)."""
    image = points @ np.swapaxes(R, 1, 2) + t[:, None]
    return np.cross(S[:, None, :3], image[..., None], axis=2) + S[:, None, 3:]


def distance_residual(derivative: Derivative, handles: Handles, target: Array) -> Residual:
    """Return the residual function that `minimise` needs, for handles and their scaled targets (n, 3, m) [mm]."""
    vectors, count = handles.vectors, handles.vectors.shape[1]

    def residual(x: Array, rows: Indices) -> tuple[Array, Array]:
        R, t, S = derivative(x)
        image = vector_images(R, t, vectors)
        # a vector (b, h) moves by w x image + v h under the spatial velocity (w, v)
        by_velocity = np.zeros((len(x), 3, count, 6))
        by_velocity[:, 0, :, 1], by_velocity[:, 1, :, 0] = image[:, 2], -image[:, 2]
        by_velocity[:, 1, :, 2], by_velocity[:, 2, :, 1] = image[:, 0], -image[:, 0]
        by_velocity[:, 2, :, 0], by_velocity[:, 0, :, 2] = image[:, 1], -image[:, 1]
        for axis in range(3):
            by_velocity[:, axis, :, 3 + axis] = vectors[3]
        r, J = handles.features(image - target[rows], x), by_velocity.reshape(len(x), 3 * count, 6) @ S
        if handles.sight is None:
            return r, J
        seen = handles.across(J.reshape(len(x), 3, count, 3)).reshape(J.shape)
        return r, np.concatenate([seen, np.broadcast_to(handles.depths, (len(x), count, 3))], axis=1)

    return residual


class Encoding(NamedTuple):
    """Result of `JawRig.encode`: d [mm], shape (..., 3), and residual_mm, shape (...)."""

    d: Array
    residual_mm: Array


class WeightedEncoding(NamedTuple):
    """Result of `JawRig.encode` with a covariance."""

    d: Array  # the most likely jaw parameters [mm], shape (..., 3)
    residual_mm: Array  # RMS landmark distance of their pose, shape (...)
    #: covariance of d [mm^2], shape (..., 3, 3), from the noise of the pose and, if known, the error of the rig
    covariance: Array


class Encoder:
    """Encoder of poses for one model and the landmarks (n, 3) [mm] of its rig, mandible frame."""

    def __init__(self, model: JawModelForm, frames: RigFrames, landmarks: Array) -> None:
        self.model, self.frames = model, frames
        # the four homogeneous vectors (4, 4) that represent the landmarks, anatomical frame [mm]
        self.vectors = landmark_vectors(transform_points(frames.T_anatomical_mandible_rest, landmarks))

    def encode(self, T: Array) -> tuple[Array, Array]:
        """Return the d (n, 3) nearest to poses T_skull_mandible (n, 4, 4), and the residuals (n,) [mm]."""
        d = self.model.chart_parameters(nearest_in_chart(self.model, *self.frames.motions(T), self.vectors))
        return d, self.residual_mm(d, T)

    def targets(self, T: Array) -> Array:
        """Apply poses T_skull_mandible (n, 4, 4) to the four vectors; return shape (n, 3, 4), anatomical frame."""
        return vector_images(*self.frames.motions(T), self.vectors)

    def residual_mm(self, d: Array, T: Array) -> Array:
        """Return the landmark distances (n,) [mm] between the poses of d (n, 3) and T (n, 4, 4)."""
        difference = vector_images(*self.model.decode(d), self.vectors) - self.targets(T)
        return np.sqrt(np.einsum("nij,nij->n", difference, difference))

    def most_likely(self, T: Array, whitening: Array, start: Array, bound: SliceHull | None) -> Array:
        """Return the most likely d (n, 3) of noisy poses T (n, 4, 4): minimise ``|W xi|^2``, ``T = exp(xi) pose(d)``.

        ``W^T W`` (n, 6, 6) is the inverse covariance of xi, (omega, v), skull frame. The start (n, 3) [mm] must lie in
        the bound, if given, and d stays inside. NaN gives NaN.
        """
        measured = make_transform(*self.frames.motions(T))
        whitening = whitening @ self.frames.adjoint

        def residual(d: Array, rows: Indices) -> tuple[Array, Array]:
            return self._whitened(d, measured[rows], whitening[rows])

        return minimise(residual, start, bound)

    def covariance(self, d: Array, T: Array, whitening: Array, own: Array) -> Array:
        """Return the covariances (n, 3, 3) [mm^2] of the most likely d (n, 3), disregarding the bound.

        With J the derivative of ``W xi``, the covariance from noise is ``(J^T J)^-1``, and a second error of the pose
        with covariance O (``own``, (omega, v), skull frame, (n, 6, 6)) adds ``G O G^T`` with the gain ``G = (J^T J)^-1
        J^T W`` (Barfoot 2017, section 3.1). The other arguments are those of `most_likely`.
        """
        known = np.isfinite(d).all(axis=1)
        found = np.full((len(d), 3, 3), np.nan)
        measured = make_transform(*self.frames.motions(T[known]))
        _, J = self._whitened(d[known], measured, whitening[known] @ self.frames.adjoint)
        precision = np.swapaxes(J, 1, 2) @ J
        # keeps the variance finite for a parameter that does not move the jaw
        floor = _MIN_PRECISION * np.einsum("nii->n", precision)[:, None, None] * np.eye(3)
        noise = np.linalg.inv(precision + floor)
        gain = noise @ np.swapaxes(J, 1, 2) @ whitening[known]
        found[known] = noise + gain @ own[known] @ np.swapaxes(gain, 1, 2)
        return found

    def _whitened(self, d: Array, measured: Array, W: Array) -> tuple[Array, Array]:
        """Return ``W xi`` (n, 6), ``measured = exp(xi) motion(d)``, and its derivative with respect to d, (n, 6, 3)."""
        R_d, t_d, S = self.model.decode_derivative(d)
        xi = se3_log(measured @ se3_inverse(make_transform(R_d, t_d)))
        # exp(xi(d + e)) = exp(xi) exp(-S e); the right Jacobian is the left Jacobian at -xi
        return np.einsum("nij,nj->ni", W, xi), -W @ se3_left_jacobian_inverse(-xi) @ S


def nearest_in_chart(model: JawModelForm, R: Array, t: Array, vectors: Array) -> Array:
    """Return the chart coordinates (n, 3) whose motions are nearest to motions R (n, 3, 3), t (n, 3) [mm]."""
    residual = distance_residual(model.chart_derivative, Handles(vectors), vector_images(R, t, vectors))
    return minimise(residual, model.chart_start(R, t))


def covariance_of_points(points: Array, sigma_mm: Array) -> Array:
    """Return covariances (n, 6, 6) of twists (omega [rad], v [mm]) that give points (n, p, 3) rms errors (n, p) [mm].

    Where an error is 0, the covariance is 0.
    """
    known = sigma_mm.all(axis=1)
    points, found = points[known], np.zeros((len(points), 6, 6))
    J = np.concatenate([-hat(points), np.broadcast_to(np.eye(3), (*points.shape, 3))], axis=-1)
    precision = np.einsum("npki,npkj,np->nij", J, J, 3.0 / sigma_mm[known] ** 2)
    # the factor p / 2 is needed because points of a rigid body do not measure its pose independently
    found[known] = np.linalg.inv(precision) * sigma_mm.shape[1] / 2.0
    return found


def whitening_of(covariance: Array) -> Array:
    """Return W (n, 6, 6), ``W^T W`` the inverse of covariances, NaN for NaN; raises ValueError for indefinite ones."""
    lost = np.asarray(np.isnan(covariance).any(axis=(1, 2)))
    try:
        factor = np.linalg.cholesky(np.where(lost[:, None, None], np.eye(6), covariance))
    except np.linalg.LinAlgError as error:
        raise ValueError("covariance must be positive definite") from error
    whitening = np.asarray(np.linalg.inv(factor), dtype=np.float64)
    whitening[lost] = np.nan
    return whitening
