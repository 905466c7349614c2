"""The runtime rig: jaw parameters to poses of the mandible and back, bounds, verdicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import overload

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array, Indices
from jawusd.base.errors import AnyPath, EvaluatorError, FormatError
from jawusd.base.npz import read_npz, upgraded_model
from jawusd.evaluator.authoring import RigAuthoring
from jawusd.evaluator.batching import as_floats, as_points, as_rows, in_chunks, pairs_in_chunks, rows_of
from jawusd.evaluator.bounds import PolygonBound, SliceHull
from jawusd.evaluator.contact import ContactField
from jawusd.evaluator.encoding import (
    Encoder,
    Encoding,
    Handles,
    WeightedEncoding,
    covariance_of_points,
    point_velocities,
    vector_images,
    whitening_of,
)
from jawusd.evaluator.judging import SINGLE_LIMIT_MM, RigJudging
from jawusd.evaluator.kernels import NumpyKernels
from jawusd.evaluator.models import FORMS
from jawusd.evaluator.motions import RigFrames
from jawusd.evaluator.search import BoundedSearch, IkResult
from jawusd.evaluator.speeds import Speeds
from jawusd.evaluator.verdicts import Limits
from jawusd.geometry.se3 import transform_points

FAMILY, VERSION = "jawusd-model", 2


class JawRig(RigJudging, RigAuthoring):
    """One subject's jaw: pure functions from d = (opening, laterotrusion, protrusion) [mm] to poses and back.

    ``pose(d) = A^-1 M(d) A rest`` with A = T_anatomical_skull and rest = T_skull_mandible of the closed bite;
    ``twist(d) = log(pose(d) rest^-1)``, skull frame, (omega [rad], v [mm]). Every function accepts any leading batch
    shape, and computes in float64. A row with a NaN or infinity gives NaN. Rigs are immutable and can be shared between
    threads and processes, and pickled.

    Attributes:
        model: The function from d to motions.
        bound: The slice bound.
        polygons: The paper's bound.
        speeds: How fast the jaw moved in the take; None if unknown.
        limits: The rig's thresholds of `validate`, for measured poses.
        kernels: The implementation that evaluates rows.
    """

    def __init__(
        self,
        arrays: Mapping[str, ArrayLike],
        meta: Mapping[str, object],
        *,
        kernels: Callable[[Encoder, SliceHull], NumpyKernels] = NumpyKernels,
    ) -> None:
        """Build the rig from the named arrays of a model of format jawusd-model/2 and its header; others are ignored.

        ``meta["kind"]`` is "anchored" or "additive". `kernels` evaluates rows; `jawusd.fast` has a compiled
        implementation.

        Raises:
            EvaluatorError: an unknown kind, or an array missing, of a wrong shape, not finite or out of range.
        """
        super().__init__(arrays, meta)
        self.model = FORMS[self.kind](self.arrays)
        self.bound = SliceHull(self.arrays)
        self.polygons = PolygonBound(self.arrays)
        self.contact = ContactField.from_arrays(self.arrays, "teeth")
        self.joints = ContactField.from_arrays(self.arrays, "condyles")
        self.speeds = Speeds.from_arrays(self.arrays)
        self.limits = Limits(float(self.arrays["residual_limit_mm"]), self.tolerance_mm)
        self._frames = RigFrames(self.T_anatomical_skull, self.T_rest, self.model.single.anchor)
        self._encoder = Encoder(self.model, self._frames, self.landmarks)
        self._make_kernels, self.kernels = kernels, kernels(self._encoder, self.bound)
        self._search = BoundedSearch(self.model, self.bound, self.kernels)

    def __reduce__(self) -> tuple[object, ...]:
        arrays = {name: np.array(value) for name, value in self.arrays.items()}
        return partial(JawRig, kernels=self._make_kernels), (arrays, self.meta)

    def pose(self, d: ArrayLike) -> Array:
        """Return the poses T_skull_mandible (..., 4, 4) for jaw parameters d (..., 3) [mm]."""
        d = as_floats(d, "d")
        if d.shape == (3,):
            d1, d2, d3 = d.tolist()
            if abs(d1) + abs(d2) + abs(d3) < SINGLE_LIMIT_MM:  # comparisons with NaN are false
                return self.kernels.pose(d1, d2, d3)
        rows, batch = rows_of(d, (3,), "d")
        return self.kernels.poses(rows).reshape(*batch, 4, 4)

    def twist(self, d: ArrayLike) -> Array:
        """Return the twists (omega [rad], v [mm]) log(pose(d) rest^-1), skull frame, (..., 6), of d (..., 3) [mm]."""
        rows, batch = rows_of(d, (3,), "d")
        return self.kernels.twists(rows).reshape(*batch, 6)

    def jacobian(self, d: ArrayLike) -> Array:
        """Return the derivative (..., 6, 3) of `twist` with respect to d (..., 3) [mm], in rad/mm and mm/mm."""
        rows, batch = rows_of(d, (3,), "d")
        return self.kernels.jacobians(rows).reshape(*batch, 6, 3)

    def spatial_jacobian(self, d: ArrayLike) -> Array:
        """Return the spatial velocities (omega [rad/mm], v [mm/mm]) per unit of d1, d2, d3, skull frame, (..., 6, 3).

        They are the left twists from the poses of d (..., 3) [mm] to those of adjacent parameters (Barfoot 2017,
        section 7.1.5).
        """
        rows, batch = as_rows(d, (3,), "d")
        spatial = in_chunks(lambda d: self._frames.adjoint @ self.model.decode_derivative(d)[2], rows)
        return spatial.reshape(*batch, 6, 3)

    def point_jacobian(self, d: ArrayLike, p_mandible: ArrayLike) -> Array:
        """Return the derivative with respect to d of the positions of mandible points in the skull frame.

        Args:
            d: Jaw parameters [mm], shape (..., 3).
            p_mandible: Points [mm], mandible frame, shape (3,) or (P, 3).

        Returns:
            Jacobians [mm/mm], shape (..., 3, 3), or (..., P, 3, 3) for (P, 3) points.
        """
        rows, batch = as_rows(d, (3,), "d")
        points = as_points(p_mandible, "p_mandible")
        at_rest = transform_points(self._frames.T_anatomical_mandible_rest, points.reshape(-1, 3))

        def derivative(d: Array) -> Array:
            velocities = point_velocities(*self.model.decode_derivative(d), at_rest)
            return self._frames.T_skull_anatomical[:3, :3] @ velocities

        return in_chunks(derivative, rows).reshape(*batch, *points.shape, 3)

    def pose_covariance(self, d: ArrayLike) -> Array:
        """Return the covariance (..., 6, 6) of the rig's own error at jaw parameters d (..., 3) [mm].

        The error is xi = (omega [rad], v [mm]) in the skull frame, with ``T_true = exp(xi) pose(d)``. Its covariance
        reproduces `landmark_sigma_mm`; it is 0 if these are unknown.
        """
        rows, batch = as_rows(d, (3,), "d")
        points = transform_points(self.kernels.poses(rows), self.landmarks[None])
        return covariance_of_points(points, self.landmark_sigma_mm(rows)).reshape(*batch, 6, 6)

    def parameter_covariance(self, d: ArrayLike) -> Array:
        """Return the covariance (..., 3, 3) [mm^2] of d (..., 3) [mm] that follows from the rig's own error.

        It is 0 if the error is unknown.
        """
        rows, batch = as_rows(d, (3,), "d")
        found, own = np.zeros((len(rows), 3, 3)), self.pose_covariance(rows)
        known = own.any(axis=(1, 2))
        none = np.zeros((int(known.sum()), 6, 6))
        poses = self.kernels.poses(rows[known])
        found[known] = self._encoder.covariance(rows[known], poses, whitening_of(own[known]), none)
        return found.reshape(*batch, 3, 3)

    @overload
    def encode(self, T_skull_mandible: ArrayLike, *, inside: bool = False, covariance: None = None) -> Encoding: ...

    @overload
    def encode(
        self, T_skull_mandible: ArrayLike, *, inside: bool = False, covariance: ArrayLike
    ) -> WeightedEncoding: ...

    def encode(
        self, T_skull_mandible: ArrayLike, *, inside: bool = False, covariance: ArrayLike | None = None
    ) -> Encoding | WeightedEncoding:
        """Return the jaw parameters whose pose is nearest to each given one.

        The distance is ``residual_mm``, the rms distance of the rig's landmarks between the two poses.

        Args:
            T_skull_mandible: Poses, shape (..., 4, 4). If a matrix is slightly non-rigid, the landmark positions it
                yields are matched; matrices that are not rigid to 1e-3 give NaN.
            inside: Search only inside the bound.
            covariance: Covariance of the noise of the poses, shape (..., 6, 6) or (6, 6); the noise is xi = (omega
                [rad], v [mm]) in the skull frame, with ``T_true = exp(xi) T``. If given, the result is the most likely
                instead of the nearest parameters, with their covariance, which disregards the bound.

        Raises:
            ValueError: wrong shapes, or a covariance that is not positive definite.
        """
        if covariance is not None:
            return self._encode_weighted(T_skull_mandible, covariance, inside)
        rows, batch = rows_of(T_skull_mandible, (4, 4), "T_skull_mandible")
        d, residual_mm = self.kernels.encode(rows)
        if not batch and not inside:
            return Encoding(d[0], residual_mm[0])
        if inside and (out := np.flatnonzero(self.kernels.margins(d) < 0)).size:
            held, targets = Handles(self._encoder.vectors), self._encoder.targets(rows[out])
            d[out] = in_chunks(lambda target: self._search.solve_ik_multistart(held, target)[0], targets)
            residual_mm[out] = in_chunks(lambda i: self._encoder.residual_mm(d[i], rows[i]), out)
        return Encoding(d.reshape(*batch, 3), residual_mm.reshape(batch))

    def _encode_weighted(self, T_skull_mandible: ArrayLike, covariance: ArrayLike, inside: bool) -> WeightedEncoding:
        rows, batch = as_rows(T_skull_mandible, (4, 4), "T_skull_mandible")
        spread = np.broadcast_to(as_floats(covariance, "covariance"), (*batch, 6, 6))
        whitening = whitening_of(as_rows(spread, (6, 6), "covariance")[0])
        start, _ = self.kernels.encode(rows)
        start[np.isnan(whitening).any(axis=(1, 2))] = np.nan

        def encode(i: Indices) -> tuple[Array, Array]:
            first = self._search.nearest(start[i]) if inside else start[i]
            d = self._encoder.most_likely(rows[i], whitening[i], first, self.bound if inside else None)
            return d, self._encoder.residual_mm(d, rows[i])

        each = np.arange(len(rows))
        d, residual_mm = pairs_in_chunks(encode, each)
        own = self.pose_covariance(d)
        of_d = in_chunks(lambda i: self._encoder.covariance(d[i], rows[i], whitening[i], own[i]), each)
        return WeightedEncoding(d.reshape(*batch, 3), residual_mm.reshape(batch), of_d.reshape(*batch, 3, 3))

    def margin_gradient(self, d: ArrayLike) -> Array:
        """Return the derivative of `margin` (slice bound) with respect to d [mm/mm], shape (..., 3), for d (..., 3)."""
        rows, batch = rows_of(d, (3,), "d")
        return self.kernels.margin_gradients(rows).reshape(*batch, 3)

    def project(self, d: ArrayLike) -> Array:
        """Return the nearest valid jaw parameters: d itself inside the bound, otherwise the nearest with margin >= 0.

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            Valid jaw parameters [mm], shape (..., 3); nearest in the Euclidean sense in d.

        Raises:
            EvaluatorError: the bound of the rig is empty.
        """
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(self._search.nearest, rows).reshape(*batch, 3)

    def ik(
        self,
        p_mandible: ArrayLike,
        p_skull: ArrayLike,
        start: ArrayLike | None = None,
        *,
        weights: ArrayLike | None = None,
        sight: ArrayLike | None = None,
    ) -> IkResult:
        """Return the valid jaw parameters that bring points of the mandible nearest to targets (Yang et al. eq. 10).

        Args:
            p_mandible: One handle (3,) or several (H, 3) [mm], mandible frame.
            p_skull: Targets [mm], skull frame, shape (..., 3) for one handle, (..., H, 3) for several.
            start: Initial d [mm], shape (..., 3). While dragging, pass the last result, so that the jaw moves without
                jumps. A start outside the bound is first projected. Default: the best of many points spread over the
                valid volume.
            weights: Weights of the handles, shape (H,), >= 0 and not all zero; default: equal.
            sight: Directions along which distances do not count, skull frame, of the shape of p_mandible; 0 for handles
                whose whole distance counts. Along these directions, the jaw follows the habitual path: in a frontal
                view d3 becomes 0, in a lateral view d2. Vertical directions leave the opening undetermined.

        Returns:
            d, always inside the bound, and the weighted rms distance between handles and targets, perpendicular to
            `sight`.

        Raises:
            ValueError: wrong shapes or weights, or a sight that is not finite.
            EvaluatorError: the bound of the rig is empty.
        """
        handles = as_points(p_mandible, "p_mandible")
        at_rest = transform_points(self._frames.T_anatomical_mandible_rest, handles.reshape(-1, 3))
        look = np.zeros_like(handles) if sight is None else as_points(sight, "sight")
        if look.shape != handles.shape:
            raise ValueError(f"sight must have the shape of p_mandible, {handles.shape}, got {look.shape}")
        held = Handles.of(at_rest, weights, look.reshape(-1, 3) @ self._frames.T_anatomical_skull[:3, :3].T)
        vectors = held.vectors
        targets, batch = as_rows(p_skull, handles.shape, "p_skull")
        targets = targets.reshape(len(targets), vectors.shape[1], 3)
        scaled = np.swapaxes(transform_points(self._frames.T_anatomical_skull, targets), 1, 2) * vectors[3]
        if start is None:
            d = in_chunks(lambda target: self._search.solve_ik_multistart(held, target)[0], scaled)
        else:
            given, _ = as_rows(np.broadcast_to(as_floats(start, "start"), (*batch, 3)), (3,), "start")
            first = in_chunks(self._search.nearest, given)
            each = np.arange(len(scaled))
            d = in_chunks(lambda i: self._search.solve_ik(held, scaled[i], first[i]), each)
        left = held.across(vector_images(*self.model.decode(d), vectors) - scaled)
        distance_mm = np.sqrt(np.einsum("nij,nij->n", left, left))
        return IkResult(d.reshape(*batch, 3), distance_mm.reshape(batch))


def load(path: AnyPath) -> JawRig:
    """Read a rig from a ``model.npz`` of format jawusd-model/2, as `jawusd fit` writes it.

    Raises:
        FormatError: another kind of file, a corrupt file, or arrays missing, of a wrong shape or not finite.
        VersionError: written by a newer version of jawusd.
        UnitsError: lengths, angles or twists in another convention.
    """
    arrays, meta = read_npz(path, FAMILY, VERSION)
    arrays = upgraded_model(arrays, path)
    try:
        return JawRig(arrays, meta)
    except EvaluatorError as error:
        raise FormatError(error.message, path=path, hint="Fit the model again, or restore a good copy.") from error
