"""The runtime rig with its most used functions compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.evaluator.distances import landmark_vectors
from jawusd.evaluator.encoding import Encoder
from jawusd.evaluator.rig import BoundName, JawRig
from jawusd.evaluator.rows import as_rows
from jawusd.evaluator.verdicts import Verdicts
from jawusd.fast import rows as compiled
from jawusd.fast.arrays import owned, rows_of
from jawusd.fast.packing import packed_bound, packed_model
from jawusd.fast.search import FastReach
from jawusd.geometry.arrays import Array
from jawusd.geometry.se3 import transform_points

_SINGLE_LIMIT_MM = 1e4  # beyond, one d goes the way of batches, which tells absurd values from large ones


class FastRig(JawRig):
    """`JawRig`, compiled: the same functions, arguments, errors and results (to 1e-10), several times faster.

    What is not overridden here or in its searches is `JawRig`'s own.
    """

    def __init__(self, arrays: dict[str, ArrayLike], meta: dict) -> None:
        """Build the rig; arguments and errors as those of `JawRig`."""
        super().__init__(arrays, meta)
        vectors = landmark_vectors(transform_points(self._frames.T_anatomical_mandible_rest, self.arrays["landmarks"]))
        self._numbers = packed_model(self.model, self._frames, vectors)
        self._hull = packed_bound(self.bound)
        self._reach = FastReach(self.model, self.bound, self._numbers, self._hull)
        self._encoder = Encoder(self.model, self._frames, self.bound, self._reach, self.arrays["landmarks"])

    def __reduce__(self) -> tuple:
        return (FastRig, super().__reduce__()[1])

    def pose(self, d: ArrayLike) -> Array:
        """Return the poses T_skull_mandible (..., 4, 4) of d (..., 3) [mm]; see `JawRig.pose`."""
        d = np.asarray(d, dtype=np.float64)
        if d.shape == (3,):
            d1, d2, d3 = d.tolist()
            if abs(d1) + abs(d2) + abs(d3) < _SINGLE_LIMIT_MM:  # False for NaN
                return compiled.single_pose(self._numbers, d1, d2, d3)
        rows, batch = rows_of(d, (3,), "d")
        return self._poses(rows).reshape(*batch, 4, 4)

    def _poses(self, d: Array) -> Array:
        out = np.empty((len(d), 4, 4))
        compiled.poses(self._numbers, owned(d), out)
        return out

    def twist(self, d: ArrayLike) -> Array:
        """Return the twists (omega [rad], v [mm]), shape (..., 6), of d (..., 3) [mm]; see `JawRig.twist`."""
        rows, batch = rows_of(d, (3,), "d")
        out = np.empty((len(rows), 6))
        compiled.twists(self._numbers, rows, out)
        return out.reshape(*batch, 6)

    def jacobian(self, d: ArrayLike) -> Array:
        """Return the derivatives (..., 6, 3) of `twist` by d (..., 3) [mm]; see `JawRig.jacobian`."""
        rows, batch = rows_of(d, (3,), "d")
        out = np.empty((len(rows), 6, 3))
        compiled.jacobians(self._numbers, rows, out)
        return out.reshape(*batch, 6, 3)

    def encode(
        self, T_skull_mandible: ArrayLike, *, bounds: bool = False, covariance: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Return the nearest d (..., 3) [mm] to poses (..., 4, 4), and residual_mm (...); see `JawRig.encode`.

        Args:
            T_skull_mandible: Poses, shape (..., 4, 4).
            bounds: Search only inside the bound.
            covariance: See `JawRig.encode`.
        """
        if covariance is not None:
            return super().encode(T_skull_mandible, bounds=bounds, covariance=covariance)
        rows, batch = rows_of(T_skull_mandible, (4, 4), "T_skull_mandible")
        d, residual_mm = np.empty((len(rows), 3)), np.empty(len(rows))
        compiled.encodings(self._numbers, rows, d, residual_mm)
        if bounds:
            margin_mm = np.empty(len(rows))
            compiled.margins(self._hull, d, margin_mm)
            out = np.flatnonzero(margin_mm < 0)
            if out.size:  # these are searched for all over again, inside
                d[out], residual_mm[out] = self._encoder.encode(rows[out], bounded=True)
        return d.reshape(*batch, 3), residual_mm.reshape(batch)

    def margin(self, d: ArrayLike, *, bound: BoundName = "slices") -> Array:
        """Return the signed distances (...) of d (..., 3) to the bound [mm]; see `JawRig.margin`."""
        if bound != "slices":
            return super().margin(d, bound=bound)
        d = np.asarray(d, dtype=np.float64)
        if d.shape == (3,):
            d1, d2, d3 = d.tolist()
            if abs(d1) + abs(d2) + abs(d3) < _SINGLE_LIMIT_MM:
                return np.float64(compiled.single_margin(self._hull, d1, d2, d3))
        rows, batch = rows_of(d, (3,), "d")
        out = np.empty(len(rows))
        compiled.margins(self._hull, rows, out)
        return out.reshape(batch)

    def margin_gradient(self, d: ArrayLike) -> Array:
        """Return the derivative of `margin` (slice bound) by d [mm/mm], shape (..., 3), for d (..., 3) [mm]."""
        rows, batch = rows_of(d, (3,), "d")
        out = np.empty((len(rows), 3))
        compiled.margin_gradients(self._hull, rows, out)
        return out.reshape(*batch, 3)

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
        """Judge poses (..., 4, 4): finite, rigid, on the model, inside, reachable in time; see `JawRig.validate`.

        Args:
            T_skull_mandible: Poses, shape (..., 4, 4).
            residual_limit_mm: Largest landmark distance to the model; the rig's own if None.
            margin_limit_mm: Smallest margin; the rig's own if None.
            bound: Which bound, see `margin`.
            times_s: Times along the last batch axis, shape (F,); needed for a speed limit.
            speed_limit_mm_s: Largest speed of a landmark; None asks no question.
        """
        if bound != "slices" or speed_limit_mm_s is not None:
            return super().validate(
                T_skull_mandible,
                residual_limit_mm=residual_limit_mm,
                margin_limit_mm=margin_limit_mm,
                bound=bound,
                times_s=times_s,
                speed_limit_mm_s=speed_limit_mm_s,
            )
        rows, batch = rows_of(T_skull_mandible, (4, 4), "T_skull_mandible")
        limits = self.limits.replaced(residual_limit_mm, margin_limit_mm, None)
        count = len(rows)
        d, residual_mm, margin_mm = np.empty((count, 3)), np.empty(count), np.empty(count)
        reason = np.empty(count, dtype=np.uint8)
        compiled.judgements(
            self._numbers, self._hull, rows, limits.residual_mm, limits.margin_mm, d, residual_mm, margin_mm, reason
        )
        return _verdicts(d, residual_mm, margin_mm, reason, batch)

    def validate_parameters(
        self,
        d: ArrayLike,
        *,
        margin_limit_mm: float | None = None,
        bound: BoundName = "slices",
        times_s: ArrayLike | None = None,
        speed_limit_mm_s: float | None = None,
    ) -> Verdicts:
        """Judge jaw parameters d (..., 3) [mm] as `validate` does poses; see `JawRig.validate_parameters`.

        Args:
            d: Jaw parameters [mm], shape (..., 3).
            margin_limit_mm: Smallest margin; the rig's own if None.
            bound: Which bound, see `margin`.
            times_s: Times along the last batch axis, shape (F,); needed for a speed limit.
            speed_limit_mm_s: Largest speed of a landmark; None asks no question.
        """
        if bound != "slices" or speed_limit_mm_s is not None:
            return super().validate_parameters(
                d, margin_limit_mm=margin_limit_mm, bound=bound, times_s=times_s, speed_limit_mm_s=speed_limit_mm_s
            )
        rows, batch = as_rows(d, (3,), "d")  # NaN where not finite: they are part of the verdicts
        limits = self.limits.replaced(None, margin_limit_mm, None)
        residual_mm, margin_mm, reason = np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows), dtype=np.uint8)
        compiled.parameter_judgements(self._hull, owned(rows), limits.margin_mm, residual_mm, margin_mm, reason)
        return _verdicts(rows, residual_mm, margin_mm, reason, batch)


def _verdicts(d: Array, residual_mm: Array, margin_mm: Array, reason: NDArray[np.uint8], batch: tuple) -> Verdicts:
    reason = reason.reshape(batch)
    return Verdicts(reason == 0, reason, residual_mm.reshape(batch), margin_mm.reshape(batch), d.reshape(*batch, 3))
