"""How fast the jaw of a person moves: covariances of velocity and acceleration of d, as a take showed them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.base.errors import EvaluatorError

_FEWEST_FRAMES = 30
# Sums of the squared coefficients of first, second and fourth differences: the variance there of noise of variance 1.
_NOISE_IN = {1: 2.0, 2: 6.0, 4: 70.0}
_SIGMA_OF_MEDIAN = 1.4826  # standard deviation over the median absolute value, normal distribution
_LEAST_SHARE = 0.05  # of what was seen; so much is motion even where all of it might be noise
_LEAST_SPREAD = 1e-6  # relative; keeps covariances of takes that move along one line invertible


@dataclass(frozen=True, eq=False)
class Speeds:
    """How fast a jaw moves, both about a mean of zero.

    Attributes:
        velocity: Covariance of the velocities of d [mm^2/s^2], shape (3, 3).
        acceleration: Covariance of the accelerations of d [mm^2/s^4], shape (3, 3).
    """

    velocity: Array
    acceleration: Array

    @classmethod
    def of_take(cls, d: ArrayLike, fps: float) -> Speeds:
        """Learn the speeds of a take, less what noise from frame to frame adds to them.

        Noise shows in fourth differences far more than motion does, and in most frames, where motion is jerky in few;
        what it adds to first and second differences follows.

        Args:
            d: Jaw parameters [mm] of consecutive frames, shape (F, 3), such as `solve` or `encode` give; NaN where a
                frame is lost.
            fps: Frames per second.

        Raises:
            ValueError: another shape, a rate that is not positive, or too few frames in a row.
        """
        rows = np.asarray(d, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != 3 or not fps > 0:
            raise ValueError(f"a take has d of shape (F, 3) and a positive rate, got {rows.shape} and {fps}")
        seen = {order: _known(np.diff(rows, order, axis=0)) for order in _NOISE_IN}
        if len(seen[4]) < _FEWEST_FRAMES:
            raise ValueError(f"the take has {len(seen[4])} frames in a row, at least {_FEWEST_FRAMES} are needed")
        spread = {order: changes.T @ changes / len(changes) for order, changes in seen.items()}
        noise = np.diag((_SIGMA_OF_MEDIAN * np.median(np.abs(seen[4]), axis=0)) ** 2) / _NOISE_IN[4]
        return cls(*(fps ** (2 * order) * _less(spread[order], _NOISE_IN[order] * noise) for order in (1, 2)))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> Speeds | None:
        """Pick the speeds out of the named arrays of a rig; None if the rig has none."""
        if "velocity_covariance" not in arrays:
            return None
        return cls(arrays["velocity_covariance"], arrays["acceleration_covariance"])

    def arrays(self) -> dict[str, Array]:
        """Return the covariances by their names in a rig."""
        return {"velocity_covariance": self.velocity, "acceleration_covariance": self.acceleration}

    @property
    def rms_mm_s(self) -> Array:
        """Root mean square speed of each of d [mm/s], shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.velocity)))

    @property
    def rms_mm_s2(self) -> Array:
        """Root mean square acceleration of each of d [mm/s^2], shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.acceleration)))


def _known(changes: Array) -> Array:
    return changes[np.isfinite(changes).all(axis=1)]


def _less(seen: Array, noise: Array) -> Array:
    """Return a covariance (3, 3) without that of noise, in no direction less than a share of what was seen."""
    floor = _LEAST_SPREAD * np.trace(seen) / 3.0 + 1e-12
    root = np.linalg.cholesky(seen + floor * np.eye(3))
    share = np.linalg.solve(root, np.linalg.solve(root, noise).T)
    sizes, directions = np.linalg.eigh(0.5 * (share + share.T))
    left = root @ directions * np.sqrt(np.maximum(1.0 - sizes, _LEAST_SHARE))
    return np.asarray(left @ left.T)


def check_speeds(arrays: Mapping[str, Array]) -> None:
    """Check the speeds among the named arrays of a rig.

    Raises:
        EvaluatorError: Covariances that are not symmetric and positive definite.
    """
    for name in ("velocity_covariance", "acceleration_covariance"):
        value = arrays[name]
        if (np.abs(value - value.T) > 1e-9 * np.abs(value).max()).any() or np.linalg.eigvalsh(value).min() <= 0:
            raise EvaluatorError(f'"{name}" is {value.tolist()}; it must be symmetric and positive definite.')
