"""Encoding: the jaw parameters whose pose is nearest to a measured one, by landmark distance in mm.

The distance between two poses is ``residual_mm = sqrt(mean_k |T l_k - T' l_k|^2)`` over the rig's landmarks l_k. With
their mean c and scatter ``mean (l_k - c)(l_k - c)^T = B B^T`` it is exactly

    residual_mm^2 = |(T - T') (c, 1)|^2 + sum_j |(T - T') (b_j, 0)|^2,

so four vectors carry any number of landmarks. Encoding minimises it by damped Gauss-Newton with the model's analytic
derivatives, from the parameters read off the model itself.
"""

from __future__ import annotations

import numpy as np

from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.distances import carried, distance_residual, landmark_vectors
from jawusd.evaluator.frames import RigFrames
from jawusd.evaluator.models import AnchoredModel, JawModelForm
from jawusd.evaluator.reach import Reach
from jawusd.evaluator.solver import minimise
from jawusd.geometry.arrays import Array, Indices
from jawusd.geometry.se3 import make_transform, se3_inverse, se3_left_jacobian_inverse, se3_log, transform_points


class Encoder:
    """Encode poses with one model.

    Args:
        model: The jaw model.
        frames: Of the rig.
        bound: The valid volume.
        reach: Searches inside it.
        landmarks: Landmarks of the mandible [mm], mandible frame, shape (n, 3).
    """

    def __init__(
        self, model: JawModelForm, frames: RigFrames, bound: SliceHull, reach: Reach, landmarks: Array
    ) -> None:
        self._model, self._frames, self._bound, self._reach = model, frames, bound, reach
        self._vectors = landmark_vectors(transform_points(frames.T_anatomical_mandible_rest, landmarks))

    def encode(self, T: Array, *, bounded: bool) -> tuple[Array, Array]:
        """Return the d (n, 3) nearest to poses T_skull_mandible (n, 4, 4), and the residuals (n,) [mm]."""
        R, t = self._frames.motions(T)
        d = self._nearest(R, t)
        out = np.flatnonzero(self._bound.excess(d) > 0) if bounded else ()
        if len(out):
            d[out] = self._reach.best_pull(self._vectors, carried(R[out], t[out], self._vectors))
        return d, self._residual_mm(d, R, t)

    def encode_weighted(self, T: Array, whitening: Array, *, bounded: bool) -> tuple[Array, Array]:
        """Return the most likely d (n, 3) of noisy poses: the least ``|W xi|^2`` with ``T = exp(xi) pose(d)``.

        Args:
            T: Poses T_skull_mandible, shape (n, 4, 4).
            whitening: W with ``W^T W`` the inverse covariance of xi, (omega, v), skull frame, shape (n, 6, 6).
            bounded: Search only inside the bound.

        Returns:
            d [mm], shape (n, 3), and the residuals [mm], shape (n,).
        """
        R, t = self._frames.motions(T)
        start = self._nearest(R, t)
        start[np.isnan(whitening).any(axis=(1, 2))] = np.nan
        start = self._reach.nearest(start) if bounded else start
        d = self._most_likely(R, t, whitening @ self._frames.adjoint, start, self._bound if bounded else None)
        return d, self._residual_mm(d, R, t)

    def _residual_mm(self, d: Array, R: Array, t: Array) -> Array:
        difference = carried(*self._model.decode(d), self._vectors) - carried(R, t, self._vectors)
        return np.sqrt(np.einsum("nij,nij->n", difference, difference))

    def _nearest(self, R: Array, t: Array) -> Array:
        model, target = self._model, carried(R, t, self._vectors)
        if isinstance(model, AnchoredModel):
            # the nearest pose does not depend on the chart: searching over the incisal displacement spares the gauge
            residual = distance_residual(model.motion_derivative_at, self._vectors, target)
            return model.parameters_at(minimise(residual, model.displacement_of(R, t)))
        residual = distance_residual(model.decode_derivative, self._vectors, target)
        return minimise(residual, model.read_off(R, t))

    def _most_likely(self, R: Array, t: Array, whitening: Array, start: Array, bound: SliceHull | None) -> Array:
        measured = make_transform(R, t)

        def residual(d: Array, rows: Indices) -> tuple[Array, Array]:
            R_d, t_d, S = self._model.decode_derivative(d)
            xi = se3_log(measured[rows] @ se3_inverse(make_transform(R_d, t_d)))
            W = whitening[rows]
            # exp(xi(d + e)) = exp(xi) exp(-S e), and the right Jacobian is the left one at -xi
            return np.einsum("nij,nj->ni", W, xi), -W @ se3_left_jacobian_inverse(-xi) @ S

        return minimise(residual, start, bound)


def whitening_of(covariance: Array) -> Array:
    """Return W (n, 6, 6) with ``W^T W`` the inverse of the covariances (n, 6, 6); NaN for NaN.

    Raises:
        ValueError: a covariance is not positive definite.
    """
    lost = np.isnan(covariance).any(axis=(1, 2))
    try:
        factor = np.linalg.cholesky(np.where(lost[:, None, None], np.eye(6), covariance))
    except np.linalg.LinAlgError as error:
        raise ValueError("covariance must be positive definite") from error
    whitening = np.linalg.inv(factor)
    whitening[lost] = np.nan
    return whitening
