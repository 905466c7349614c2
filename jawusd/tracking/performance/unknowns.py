"""The unknowns shared by all frames of a take, and the normal equations of a frame in all unknowns.

The shared unknowns are the offsets of masks from free edges and gum lines, which are equal in all cameras; the head
pose, if it is fixed; and unknown focal lengths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.tracking.contour.scan import ARCHES
from jawusd.tracking.contour.views import View
from jawusd.tracking.performance.attempts import FrameFit
from jawusd.tracking.performance.coordinates import HEAD, JAW, LOCAL, Coordinates, Pose
from jawusd.tracking.performance.instant import bound_equations
from jawusd.tracking.performance.views import PRIOR_LOG_FOCAL, with_focal

_HABITS = 3  # number of bias parameters per arch, as in `OutlineSums`


@dataclass(frozen=True)
class HabitPrior:
    """Prior on annotator bias: the offsets between mask outlines and tooth edges.

    Attributes:
        sigma: standard deviations of the bias at free edges [px], at the gum line [px], and along the crown surface at
            the gum line [mm].
        frames: number of independent frames that contain as much information about the bias as a whole take.
    """

    sigma: tuple[float, float, float]
    frames: float


#: Prior for hand-drawn masks.
DRAWN = HabitPrior((0.15, 0.15, 0.05), 1.5)


@dataclass(frozen=True, eq=False)
class TakeState:
    """Current estimate of the unknowns of a take."""

    habits: Array  # mask biases of both arches, shape (2, 3); see `View.habits`
    log_focal: Array  # logarithm of the ratio of true to calibrated focal length, shape (C,)

    @classmethod
    def unknown(cls, cameras: int) -> TakeState:
        """Return the initial estimate of the take's unknowns."""
        return cls(np.zeros((2, _HABITS)), np.zeros(cameras))

    def corrected(self, views: Sequence[View]) -> list[View]:
        """Return the views of a frame, corrected by the estimated biases and focal lengths."""
        pairs = zip(views, self.log_focal.tolist(), strict=True)
        return [replace(with_focal(view, log_focal), habits=self.habits) for view, log_focal in pairs]


class Unknowns:
    """Layout of the unknowns of frames and take, and normal equations in these unknowns.

    Attributes:
        local: number of unknowns per frame.
        shared: number of unknowns of the take.
        jaw: slice of the jaw parameters in the unknowns of a frame.
        head: slice of the head pose in the unknowns of a frame; None if the head is fixed.
    """

    def __init__(
        self,
        coordinates: Coordinates,
        frames: int,
        *,
        fixed_head: bool = False,
        free_focal: int = 0,
        habits: HabitPrior = DRAWN,
    ) -> None:
        """Lay out the unknowns; `free_focal` is the number of cameras if focal lengths are unknown, otherwise 0."""
        self._coordinates, self.fixed_head, self.free_focal = coordinates, fixed_head, free_focal
        self._sigma_habits = np.tile(habits.sigma, 2)
        self.local = LOCAL - 6 if fixed_head else LOCAL
        self.jaw = slice(self.local - 3, self.local)
        self.head = None if fixed_head else HEAD
        self._habits = slice(6 if fixed_head else 0, (6 if fixed_head else 0) + 2 * _HABITS)
        self.focal = slice(self._habits.stop, self._habits.stop + free_focal)
        self.shared = self.focal.stop
        # Factor by which the number of frames overstates the information about bias, since frames are not independent.
        self.redundancy = np.ones(self.shared)
        self.redundancy[self._habits] = max(1.0, frames / habits.frames)

    def prior(self, state: TakeState) -> tuple[Array, Array]:
        """Return the diagonal precision and right-hand side of the prior on the take's unknowns, shapes (G,)."""
        precision, off = np.zeros(self.shared), np.zeros(self.shared)
        precision[self._habits] = self.redundancy[self._habits] * self._sigma_habits**-2.0
        off[self._habits] = state.habits.ravel()
        precision[self.focal] = PRIOR_LOG_FOCAL**-2.0
        off[self.focal] = state.log_focal if self.free_focal else ()
        return precision, -precision * off

    def frame(self, fit: FrameFit, weight: Array, *, bounded: bool = True) -> tuple[Array, Array]:
        """Return the normal matrix (L + G, L + G) and right-hand side (L + G,) of a frame, from outlines and bound.

        Args:
            fit: fit of the frame, with outlines matched at its pose.
            weight: 1 / (outline variance times correlation length) of both arches [1/px^3], shape (2,).
            bounded: whether to include the bound of the rig.
        """
        pose, solution, found, size = fit.pose, fit.solution, fit.found, LOCAL + 2 * _HABITS + self.free_focal
        matrix, right = np.zeros((size, size)), np.zeros(size)
        if bounded:
            matrix[:LOCAL, :LOCAL], right[:LOCAL] = bound_equations(self._coordinates, pose.d)
        for r, slope in zip(ARCHES, self._coordinates.slopes(pose), strict=True):
            if solution is None or not found[r]:
                continue
            sums = solution.outline
            # The rows are the six twist components and the three biases of the arch.
            to_twist, to_habit = np.zeros((6, size)), np.zeros((_HABITS, size))
            to_twist[:, :LOCAL] = slope
            to_habit[:, LOCAL + _HABITS * r : LOCAL + _HABITS * (r + 1)] = np.eye(_HABITS)
            both = to_twist.T @ sums.habit_slope[r].sum(0).T @ to_habit
            own = to_twist.T @ sums.precision[r].sum(0) @ to_twist + to_habit.T @ sums.habit_weight[r].sum(0) @ to_habit
            matrix += weight[r] * (own + both + both.T)
            right += weight[r] * (to_twist.T @ sums.gradient[r].sum(0) + to_habit.T @ sums.habit_distance[r].sum(0))
            if fit.growth is not None and self.free_focal:
                columns = slice(size - self.free_focal, size)
                cross = weight[r] * (fit.growth.twist[r] @ to_twist + fit.growth.habit[r] @ to_habit)
                matrix[columns] += cross
                matrix[:, columns] += cross.T
                matrix[columns, columns] += weight[r] * np.diag(fit.growth.own[r])
                right[columns] += weight[r] * fit.growth.distance[r]
        if not self.fixed_head:
            return matrix, right
        order = np.r_[np.arange(LOCAL)[JAW], np.arange(LOCAL)[HEAD], np.arange(LOCAL, size)]
        return matrix[np.ix_(order, order)], right[order]

    def moved(
        self, poses: Sequence[Pose], state: TakeState, local: Array, shared: Array
    ) -> tuple[list[Pose], TakeState]:
        """Return poses and take state after a step of all unknowns, shapes (N, L) and (G,)."""
        steps = np.zeros((len(poses), LOCAL))
        steps[:, JAW] = local[:, self.jaw]
        steps[:, HEAD] = shared[:6] if self.fixed_head else local[:, HEAD]
        moved = [self._coordinates.moved(pose, step) for pose, step in zip(poses, steps, strict=True)]
        habits = state.habits + shared[self._habits].reshape(2, _HABITS)
        log_focal = state.log_focal + (shared[self.focal] if self.free_focal else 0.0)
        return moved, TakeState(habits, log_focal)
