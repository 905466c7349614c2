"""The kernels of a rig: the functions that evaluate rows of parameters or poses.

Rows are float64 arrays; rows with a value that is not finite, or above 1e9, give NaN.
"""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.evaluator.batching import in_chunks, pairs_in_chunks, usable_rows
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.encoding import Encoder, Handles, distance_residual
from jawusd.evaluator.nearest import Pull, Vector, lowest_in_valley, nearest_in_valley
from jawusd.evaluator.operations import triple
from jawusd.evaluator.solver import Residual, minimise
from jawusd.evaluator.verdicts import RIGID_TOLERANCE, Limits, Verdicts, judge
from jawusd.geometry.se3 import rigidity_defect

_FEW_ROWS = 3  # maximum number of rows that are searched one by one in floats, which is faster for few rows


class NumpyKernels:
    """The kernels of a rig in numpy; subclasses replace some of them with compiled code or graphs."""

    def __init__(self, encoder: Encoder, bound: SliceHull) -> None:
        self._encoder, self._bound = encoder, bound
        self._model, self._frames, self._single = encoder.model, encoder.frames, encoder.model.single

    def pose(self, d1: float, d2: float, d3: float) -> Array:
        """Return T_skull_mandible (4, 4) of one d [mm], finite and below 1e4."""
        return self._frames.pose(self._single.motion(d1, d2, d3))

    def margin(self, d1: float, d2: float, d3: float) -> float:
        """Return the margin [mm] of one d [mm], finite and below 1e4."""
        return -float(self._bound.signed_distance(np.array([(d1, d2, d3)]))[0])

    def poses(self, d: Array) -> Array:
        """Return the poses T_skull_mandible (n, 4, 4) of d (n, 3) [mm]."""
        return in_chunks(lambda d: self._frames.poses(self._model.motion(d)), usable_rows(d))

    def twists(self, d: Array) -> Array:
        """Return the twists (n, 6) log(pose(d) rest^-1), skull frame, of d (n, 3) [mm]."""
        return in_chunks(lambda d: self._model.log(d) @ self._frames.adjoint.T, usable_rows(d))

    def jacobians(self, d: Array) -> Array:
        """Return the derivatives (n, 6, 3) of the twists with respect to d (n, 3) [mm]."""
        return in_chunks(lambda d: self._frames.adjoint @ self._model.log_jacobian(d), usable_rows(d))

    def margins(self, d: Array) -> Array:
        """Return the margins (n,) [mm] of d (n, 3) [mm]."""
        return -in_chunks(self._bound.signed_distance, usable_rows(d))

    def margin_gradients(self, d: Array) -> Array:
        """Return the derivatives (n, 3) of the margins with respect to d (n, 3) [mm]."""
        return -in_chunks(lambda d: self._bound.signed_distance_gradient(d)[1], usable_rows(d))

    def encode(self, T: Array) -> tuple[Array, Array]:
        """Return the d (n, 3) [mm] nearest to poses (n, 4, 4), and the residuals (n,) [mm]; NaN where not rigid."""
        T = usable_rows(T)
        return self.nearest(np.where(_rigid(T)[:, None, None], T, np.nan))

    def nearest(self, T: Array) -> tuple[Array, Array]:
        """Return the d (n, 3) [mm] of the poses nearest to T (n, 4, 4), and the residuals (n,) [mm]; NaN for NaN."""
        return pairs_in_chunks(self._encoder.encode, T)

    def judge_poses(self, T: Array, limits: Limits) -> Verdicts:
        """Return verdicts on poses T_skull_mandible (n, 4, 4); the speed limit is ignored."""
        T = usable_rows(T)
        finite, rigid = np.isfinite(T[:, 0, 0]), _rigid(T)
        d, residual_mm = self.nearest(np.where(rigid[:, None, None], T, np.nan))
        return judge(finite, rigid, residual_mm, self.margins(d), d, limits)

    def judge_parameters(self, d: Array, limits: Limits) -> Verdicts:
        """Return verdicts on d (n, 3) [mm], whose residuals are all 0; the speed limit is ignored."""
        d = usable_rows(d)
        finite = np.isfinite(d[:, 0])
        return judge(finite, np.ones_like(finite), np.where(finite, 0.0, np.nan), self.margins(d), d, limits)

    def approach(self, wanted: Array, start: Array) -> tuple[Array, Array]:
        """Return d (n, 3) [mm] inside the bound nearest to `wanted`, around valid starts, and squared distances."""
        if len(start) <= _FEW_ROWS:
            pairs = zip(wanted.tolist(), start.tolist())
            each = [nearest_in_valley(self._bound.formula, triple(to), triple(x)) for to, x in pairs]
            found = np.array(each).reshape(-1, 3)
            return found, ((found - wanted) ** 2).sum(axis=1)
        identity = np.eye(3)

        def residual(x: Array, rows: Indices) -> tuple[Array, Array]:
            return x - wanted[rows], np.broadcast_to(identity, (len(x), 3, 3))

        return _with_cost(residual, minimise(residual, start, self._bound))

    def solve_ik(self, handles: Handles, targets: Array, start: Array) -> tuple[Array, Array]:
        """Return d (n, 3) [mm] inside the bound that move m handles nearest to targets, and squared distances (n,).

        The targets (n, 3, m) are in the anatomical frame [mm], scaled by the weights of the handles. The results are
        the local minima around the starts (n, 3) [mm] inside the bound.
        """
        residual = distance_residual(self._model.decode_derivative, handles, targets)
        if len(start) != 1:
            return _with_cost(residual, minimise(residual, start, self._bound))

        def pull(x: Vector) -> Pull:
            r, J = residual(np.array([x]), np.zeros(1, dtype=np.intp))
            force, (first, second, third) = triple((-(r[0] @ J[0])).tolist()), (J[0].T @ J[0]).tolist()
            stiffness = (first[0], first[1], first[2], second[1], second[2], third[2])
            return Pull(float(r[0] @ r[0]), force, stiffness, (first[0] + second[1] + third[2]) / 3.0)

        return _with_cost(residual, np.array([lowest_in_valley(self._bound.formula, pull, triple(start[0].tolist()))]))


def _with_cost(residual: Residual, found: Array) -> tuple[Array, Array]:
    r, _ = residual(found, np.arange(len(found)))
    return found, np.einsum("nm,nm->n", r, r)


def _rigid(T: Array) -> Mask:
    """Return which matrices (n, 4, 4), whole rows NaN if unusable, are rigid to `RIGID_TOLERANCE`."""
    known = np.isfinite(T[:, :1, :1])
    return known[:, 0, 0] & (in_chunks(rigidity_defect, np.where(known, T, np.eye(4))) <= RIGID_TOLERANCE)
