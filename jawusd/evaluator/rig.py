"""The runtime rig: jaw parameters to poses of the mandible and back, bounds, verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.evaluator.models import model_from_arrays
from jawusd.geometry.se3 import make_transform, se3_adjoint, se3_inverse

Array = NDArray[np.float64]


class JawRig:
    """One person's jaw: pure functions from d = (opening, laterotrusion, protrusion) [mm] to poses and back.

    ``pose(d) = A^-1 M(d) A rest`` with A = T_anatomical_skull and rest = T_skull_mandible of the closed bite;
    ``twist(d) = log(pose(d) rest^-1)``, skull frame, (omega [rad], v [mm]).

    Every function takes any batch shape in front of the axes it names, float32 or float64, and computes in float64. A
    row with a NaN or infinity gives NaN. Rigs have no state: share them between threads, pickle them, fork.

    Attributes:
        arrays: The named arrays the rig was made from (read-only views).
        meta: The header that came with them.
    """

    def __init__(self, arrays: Mapping[str, ArrayLike], meta: Mapping[str, Any]) -> None:
        """Build the rig.

        Args:
            arrays: Named arrays of a model of format jawusd-model/1.
            meta: Its header.
        """
        self.arrays = {name: _frozen(value) for name, value in arrays.items()}
        self.meta = dict(meta)
        self.model = model_from_arrays(self.arrays)
        self._to_anatomical = self.arrays["T_anatomical_skull"]
        self._from_anatomical = se3_inverse(self._to_anatomical)
        self._adjoint = se3_adjoint(self._from_anatomical)
        self._closed = self._to_anatomical @ self.arrays["T_rest"]

    def pose(self, d: ArrayLike) -> Array:
        """Return the pose T_skull_mandible for jaw parameters d.

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            Poses, shape (..., 4, 4).
        """
        rows, shape = _rows(d, 3, "d")
        M = make_transform(*self.model.decode(rows))
        return (self._from_anatomical @ M @ self._closed).reshape(*shape, 4, 4)

    def twist(self, d: ArrayLike) -> Array:
        """Return the twist log(pose(d) rest^-1) in the skull frame.

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            Twists (omega [rad], v [mm]), shape (..., 6).
        """
        rows, shape = _rows(d, 3, "d")
        return (self.model.log(rows) @ self._adjoint.T).reshape(*shape, 6)

    def jacobian(self, d: ArrayLike) -> Array:
        """Return the derivative of `twist` by d.

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            Jacobians [rad/mm above, mm/mm below], shape (..., 6, 3).
        """
        rows, shape = _rows(d, 3, "d")
        return (self._adjoint @ self.model.log_jacobian(rows)).reshape(*shape, 6, 3)


def _frozen(value: ArrayLike) -> NDArray:
    view = np.asarray(value).view()
    view.flags.writeable = False
    return view


def _rows(values: ArrayLike, width: int, name: str) -> tuple[Array, tuple[int, ...]]:
    """Return the values as float64 rows (n, width), rows that are not finite made NaN, and the batch shape."""
    values = np.asarray(values, dtype=np.float64)
    if values.shape[-1:] != (width,):
        raise ValueError(f"{name} must have shape (..., {width}), got {values.shape}")
    rows = values.reshape(-1, width)
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        rows = np.where(finite[:, None], rows, np.nan)
    return rows, values.shape[:-1]
