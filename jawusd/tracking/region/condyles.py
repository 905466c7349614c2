"""Keep the condyles near their sockets, for poses that are found before anything is known of this jaw's motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.geometry import hat, transform_point
from jawusd.geometry.arrays import Array
from jawusd.tracking.contour.equations import NormalEquations, Solution

# How far condyles are from where they rest, standard deviation to the side, up and forwards [mm]: they slide down the
# eminence as the jaw opens, and hardly move sideways.
_SPREAD_MM = (0.8, 2.0, 4.0)
_NOISE_PX3 = 3.0  # outline variance times correlation length, as in `TrackingConfig.typical_noise_px3`


@dataclass(frozen=True, eq=False)
class CondyleTerm:
    """Pull both condyles towards where they rest in the skull."""

    condyles: Array  # both, in scan coordinates [mm], shape (2, 3)
    axes: Array  # rotation from scan to anatomical axes: left, up, front; shape (3, 3)

    def accumulate(self, state: Solution, equations: NormalEquations) -> None:
        """Add the squared distances at the state's poses, in units of the outline sums."""
        weights = _NOISE_PX3 * float(equations.outline_weight.mean()) / np.square(_SPREAD_MM)
        turn = self.axes @ state.poses[0, :3, :3].T
        precision, right = np.zeros((12, 12)), np.zeros(12)
        for point in self.condyles:
            at = [transform_point(pose, point) for pose in state.poses]
            slope = np.zeros((3, 12))
            for r, sign in ((0, -1.0), (1, 1.0)):
                slope[:, 6 * r : 6 * r + 3] = -sign * turn @ hat(at[r] - state.centres[r])
                slope[:, 6 * r + 3 : 6 * r + 6] = sign * turn
            precision += slope.T @ (weights[:, None] * slope)
            right -= slope.T @ (weights * (turn @ (at[1] - at[0])))
        equations.add_joint(precision, right)
