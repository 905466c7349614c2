"""Measurements of d from facial skin, with a slowly varying error that frames with visible teeth reveal.

Skin measures d in each frame as d_skin = d + L u + w, where L L^T is a fraction of the covariance that the learned map
predicts. The slow error u is an Ornstein-Uhlenbeck process with unit variance (Rasmussen and Williams 2006, equation
B.29), which is a Markov chain at equally spaced frames. The fast error w has the rest of the covariance; it persists
over several frames, so its variance is enlarged accordingly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator.skin import SkinJaw
from jawusd.tracking.performance.attempts import FrameFit
from jawusd.tracking.performance.system import TakeSystem

#: Returns the jaw parameters estimated from facial skin, given frame numbers (F,), d of the first pass (F, 3) [mm],
#: whether both arches were found (F,), and T_world_skull (F, 4, 4).
SkinOf = Callable[[Array, Array, Mask, Array], SkinJaw]

#: Number of unknowns per frame: components of the slowly varying error, in units of its standard deviation.
SLOW = 3
# Fraction of the variance that belongs to the slow error, its time constant [s], and the time over which fast errors
# persist [s]; see docs/explanation/constants.md.
_SHARE, _SLOW_S, _FAST_S = 0.7, 1.0, 0.04


class SkinFactor:
    """Normal equations of the measurements of d from skin."""

    def __init__(self, skin: SkinJaw, fps: float, wider: float = 1.0) -> None:
        """Prepare with d of every frame; `wider` multiplies all precisions, as covariances are multiplied later."""
        self.used: Mask = np.asarray(np.isfinite(skin.d).all(axis=-1))  # frames in which the face is known, shape (F,)
        #: those of them in which the face resembles the training frames, shape (F,)
        self.familiar: Mask = np.asarray(self.used & skin.familiar)
        self._d, self._wider = skin.d, wider
        covariance = np.where(self.used[:, None, None], skin.covariance, np.eye(3))
        self._slope, fast = _slow_and_fast(covariance, 1.0 / fps)
        self._precision = wider * np.linalg.inv(fast)
        self._correlation = _correlation(1.0 / fps)

    def started(self, fits: Sequence[FrameFit]) -> list[FrameFit]:
        """Return the fits, with d estimated from skin if the face is familiar and an arch was not found."""
        return [
            replace(fit, pose=replace(fit.pose, d=d)) if familiar and not fit.found.all() else fit
            for fit, d, familiar in zip(fits, self._d, self.familiar, strict=True)
        ]

    def add(self, system: TakeSystem, d: Array, slow: Array, first: int) -> None:
        """Add the factor to the equations of a take, in which the slow error is the last unknowns of each frame.

        `d` [mm] and `slow`, shape (F, 3), are current estimates; `first` is the index of d in the unknowns of a frame.
        """
        size = system.local + system.shared
        last = system.local - SLOW
        rows, prior = np.zeros((3, size)), self._prior()
        rows[:, first : first + 3] = np.eye(3)
        for k, weight in enumerate(prior):
            matrix, right = np.zeros((size, size)), np.zeros(size)
            own = np.arange(last, system.local)
            matrix[own, own] = weight
            right[own] = -weight * slow[k]
            if self.used[k]:
                rows[:, own] = self._slope[k]
                residual = self._d[k] - d[k] - self._slope[k] @ slow[k]
                matrix += rows.T @ self._precision[k] @ rows
                right += rows.T @ self._precision[k] @ residual
            system.add_frame(k, matrix, right)
        steps = np.diff(slow, axis=0)
        weight = self._wider * self._correlation / (1 - self._correlation**2)
        system.add_steps(slice(last, system.local), steps, np.full(3, weight))

    def _prior(self) -> Array:
        """Return the precision of each frame's slow error, in addition to that of its steps, shape (F,).

        For unit variance and correlation c between neighbours, (x' - c x)^2 / (1 - c^2) is split into
        c (x' - x)^2 / (1 - c^2) and terms in x^2 and x'^2.
        """
        count, keep = len(self._d), self._correlation
        if count == 1:
            return np.full(1, self._wider)
        weight = np.full(count, (1 - keep) ** 2 / (1 - keep**2))
        weight[[0, -1]] = (1 - keep) / (1 - keep**2)
        return self._wider * weight


class SkinFilter:
    """The same measurements one frame at a time, for live tracking: a Kalman filter of the slow error."""

    def __init__(self) -> None:
        self._slow, self._covariance = np.zeros(SLOW), np.eye(SLOW)

    def fuse(
        self, skin: SkinJaw, d: Array, covariance: Array, *, seen: bool, seconds: float
    ) -> tuple[Array, Array, bool]:
        """Return d of a frame combined with d from skin, its covariance, and whether skin was used.

        Args:
            skin: d estimated from skin in the frame, shape (3,); it is used only if the face is known.
            d, covariance: measured or predicted d, shape (3,) [mm], and its covariance (3, 3).
            seen: whether d was measured from both arches. Only then is the slow error corrected, since a predicted d
                repeats the errors of earlier frames.
            seconds: time since the previous frame [s].
        """
        keep = _correlation(seconds)
        self._slow = keep * self._slow
        self._covariance = keep**2 * self._covariance + (1 - keep**2) * np.eye(SLOW)
        if not np.isfinite(skin.d).all():
            return d, covariance, False
        slope, fast = _slow_and_fast(skin.covariance, seconds)
        residual = skin.d - d - slope @ self._slow
        by_slow = self._covariance @ slope.T
        precision = np.linalg.inv(covariance + slope @ by_slow + fast)
        if seen:
            self._slow = self._slow + by_slow @ precision @ residual
            self._covariance = self._covariance - by_slow @ precision @ by_slow.T
        gain = covariance @ precision
        return d + gain @ residual, covariance - gain @ covariance, True


def _slow_and_fast(covariance: Array, seconds: float) -> tuple[Array, Array]:
    """Split covariances of d from skin (..., 3, 3) into slow and fast errors, for frames `seconds` apart.

    Return the derivative of d [mm] with respect to the slow error, and the covariance of the fast error [mm^2].
    """
    slope = np.sqrt(_SHARE) * np.linalg.cholesky(covariance)
    return slope, (1 - _SHARE) * max(1.0, _FAST_S / seconds) * covariance


def _correlation(seconds: float) -> float:
    """Return the correlation of the slow error over a time [s]."""
    return float(np.exp(-seconds / _SLOW_S))


def jaw_of_skin(skin: SkinOf | None, frames: Sequence[int], fits: Sequence[FrameFit]) -> SkinJaw | None:
    """Return the jaw parameters estimated from skin in the frames of a first pass; None without skin data."""
    if skin is None:
        return None
    d, heads = np.stack([fit.pose.d for fit in fits]), np.stack([fit.pose.head for fit in fits])
    return skin(np.asarray(frames, np.float64), d, np.array([fit.found.all() for fit in fits]), heads)
