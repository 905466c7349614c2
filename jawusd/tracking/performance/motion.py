"""Where head and jaw are expected in the next frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator import JawRig
from jawusd.tracking.performance.attempts import MOST_UNSURE
from jawusd.tracking.performance.coordinates import LOCAL, Coordinates, Pose
from jawusd.tracking.performance.instant import Expected

# How far a prediction may be off, standard deviations [rad, mm, mm]: that of fast chewing at 24 frames a second. It
# only has to keep finite what the pictures leave free; the smoother knows better.
_MISS = np.r_[[0.01] * 3, [0.7] * 3, [0.7] * 3]
#: Share of it with a head that hardly moves before the cameras, and with one that is known.
STEADY, KNOWN = 0.05, 1e-4
_DAMPING = 0.8  # of the velocity: a stroke ends sooner than it goes on

# Variance of the prior over the mean square of what was seen [-]: motion is even most of the time and jerky where it
# counts. 1, 3 and 9 are alike within a twentieth for one camera, and too stiff a prior costs most.
_LOOSE = 4.0
# Least variances of second differences [rad, mm]: a head that rests still trembles.
_LEAST_HEAD = np.r_[[1e-4] * 3, [0.01] * 3] ** 2
_LEAST_JAW = np.full(3, 0.02**2)
_FEWEST_BENDS = 20  # second differences that tell how a jaw moves
_USUAL_JAW = np.array([0.3, 0.2, 0.1]) ** 2  # without them: exercises at 24 frames a second [mm]
_USUAL_HEAD = np.r_[[1e-3] * 3, [0.1] * 3] ** 2
_OUTLIERS = 99.0  # percentile of the second differences beyond which frames were left out between them
# Variance of second and of fourth differences of noise over that of the noise.
_NOISE_BEND, _NOISE_FOURTH = 6.0, 70.0


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


@dataclass(frozen=True, eq=False)
class Motion:
    """Hold the variances of a take's motion per frame, of the nine unknowns: second and first differences, (9,)."""

    bend: Array
    step: Array


def head_bends(coordinates: Coordinates, poses: Sequence[Pose]) -> tuple[Array, Array]:
    """Return second (N - 2, 6) and first differences (N - 1, 6) of the head's poses."""
    heads = np.stack([pose.head for pose in poses])
    steps = coordinates.head_steps(heads[:-1], heads[1:])
    return np.diff(steps, axis=0), steps


def measured_motion(coordinates: Coordinates, poses: Sequence[Pose], good: Mask, fps: float) -> Motion:
    """Return how evenly a take moves, or where too little of it is seen, how the take behind the rig did.

    Args:
        poses: of consecutive frames.
        good: frames with both arches, shape (N,).
        fps: frames per second.
    """
    bend, step = head_bends(coordinates, poses)
    d = np.stack([pose.d for pose in poses])
    steps, bends = np.hstack([step, np.diff(d, axis=0)]), np.hstack([bend, np.diff(d, 2, axis=0)])
    least = np.concatenate([_LEAST_HEAD, _LEAST_JAW])
    runs = good.copy()  # of five frames: where each begins
    for k in range(1, 5):
        runs[:-k] &= good[k:]
        runs[-k:] = False
    if runs.sum() < _FEWEST_BENDS:
        usual = np.concatenate([_USUAL_HEAD, _of_rig(coordinates.jaw, fps)])
        return Motion(bend=_LOOSE * usual, step=25 * usual)
    start = np.flatnonzero(runs)
    # Noise shows in fourth differences far more than motion does, so that they tell it from motion.
    noise = (np.diff(bends, 2, axis=0)[start] ** 2).mean(0) / _NOISE_FOURTH
    moving = (bends[start + 1] ** 2).mean(0) - _NOISE_BEND * noise
    return Motion(bend=_LOOSE * np.maximum(moving, least), step=np.maximum((steps[start] ** 2).mean(0), least))


def _of_rig(jaw: JawRig, fps: float) -> Array:
    """Return the mean squared second differences of d in the take behind the rig, at so many frames per second."""
    bend = np.abs(np.diff(jaw.captured_d, 2, axis=0))
    if len(bend) < _FEWEST_BENDS:
        return _USUAL_JAW
    kept = np.where(bend <= np.percentile(bend, _OUTLIERS, axis=0), bend, np.nan)
    own = jaw.meta.get("fps")
    slower = (float(own) if isinstance(own, int | float) else fps) / fps
    return np.asarray(np.nanmean(kept**2, axis=0) * slower**4, np.float64)
