"""Between the frames of a rig: motions away from the closed bite (anatomical frame) and poses (skull from mandible)."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.single import Motion, Vector
from jawusd.geometry.se3 import se3_adjoint, se3_inverse


class RigFrames:
    """``T_skull_mandible = T_skull_anatomical M T_anatomical_mandible_rest``, see `jawusd.evaluator.models` for M.

    Attributes:
        T_anatomical_skull: Shape (4, 4).
        T_skull_anatomical: Its inverse.
        T_anatomical_mandible_rest: Mandible to anatomical coordinates with the teeth together, shape (4, 4).
        T_mandible_anatomical_rest: Its inverse.
        adjoint: Ad(T_skull_anatomical), twists from the anatomical to the skull frame, shape (6, 6).
    """

    def __init__(self, T_anatomical_skull: Array, T_rest: Array, anchor: Vector) -> None:
        """Take the anchor [mm] of the motions that `pose` is given, anatomical frame."""
        self.T_anatomical_skull = T_anatomical_skull
        self.T_skull_anatomical = se3_inverse(T_anatomical_skull)
        self.T_anatomical_mandible_rest = T_anatomical_skull @ T_rest
        self.T_mandible_anatomical_rest = se3_inverse(self.T_anatomical_mandible_rest)
        self.adjoint = se3_adjoint(self.T_skull_anatomical)
        # L M Q as one matrix product over all motions: rows of 16 times the Kronecker product of L^T and Q
        self._to_pose = np.kron(self.T_skull_anatomical.T, self.T_anatomical_mandible_rest)
        self._to_motion = np.kron(T_anatomical_skull.T, self.T_mandible_anatomical_rest)
        # the same for the twelve numbers of one motion, ``M - I = (R - I, u - (R - I) p)``, and a one for the rest
        entries = self._to_pose.reshape(4, 4, 16)[:3]
        turn = entries[:, :3] - np.multiply.outer(anchor, entries[:, 3]).swapaxes(0, 1)
        self._single_to_pose = np.concatenate([turn.reshape(9, 16), entries[:, 3], T_rest.reshape(1, 16)])

    def pose(self, motion: Motion) -> Array:
        """Return the pose T_skull_mandible (4, 4) of one motion of `jawusd.evaluator.single`."""
        return np.array((*motion, 1.0)).dot(self._single_to_pose).reshape(4, 4)

    def poses(self, M: Array) -> Array:
        """Return the poses T_skull_mandible of motions, both of shape (n, 4, 4)."""
        return (M.reshape(-1, 16) @ self._to_pose).reshape(-1, 4, 4)

    def motions(self, T_skull_mandible: Array) -> tuple[Array, Array]:
        """Return rotation (n, 3, 3) and translation (n, 3) [mm] of the motions of poses (n, 4, 4)."""
        M = (T_skull_mandible.reshape(-1, 16) @ self._to_motion).reshape(-1, 4, 4)
        return M[:, :3, :3], M[:, :3, 3]


def motions_of_poses(T_skull_mandible: Array, T_anatomical_skull: Array, T_rest: Array) -> Array:
    """Return the motions ``M = A T rest^-1 A^-1`` away from the closed bite of poses, both of shape (..., 4, 4)."""
    return T_anatomical_skull @ T_skull_mandible @ se3_inverse(T_anatomical_skull @ T_rest)


def poses_of_motions(motion: Array, T_anatomical_skull: Array, T_rest: Array) -> Array:
    """Return the poses T_skull_mandible of motions away from the closed bite, both of shape (..., 4, 4)."""
    return se3_inverse(T_anatomical_skull) @ motion @ T_anatomical_skull @ T_rest
