"""Between the frames of a rig: motions away from the closed bite (anatomical frame) and poses (skull from mandible)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.geometry.se3 import make_transform, se3_adjoint, se3_inverse

Array = NDArray[np.float64]


class RigFrames:
    """``pose = A^-1 M A rest``, with A = T_anatomical_skull and rest = T_skull_mandible of the closed bite.

    Attributes:
        to_anatomical: A, shape (4, 4).
        from_anatomical: A^-1.
        closed: A rest, mandible to anatomical coordinates with the teeth together.
        adjoint: Ad(A^-1), twists from the anatomical to the skull frame, shape (6, 6).
    """

    def __init__(self, T_anatomical_skull: Array, T_rest: Array) -> None:
        self.to_anatomical = T_anatomical_skull
        self.from_anatomical = se3_inverse(T_anatomical_skull)
        self.closed = T_anatomical_skull @ T_rest
        self.adjoint = se3_adjoint(self.from_anatomical)
        self._opened = se3_inverse(self.closed)

    def poses(self, R: Array, t: Array) -> Array:
        """Return the poses T_skull_mandible (n, 4, 4) of motions R (n, 3, 3), t (n, 3) [mm]."""
        return self.from_anatomical @ make_transform(R, t) @ self.closed

    def motions(self, T_skull_mandible: Array) -> tuple[Array, Array]:
        """Return rotation (n, 3, 3) and translation (n, 3) [mm] of the motions of poses (n, 4, 4)."""
        M = self.to_anatomical @ T_skull_mandible @ self._opened
        return M[:, :3, :3], M[:, :3, 3]
