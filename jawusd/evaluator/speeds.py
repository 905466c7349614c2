"""Covariances of the velocity and acceleration of d, estimated from a take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.base.errors import EvaluatorError

_MIN_FRAMES = 30  # minimum number of fourth differences for an estimate
# Factors by which first, second and fourth differences multiply the variance of white noise.
_NOISE_IN = {1: 2.0, 2: 6.0, 4: 70.0}
_SIGMA_OF_MEDIAN = 1.4826  # ratio of standard deviation to median absolute value of a normal distribution
_MIN_SIGNAL = 0.05  # Minimum fraction of the observed variance that is attributed to motion.
_MIN_SPREAD = 1e-6  # Minimum relative variance in any direction; keeps covariances of 1-D motion invertible.


@dataclass(frozen=True, eq=False)
class Speeds:
    """Covariances of the motion of a jaw, about a mean of zero."""

    velocity: Array  # covariance of the velocities of d [mm^2/s^2], shape (3, 3)
    acceleration: Array  # covariance of the accelerations of d [mm^2/s^4], shape (3, 3)

    @classmethod
    def of_take(cls, d: ArrayLike, fps: float) -> Speeds:
        """Estimate the speeds of consecutive frames d (F, 3) [mm], NaN if lost, corrected for independent noise.

        The noise level is estimated from the median of fourth differences, where noise dominates motion.

        Raises:
            ValueError: a wrong shape, a rate that is not positive, or too few consecutive frames.
        """
        rows = np.asarray(d, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != 3 or not fps > 0:
            raise ValueError(f"d must have shape (F, 3) and the rate must be positive, got {rows.shape} and {fps}")
        seen = {order: _known(np.diff(rows, order, axis=0)) for order in _NOISE_IN}
        if len(seen[4]) < _MIN_FRAMES:
            raise ValueError(f"the take has {len(seen[4])} consecutive frames; at least {_MIN_FRAMES} are needed")
        spread = {order: changes.T @ changes / len(changes) for order, changes in seen.items()}
        noise = np.diag((_SIGMA_OF_MEDIAN * np.median(np.abs(seen[4]), axis=0)) ** 2) / _NOISE_IN[4]
        return cls(*(fps ** (2 * order) * _denoised(spread[order], _NOISE_IN[order] * noise) for order in (1, 2)))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> Speeds | None:
        """Return the speeds in the named arrays of a rig, or None."""
        if "velocity_covariance" not in arrays:
            return None
        return cls(arrays["velocity_covariance"], arrays["acceleration_covariance"])

    def arrays(self) -> dict[str, Array]:
        """Return the covariances by their names in a rig."""
        return {"velocity_covariance": self.velocity, "acceleration_covariance": self.acceleration}

    @property
    def rms_mm_s(self) -> Array:
        """Root mean square speed of each parameter [mm/s], shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.velocity)))

    @property
    def rms_mm_s2(self) -> Array:
        """Root mean square acceleration of each parameter [mm/s^2], shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.acceleration)))


def _known(changes: Array) -> Array:
    return changes[np.isfinite(changes).all(axis=1)]


def _denoised(seen: Array, noise: Array) -> Array:
    """Subtract a noise covariance from an observed one, (3, 3) each, and keep a minimum variance in every direction."""
    floor = _MIN_SPREAD * np.trace(seen) / 3.0 + 1e-12
    root = np.linalg.cholesky(seen + floor * np.eye(3))
    share = np.linalg.solve(root, np.linalg.solve(root, noise).T)
    sizes, directions = np.linalg.eigh(0.5 * (share + share.T))
    left = root @ directions * np.sqrt(np.maximum(1.0 - sizes, _MIN_SIGNAL))
    return np.asarray(left @ left.T)


def check_speeds(arrays: Mapping[str, Array]) -> None:
    """Raise EvaluatorError if a covariance among the arrays of a rig is not symmetric and positive definite."""
    for name in ("velocity_covariance", "acceleration_covariance"):
        value = arrays[name]
        if (np.abs(value - value.T) > 1e-9 * np.abs(value).max()).any() or np.linalg.eigvalsh(value).min() <= 0:
            raise EvaluatorError(f'"{name}" is {value.tolist()}; it must be symmetric and positive definite.')
