"""Where head and jaw are expected in the next frame."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Mask
from jawusd.tracking.performance.attempts import MOST_UNSURE
from jawusd.tracking.performance.coordinates import LOCAL, Coordinates, Pose
from jawusd.tracking.performance.instant import Expected

# How far a prediction may be off, standard deviations [rad, mm, mm]: that of fast chewing at 24 frames a second. It
# only has to keep finite what the pictures leave free; the smoother knows better.
_MISS = np.r_[[0.01] * 3, [0.7] * 3, [0.7] * 3]
#: Share of it with a head that hardly moves before the cameras, and with one that is known.
STEADY, KNOWN = 0.05, 1e-4
_DAMPING = 0.8  # of the velocity: a stroke ends sooner than it goes on


class Prediction:
    """Extrapolate the motion of head and jaw with a damped velocity.

    Attributes:
        last: the pose of the last frame.
        blind: frames since each arch was found, shape (2,).
    """

    def __init__(self, coordinates: Coordinates, begin: Pose, found: Mask, *, head: float = 1.0) -> None:
        """Begin at rest with a frame on which some arches were found, shape (2,).

        Args:
            head: how far the head moves, as a share of what is usual.
        """
        self._coordinates, self._miss = coordinates, _MISS * np.r_[[head] * 6, [1.0] * 3]
        self.last, self._velocity, self._frames = begin, np.zeros(LOCAL), 1.0
        self.blind = np.where(found, 0, 1)

    def expected(self, frames: float = 1.0) -> Expected:
        """Return the prediction some frames on, the less sure the longer the teeth were out of sight."""
        self._frames = frames
        sigma = frames * self._miss * np.sqrt(1.0 + np.r_[[self.blind[0]] * 6, [self.blind.max()] * 3])
        reach = _DAMPING * (1.0 - _DAMPING**frames) / (1.0 - _DAMPING)
        pose = self._coordinates.moved(self.last, reach * self._velocity)
        return Expected(pose, np.minimum(sigma, MOST_UNSURE) ** -2.0)

    def take(self, pose: Pose, found: Mask) -> None:
        """Take up the next frame: where it is, and the arches that were found, shape (2,)."""
        moved = self._coordinates.step(self.last, pose) / self._frames
        self._velocity = moved if found.all() and not self.blind.any() else np.zeros(LOCAL)
        self.blind = np.where(found, 0, self.blind + 1)
        self.last = pose
