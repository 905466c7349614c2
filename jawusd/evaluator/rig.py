"""The runtime rig: jaw parameters to poses of the mandible and back, bounds, verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from jawusd.evaluator import sections
from jawusd.evaluator.arrays import checked_arrays
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.distances import carried, handle_vectors
from jawusd.evaluator.encoding import Encoder, whitening_of
from jawusd.evaluator.frames import RigFrames
from jawusd.evaluator.interpolation import interpolate_linear, interpolate_smooth
from jawusd.evaluator.models import model_from_arrays
from jawusd.evaluator.polygons import PolygonBound
from jawusd.evaluator.reach import Reach, nearest_distance
from jawusd.evaluator.rows import as_keys, as_points, as_rows, in_chunks
from jawusd.evaluator.verdicts import RIGID_TOLERANCE, Limits, Verdicts, judge, too_fast
from jawusd.geometry.arrays import Array
from jawusd.geometry.se3 import rigidity_defect, transform_points

BoundName = Literal["slices", "polygons"]

_SINGLE_LIMIT_MM = 1e4  # beyond, the float path might raise where the array path gives infinities


class JawRig:
    """One person's jaw: pure functions from d = (opening, laterotrusion, protrusion) [mm] to poses and back.

    ``pose(d) = A^-1 M(d) A rest`` with A = T_anatomical_skull and rest = T_skull_mandible of the closed bite;
    ``twist(d) = log(pose(d) rest^-1)``, skull frame, (omega [rad], v [mm]).

    Every function takes any batch shape in front of the axes it names, float32 or float64, and computes in float64. A
    row with a NaN or infinity gives NaN. Rigs have no state: share them between threads, pickle them, fork.

    Attributes:
        arrays: The named arrays the rig was made from, read-only.
        meta: The header that came with them.
        limits: Thresholds of `validate` stored in the rig.
    """

    def __init__(self, arrays: Mapping[str, ArrayLike], meta: Mapping[str, Any]) -> None:
        """Build the rig.

        Args:
            arrays: Named arrays of a model of format jawusd-model/1; others are left out.
            meta: Its header; ``meta["kind"]`` is "anchored" or "additive".

        Raises:
            EvaluatorError: an unknown kind, or an array missing, of a wrong shape, not finite or out of range.
        """
        self.meta = dict(meta)
        self.arrays = checked_arrays(arrays, str(meta.get("kind")))
        self.model = model_from_arrays(self.arrays)
        self.bound = SliceHull.from_arrays(self.arrays)
        self.polygons = PolygonBound.from_arrays(self.arrays)
        self._opening_mm = float(self.arrays["d_range"][0, 1])
        self.limits = Limits(float(self.arrays["residual_limit_mm"]), float(self.arrays["margin_limit_mm"]))
        self._frames = RigFrames(self.arrays["T_anatomical_skull"], self.arrays["T_rest"], self.model.single.anchor)
        self._reach = Reach(self.model, self.bound)
        self._encoder = Encoder(self.model, self._frames, self.bound, self._reach, self.arrays["landmarks"])

    def __reduce__(self) -> tuple:
        return (JawRig, ({name: np.array(value) for name, value in self.arrays.items()}, self.meta))

    def pose(self, d: ArrayLike) -> Array:
        """Return the pose T_skull_mandible for jaw parameters d.

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            Poses, shape (..., 4, 4).
        """
        d = np.asarray(d, dtype=np.float64)
        if d.shape == (3,):
            d1, d2, d3 = d.tolist()
            if abs(d1) + abs(d2) + abs(d3) < _SINGLE_LIMIT_MM:  # False for NaN
                return self._frames.pose(self.model.single.motion(d1, d2, d3))
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(self._poses, rows).reshape(*batch, 4, 4)

    def _poses(self, d: Array) -> Array:
        return self._frames.poses(self.model.motion(d))

    def twist(self, d: ArrayLike) -> Array:
        """Return the twist log(pose(d) rest^-1) in the skull frame.

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            Twists (omega [rad], v [mm]), shape (..., 6).
        """
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(lambda d: self.model.log(d) @ self._frames.adjoint.T, rows).reshape(*batch, 6)

    def jacobian(self, d: ArrayLike) -> Array:
        """Return the derivative of `twist` by d.

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            Jacobians, [rad/mm] in the rows of omega, [mm/mm] in those of v, shape (..., 6, 3).
        """
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(lambda d: self._frames.adjoint @ self.model.log_jacobian(d), rows).reshape(*batch, 6, 3)

    def point_jacobian(self, d: ArrayLike, p_mandible: ArrayLike) -> Array:
        """Return the derivative by d of where points of the mandible are in the skull frame.

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
            R, t, S = self.model.decode_derivative(d)
            image = at_rest @ np.swapaxes(R, 1, 2) + t[:, None]
            moved = np.cross(S[:, None, :3], image[..., None], axis=2) + S[:, None, 3:]
            return self._frames.T_skull_anatomical[:3, :3] @ moved

        return in_chunks(derivative, rows).reshape(*batch, *points.shape, 3)

    def encode(
        self, T_skull_mandible: ArrayLike, *, bounds: bool = False, covariance: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Return the jaw parameters whose pose is nearest to each given one.

        Nearest by ``residual_mm``, the root of the mean squared distance of the rig's landmarks between the two poses.

        Args:
            T_skull_mandible: Poses, shape (..., 4, 4).
            bounds: Search only inside the bound.
            covariance: If given, return the most likely instead of the nearest parameters of noisy poses: covariance
                of xi, (omega [rad], v [mm]) in the skull frame, with ``T_true = exp(xi) T``, shape (..., 6, 6) or
                (6, 6).

        Returns:
            d [mm], shape (..., 3), and residual_mm, shape (...). Of a matrix that is not quite rigid, the images of
            the landmarks are what is matched.

        Raises:
            ValueError: wrong shapes, or a covariance that is not positive definite.
        """
        rows, batch = as_rows(T_skull_mandible, (4, 4), "T_skull_mandible")
        if covariance is None:
            d, residual_mm = in_chunks(partial(self._encoder.encode, bounded=bounds), rows)
        else:
            spread = np.broadcast_to(np.asarray(covariance, dtype=np.float64), (*batch, 6, 6))
            whitening = whitening_of(as_rows(spread, (6, 6), "covariance")[0])
            d, residual_mm = in_chunks(partial(self._encoder.encode_weighted, bounded=bounds), rows, whitening)
        return d.reshape(*batch, 3), residual_mm.reshape(batch)

    def margin(self, d: ArrayLike, *, bound: BoundName = "slices") -> Array:
        """Return the signed distance of d to the bound [mm]: positive inside, finite and smooth outside.

        Args:
            d: Jaw parameters [mm], shape (..., 3).
            bound: "slices", the joint bound, or "polygons", the paper's two outlines in (d1, d2) and (d1, d3), whose
                margin is continuous but not smooth.

        Returns:
            Margins [mm], shape (...).
        """
        rows, batch = as_rows(d, (3,), "d")
        return -in_chunks(self._bound(bound).excess, rows).reshape(batch)

    def _bound(self, name: BoundName) -> SliceHull | PolygonBound:
        if name not in ("slices", "polygons"):
            raise ValueError(f'bound must be "slices" or "polygons", got {name!r}')
        return self.bound if name == "slices" else self.polygons

    def margin_gradient(self, d: ArrayLike) -> Array:
        """Return the derivative of `margin` (slice bound) by d [mm/mm], shape (..., 3), for d (..., 3) [mm]."""
        rows, batch = as_rows(d, (3,), "d")
        return -in_chunks(lambda d: self.bound.excess_gradient(d)[1], rows).reshape(*batch, 3)

    def project(self, d: ArrayLike) -> Array:
        """Return the nearest valid jaw parameters: d itself inside the bound, else the nearest point with margin >= 0.

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            Valid jaw parameters [mm], shape (..., 3); nearest in the Euclidean sense in d.

        Raises:
            EvaluatorError: the bound of the rig is empty.
        """
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(self._reach.nearest, rows).reshape(*batch, 3)

    def validate(
        self,
        T_skull_mandible: ArrayLike,
        *,
        residual_limit_mm: float | None = None,
        margin_limit_mm: float | None = None,
        bound: BoundName = "slices",
        times_s: ArrayLike | None = None,
        speed_limit_mm_s: float | None = None,
    ) -> Verdicts:
        """Judge poses: finite, rigid, on the model, inside the bound, and reachable in time.

        Args:
            T_skull_mandible: Poses, shape (..., 4, 4).
            residual_limit_mm: Largest landmark distance to the model; the rig's own if None.
            margin_limit_mm: Smallest margin; the rig's own if None.
            bound: Which bound, see `margin`.
            times_s: Times of the poses along the last batch axis, shape (F,); needed for a speed limit.
            speed_limit_mm_s: Largest speed of a landmark between consecutive poses; None asks no question.

        Returns:
            Verdicts of the batch shape.

        Raises:
            ValueError: wrong shapes, or a speed limit without rising times.
        """
        rows, batch = as_rows(T_skull_mandible, (4, 4), "T_skull_mandible")
        finite = np.isfinite(rows).all(axis=(1, 2))
        rigid = in_chunks(rigidity_defect, np.where(finite[:, None, None], rows, np.eye(4))) <= RIGID_TOLERANCE
        rows = np.where((finite & rigid)[:, None, None], rows, np.nan)
        d, residual_mm = in_chunks(partial(self._encoder.encode, bounded=False), rows)
        limits = self.limits.replaced(residual_limit_mm, margin_limit_mm, speed_limit_mm_s)
        verdicts = judge(finite, rigid, residual_mm, self.margin(d, bound=bound), d, limits)
        return self._with_speed(verdicts, rows, batch, times_s, limits)

    def validate_parameters(
        self,
        d: ArrayLike,
        *,
        margin_limit_mm: float | None = None,
        bound: BoundName = "slices",
        times_s: ArrayLike | None = None,
        speed_limit_mm_s: float | None = None,
    ) -> Verdicts:
        """Judge jaw parameters d (..., 3) [mm] as `validate` does poses; the residual is 0.

        Args:
            d: Jaw parameters [mm], shape (..., 3).
            margin_limit_mm: Smallest margin; the rig's own if None.
            bound: Which bound, see `margin`.
            times_s: Times along the last batch axis, shape (F,); needed for a speed limit.
            speed_limit_mm_s: Largest speed of a landmark; None asks no question.

        Raises:
            ValueError: wrong shapes, or a speed limit without rising times.
        """
        rows, batch = as_rows(d, (3,), "d")
        finite = np.isfinite(rows[:, 0])
        limits = self.limits.replaced(None, margin_limit_mm, speed_limit_mm_s)
        residual_mm = np.where(finite, 0.0, np.nan)
        verdicts = judge(finite, np.ones_like(finite), residual_mm, self.margin(rows, bound=bound), rows, limits)
        poses = None if speed_limit_mm_s is None else in_chunks(self._poses, rows)
        return self._with_speed(verdicts, poses, batch, times_s, limits)

    def _with_speed(
        self, verdicts: Verdicts, poses: Array | None, batch: tuple[int, ...], times_s: ArrayLike | None, limits: Limits
    ) -> Verdicts:
        """Return the verdicts in batch shape, frames reached too fast marked if there is a speed limit."""
        fast = np.zeros(batch, dtype=bool)
        if limits.speed_mm_s is not None:
            positions = transform_points(poses, self.arrays["landmarks"]).reshape(*batch, -1, 3)
            fast = too_fast(positions, times_s, limits.speed_mm_s)
        return verdicts.finished(batch, fast)

    def ik(
        self,
        p_mandible: ArrayLike,
        p_skull: ArrayLike,
        start: ArrayLike | None = None,
        *,
        weights: ArrayLike | None = None,
    ) -> tuple[Array, Array]:
        """Return the valid jaw parameters that bring points of the mandible nearest to targets (Yang et al. eq. 10).

        Args:
            p_mandible: One handle (3,) or several (H, 3) [mm], mandible frame.
            p_skull: Targets [mm], skull frame, shape (..., 3) for one handle, (..., H, 3) for several.
            start: Where to start, d [mm], shape (..., 3); while dragging, the last result, so that the jaw moves on
                without jumps. A start outside the bound is first brought inside. If None, the best of a scan of the
                whole valid volume.
            weights: Of the handles, shape (H,), >= 0 and not all zero; equal if None.

        Returns:
            d [mm], shape (..., 3), never outside the bound, and the root of the weighted mean squared distance [mm]
            left between handles and targets, shape (...).

        Raises:
            ValueError: wrong shapes or weights.
            EvaluatorError: the bound of the rig is empty.
        """
        handles = as_points(p_mandible, "p_mandible")
        vectors = handle_vectors(
            transform_points(self._frames.T_anatomical_mandible_rest, handles.reshape(-1, 3)), weights
        )
        targets, batch = as_rows(p_skull, handles.shape, "p_skull")
        targets = targets.reshape(len(targets), vectors.shape[1], 3)
        scaled = np.swapaxes(transform_points(self._frames.T_anatomical_skull, targets), 1, 2) * vectors[3]
        if start is None:
            d = in_chunks(lambda target: self._reach.best_pull(vectors, target), scaled)
        else:
            given, _ = as_rows(np.broadcast_to(np.asarray(start, float), (*batch, 3)), (3,), "start")
            first = in_chunks(self._reach.nearest, given)
            d = in_chunks(lambda target, d: self._reach.pull(vectors, target, d), scaled, first)
        left = carried(*self.model.decode(d), vectors) - scaled
        return d.reshape(*batch, 3), np.sqrt(np.einsum("nij,nij->n", left, left)).reshape(batch)

    def interpolate(
        self,
        frames: ArrayLike,
        d_keys: ArrayLike,
        at: ArrayLike,
        method: Literal["linear", "smooth"] = "linear",
    ) -> Array:
        """Return jaw parameters between keys.

        Args:
            frames: Times of the keys, rising, shape (K,).
            d_keys: Jaw parameters [mm] at the keys, shape (K, 3).
            at: Times wanted, any shape; outside the keys the nearest key holds.
            method: "linear", straight lines in d as in the paper, or "smooth", a C1 curve that stays inside the bound
                between keys that are inside.

        Returns:
            Jaw parameters [mm], shape (*at.shape, 3).

        Raises:
            ValueError: wrong shapes, keys that are not finite or frames that do not rise, or an unknown method.
        """
        frames, keys = as_keys(frames, d_keys)
        times, batch = as_rows(np.asarray(at, dtype=np.float64)[..., None], (1,), "at")
        if method == "linear":
            d = interpolate_linear(frames, keys, times[:, 0])
        elif method == "smooth":
            d = interpolate_smooth(frames, keys, times[:, 0], self.bound)
        else:
            raise ValueError(f'method must be "linear" or "smooth", got {method!r}')
        return d.reshape(*batch, 3)

    def ranges(self, d1: ArrayLike, d2: ArrayLike = 0.0, d3: ArrayLike = 0.0) -> tuple[Array, Array, Array, Array]:
        """Return how far d2 and d3 can each go alone from (d1, d2, d3).

        Args:
            d1: Opening [mm]; d1, d2, d3 broadcast to one shape (...).
            d2: Laterotrusion [mm] at which d3 is moved.
            d3: Protrusion [mm] at which d2 is moved.

        Returns:
            d2min, d2max, d3min, d3max [mm], each (...); NaN where the section has no point on that line.
        """
        d = np.stack(np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in (d1, d2, d3))), axis=-1)
        rows, batch = as_rows(d, (3,), "d")
        ends = in_chunks(lambda d: (*self.bound.chord(d, 1), *self.bound.chord(d, 2)), rows)
        low2, high2, low3, high3 = (end.reshape(batch) for end in ends)
        return low2, high2, low3, high3

    def normalized(self, d: ArrayLike) -> Array:
        """Return d as shares of this person's ranges, for carrying motion to another person.

        The opening is divided by the full opening, d2 and d3 by the reach to their side along the habitual path at
        that opening (at least 0.5 mm).

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            Shares, shape (..., 3): 1 is the full range.
        """
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(lambda d: sections.normalized(self.bound, self._opening_mm, d), rows).reshape(*batch, 3)

    def denormalized(self, shares: ArrayLike) -> Array:
        """Return the jaw parameters [mm], shape (..., 3), of shares (..., 3): the inverse of `normalized`."""
        rows, batch = as_rows(shares, (3,), "shares")
        return in_chunks(lambda n: sections.denormalized(self.bound, self._opening_mm, n), rows).reshape(*batch, 3)

    def captured_distance(self, d: ArrayLike) -> Array:
        """Return the distance [mm] (...) of d (..., 3) [mm] to the nearest captured pose, in d; inf without any."""
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(lambda d: nearest_distance(self.arrays["codes"], d), rows).reshape(batch)
