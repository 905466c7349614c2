"""Motion of head and jaw: prediction of the pose in the next frame, and variances for the smoother's prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator import JawRig
from jawusd.tracking.performance.attempts import LARGEST_SIGMA
from jawusd.tracking.performance.coordinates import JAW, LOCAL, Coordinates, Pose
from jawusd.tracking.performance.instant import Expected

# Standard deviations of predicted head rotation, head translation and jaw parameters [rad, mm, mm], for fast chewing at
# 24 frames per second; they only regularise directions that the images do not determine.
_MISS = np.r_[[0.01] * 3, [0.7] * 3, [0.7] * 3]
#: Factors on the standard deviations of the head: if the head hardly moves relative to the cameras, and if its pose is
#: known.
STEADY, KNOWN = 0.05, 1e-4
_DAMPING = 0.8  # factor by which the velocity is damped in every frame

_LOOSE = 4.0  # ratio of the prior's variance to the measured mean square [-]: motion is smooth, but has abrupt changes
_LEAST_HEAD = np.r_[[1e-4] * 3, [0.01] * 3] ** 2  # lower bounds on the variances of second differences [rad^2, mm^2]
_LEAST_JAW = np.full(3, 0.02**2)
_FEWEST_BENDS = 20  # minimum number of second differences for estimating their variance
# default mean squares of second differences, from exercises at 24 frames per second [mm^2]
_USUAL_JAW = np.array([0.3, 0.2, 0.1]) ** 2
_USUAL_HEAD = np.r_[[1e-3] * 3, [0.1] * 3] ** 2
_OUTLIERS = 99.0  # percentile above which second differences are assumed to span gaps
# Variance of the second and of the fourth differences of white noise, relative to the noise variance.
_NOISE_BEND, _NOISE_FOURTH = 6.0, 70.0


class Prediction:
    """Extrapolation of the poses of head and jaw with a damped velocity.

    Attributes:
        last: the pose of the last frame.
        blind: number of frames since each arch was found, shape (2,).
    """

    def __init__(self, coordinates: Coordinates, begin: Pose, found: Mask, *, head: float = 1.0) -> None:
        """Start at rest from a pose in which arches were `found`, shape (2,); `head` scales the head's deviations."""
        self._coordinates, self._miss = coordinates, _MISS * np.r_[[head] * 6, [1.0] * 3]
        self.last, self._velocity, self._frames = begin, np.zeros(LOCAL), 1.0
        self.blind = np.where(found, 0, 1)
        self._carried_mm2: Array | None = None

    def expected(self, frames: float = 1.0) -> Expected:
        """Return the pose predicted `frames` frames ahead; its variance grows while teeth are not visible."""
        self._frames = frames
        steps = (frames * self._miss) ** 2
        variance = steps * (1.0 + np.r_[[self.blind[0]] * 6, [self.blind.max()] * 3])
        if self._carried_mm2 is not None:
            variance[JAW] = steps[JAW] + self._carried_mm2
        reach = _DAMPING * (1.0 - _DAMPING**frames) / (1.0 - _DAMPING)
        pose = self._coordinates.moved(self.last, reach * self._velocity)
        return Expected(pose, np.minimum(np.sqrt(variance), LARGEST_SIGMA) ** -2.0)

    def around(self, pose: Pose) -> Expected:
        """Return a prior around a pose of the frame from another source."""
        return Expected(pose, self._miss**-2.0)

    def take(self, pose: Pose, found: Mask) -> None:
        """Update with the pose of the next frame; `found` is whether each arch was found in it, shape (2,)."""
        moved = self._coordinates.step(self.last, pose) / self._frames
        self._velocity = moved if found.all() and not self.blind.any() else np.zeros(LOCAL)
        self.blind = np.where(found, 0, self.blind + 1)
        self.last, self._carried_mm2 = pose, None

    def carry(self, d: Array, variance_mm2: Array) -> None:
        """Replace the jaw of the last frame with d [mm], shape (3,), and its variances [mm^2], from another source."""
        self.last, self._carried_mm2 = replace(self.last, d=d), variance_mm2


@dataclass(frozen=True, eq=False)
class Motion:
    """Variances of the second and first differences of the nine unknowns per frame, shape (9,) each."""

    bend: Array
    step: Array


def head_bends(coordinates: Coordinates, poses: Sequence[Pose]) -> tuple[Array, Array]:
    """Return the second (N - 2, 6) and first differences (N - 1, 6) of head poses."""
    heads = np.stack([pose.head for pose in poses])
    steps = coordinates.head_steps(heads[:-1], heads[1:])
    return np.diff(steps, axis=0), steps


def measured_motion(coordinates: Coordinates, poses: Sequence[Pose], good: Mask, fps: float) -> Motion:
    """Return the variances of a take's motion; if too few frames are good, those of the rig's training take.

    `poses` are those of consecutive frames; `good`, shape (N,), is whether both arches were found.
    """
    bend, step = head_bends(coordinates, poses)
    d = np.stack([pose.d for pose in poses])
    steps, bends = np.hstack([step, np.diff(d, axis=0)]), np.hstack([bend, np.diff(d, 2, axis=0)])
    least = np.concatenate([_LEAST_HEAD, _LEAST_JAW])
    runs = good.copy()  # whether a frame is the first of five good frames in a row
    for k in range(1, 5):
        runs[:-k] &= good[k:]
        runs[-k:] = False
    if runs.sum() < _FEWEST_BENDS:
        usual = np.concatenate([_USUAL_HEAD, _of_rig(coordinates.jaw, fps)])
        return Motion(bend=_LOOSE * usual, step=25 * usual)
    start = np.flatnonzero(runs)
    # Fourth differences are dominated by noise; they serve to separate noise from motion.
    noise = (np.diff(bends, 2, axis=0)[start] ** 2).mean(0) / _NOISE_FOURTH
    moving = (bends[start + 1] ** 2).mean(0) - _NOISE_BEND * noise
    return Motion(bend=_LOOSE * np.maximum(moving, least), step=np.maximum((steps[start] ** 2).mean(0), least))


def _of_rig(jaw: JawRig, fps: float) -> Array:
    """Return the mean squared second differences of d in the rig's training take, scaled to a frame rate."""
    bend = np.abs(np.diff(jaw.captured_d, 2, axis=0))
    if len(bend) < _FEWEST_BENDS:
        return _USUAL_JAW
    kept = np.where(bend <= np.percentile(bend, _OUTLIERS, axis=0), bend, np.nan)
    own = jaw.meta.get("fps")
    slower = (float(own) if isinstance(own, int | float) else fps) / fps
    return np.asarray(np.nanmean(kept**2, axis=0) * slower**4, np.float64)
