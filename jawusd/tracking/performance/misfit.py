"""The misfit: the part of the mandible's pose that the rig cannot reproduce, as an unknown of every frame.

Without it, masks of both arches that contradict the rig, above all beyond the range of motion in its calibration take,
would push the head and the jaw away, or a correct mask would be left unmatched. The misfit has the covariance of the
rig's own error as its prior. It is eliminated from the normal equations of a frame, and estimated after each step.
"""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.tracking.performance.coordinates import Coordinates, Pose


class Misfit:
    """Elimination of the misfit from the normal equations of a frame in N unknowns.

    Attributes:
        matrix, right: what the elimination adds to the normal matrix (N, N) and the right-hand side (N,).
        precision: precision of the lower arch's twist if the misfit is unknown, shape (6, 6).
    """

    def __init__(
        self,
        coordinates: Coordinates,
        pose: Pose,
        sums: tuple[Array, Array],
        coupling: Array,
        of_rig: Array | None = None,
    ) -> None:
        """Eliminate the misfit at a pose.

        Args:
            coordinates: coordinates of the rig.
            pose: current pose.
            sums: precision (6, 6) and gradient (6,) of the lower arch's twist, as in `Coordinates.slopes`.
            coupling: block of the normal matrix that couples this twist with the unknowns, shape (6, N).
            of_rig: covariance of the rig's own error, shape (6, 6); default: at the pose.
        """
        precision, gradient = sums
        if of_rig is None:
            of_rig = coordinates.jaw.pose_covariance(pose.d)
        self._slope, self._coupling = coordinates.error_slope(pose), coupling
        prior, offset = self._slope @ of_rig @ self._slope.T, self._slope @ pose.misfit
        kept = np.linalg.inv(np.eye(6) + precision @ prior)
        self.precision, self._spread = kept @ precision, prior @ kept
        self._gradient = gradient + precision @ offset  # at zero misfit
        self.matrix = -coupling.T @ self._spread @ coupling
        self.right = coupling.T @ (offset - self._spread @ self._gradient)

    def after(self, step: Array) -> Array:
        """Return the misfit, shape (6,) [rad, mm], after a step of the unknowns, shape (N,)."""
        moved = self._spread @ (self._gradient - self._coupling @ step)
        return np.asarray(np.linalg.solve(self._slope, moved), np.float64)
