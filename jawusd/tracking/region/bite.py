"""Keep the lower teeth from passing through the upper ones.

Where teeth touch, each arch hides edges of the other and is bright behind what is left of them: colours alone then
place the jaw up to half a millimetre beyond the closed bite, where it cannot be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import hat, transform_point
from jawusd.tracking.contour.equations import NormalEquations, Solution

# How far points of the lower teeth lie above the closed bite of the scans, standard deviation [mm]: what registrations
# of bites are off by. Squared distance in these [-] from which the scans' bite rather than the pose may be wrong.
_ABOVE_MM, _DOUBT = 0.2, 4.0


@dataclass(frozen=True, eq=False)
class BiteTerm:
    """Push lower teeth down that lie above the closed bite of the scans.

    Attributes:
        points: of the lower teeth, in scan coordinates [mm], shape (N, 3).
        up: bite normal, scan coordinates, shape (3,).
        noise_px3: variance of borders times the length over which they err alike.
    """

    points: Array
    up: Array
    noise_px3: float

    def accumulate(self, state: Solution, equations: NormalEquations) -> None:
        """Add the squared heights above the closed bite at the state's poses, in units of the outline sums."""
        skull = state.poses[0]
        up = skull[:3, :3] @ self.up
        for point in self.points:
            here, closed = transform_point(state.poses[1], point), transform_point(skull, point)
            height = float(up @ (here - closed))
            if height <= 0:
                continue
            # Both the point and the place it may not pass move with their arch.
            moves = [up @ np.hstack([-hat(here - centre), np.eye(3)]) for centre in state.centres]
            slope = np.concatenate([-moves[0], moves[1]])
            trust = _DOUBT / (_DOUBT + (height / _ABOVE_MM) ** 2)
            weight = trust * self.noise_px3 * float(equations.outline_weight.mean()) / _ABOVE_MM**2
            equations.add_joint(weight * np.outer(slope, slope), -weight * height * slope)
