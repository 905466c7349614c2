"""Between the frames of a rig: motions away from the closed bite (anatomical frame) and poses (skull from mandible)."""

from __future__ import annotations

import numpy as np

from jawusd.geometry.arrays import Array
from jawusd.geometry.se3 import se3_adjoint, se3_inverse


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
        # (L M Q) as one matrix product over all motions: rows of 16 times the Kronecker product of L^T and Q
        self._to_pose = np.kron(self.from_anatomical.T, self.closed)
        self._to_motion = np.kron(self.to_anatomical.T, se3_inverse(self.closed))

    def poses(self, M: Array) -> Array:
        """Return the poses T_skull_mandible of motions, both of shape (n, 4, 4)."""
        return (M.reshape(-1, 16) @ self._to_pose).reshape(-1, 4, 4)

    def motions(self, T_skull_mandible: Array) -> tuple[Array, Array]:
        """Return rotation (n, 3, 3) and translation (n, 3) [mm] of the motions of poses (n, 4, 4)."""
        M = (T_skull_mandible.reshape(-1, 16) @ self._to_motion).reshape(-1, 4, 4)
        return M[:, :3, :3], M[:, :3, 3]
