"""The unknowns shared by all frames of a take, and the normal equations of a frame in all unknowns.

The shared unknowns are the annotator bias of the take; the head pose, if it is fixed; and unknown focal lengths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.tracking.contour.annotator import COMPONENTS, DRAWN, AnnotatorPrior, bias_layers
from jawusd.tracking.contour.scan import ARCHES
from jawusd.tracking.contour.views import View
from jawusd.tracking.initialization.magnification import magnified
from jawusd.tracking.performance.attempts import FrameFit
from jawusd.tracking.performance.coordinates import HEAD, JAW, LOCAL, Coordinates, Pose
from jawusd.tracking.performance.instant import Misfit, bound_equations
from jawusd.tracking.performance.views import PRIOR_LOG_FOCAL


@dataclass(frozen=True, eq=False)
class TakeState:
    """Current estimate of the unknowns of a take."""

    layers: Array  # annotator bias in the layers of `Unknowns`, shape (n,)
    habits: Array  # mask biases per arch and camera, shape (2, C, 3); see `View.habits`
    log_focal: Array  # logarithm of the ratio of true to calibrated focal length, shape (C,)

    def corrected(self, views: Sequence[View]) -> list[View]:
        """Return the views of a frame, corrected by the estimated biases and focal lengths."""
        pairs = enumerate(zip(views, self.log_focal.tolist(), strict=True))
        return [replace(magnified(view, float(np.exp(log))), habits=self.habits[:, c]) for c, (view, log) in pairs]


class Unknowns:
    """Layout of the unknowns of frames and take, and normal equations in these unknowns."""

    def __init__(
        self,
        coordinates: Coordinates,
        frames: int,
        cameras: int,
        *,
        fixed_head: bool = False,
        free_focal: bool = False,
        annotator: AnnotatorPrior = DRAWN,
    ) -> None:
        """Lay out the unknowns of a take with the given numbers of frames and cameras."""
        self._coordinates, self.fixed_head, self._cameras = coordinates, fixed_head, cameras
        self.free_focal = cameras if free_focal else 0
        sigma = annotator.sigma(cameras)
        self._layers, self._sigma = bias_layers(cameras)[..., sigma > 0], sigma[sigma > 0]
        self.local = LOCAL - 6 if fixed_head else LOCAL  # number of unknowns per frame
        self.jaw = slice(self.local - 3, self.local)  # the jaw parameters in the unknowns of a frame
        self.head = None if fixed_head else HEAD  # the head pose in the unknowns of a frame
        first = 6 if fixed_head else 0
        self._habits = slice(first, first + len(self._sigma))
        self.focal = slice(self._habits.stop, self._habits.stop + self.free_focal)
        self.shared = self.focal.stop  # number of unknowns of the take
        #: factor by which the number of frames overstates the information, since frames are not independent
        self.redundancy = np.ones(self.shared)
        self.redundancy[self._habits] = annotator.redundancy(frames)

    def start(self) -> TakeState:
        """Return the initial estimate of the take's unknowns."""
        none = np.zeros(len(self._sigma))
        return TakeState(none, self._layers @ none, np.zeros(self._cameras))

    def prior(self, state: TakeState) -> tuple[Array, Array]:
        """Return the diagonal precision and right-hand side of the prior on the take's unknowns, shapes (G,)."""
        precision, off = np.zeros(self.shared), np.zeros(self.shared)
        precision[self._habits] = self.redundancy[self._habits] * self._sigma**-2.0
        off[self._habits] = state.layers
        precision[self.focal] = PRIOR_LOG_FOCAL**-2.0
        off[self.focal] = state.log_focal if self.free_focal else ()
        return precision, -precision * off

    def frame(self, fit: FrameFit, weight: Array, bound_at: Array | None) -> tuple[Array, Array]:
        """Return the normal matrix (L + G, L + G) and right-hand side (L + G,) of a frame, from outlines and bound.

        `weight` is the `outline_weight` of `InstantSolver.align`; `bound_at` is the d (3,) at which the bound is
        linearised, None to omit it.
        """
        pose, solution, found = fit.pose, fit.solution, fit.found
        bias = slice(LOCAL, LOCAL + len(self._sigma))
        size = bias.stop + self.free_focal
        matrix, right = np.zeros((size, size)), np.zeros(size)
        if bound_at is not None:
            matrix[:LOCAL, :LOCAL], right[:LOCAL] = bound_equations(self._coordinates, pose.d, bound_at)
        slopes = self._coordinates.slopes(pose)
        for r, slope in zip(ARCHES, slopes.arches, strict=True):
            if solution is None or not found[r]:
                continue
            sums = solution.outline
            to_twist, to_habit = np.zeros((6, size)), np.zeros((self._cameras, COMPONENTS, size))
            to_twist[:, :LOCAL], to_habit[..., bias] = slope, self._layers[r]
            to_outline = np.tensordot(sums.habit_slope[r], to_habit, ((0, 1), (0, 1)))
            both = to_twist.T @ to_outline
            own = np.tensordot(to_habit, sums.habit_weight[r] @ to_habit, ((0, 1), (0, 1)))
            own += to_twist.T @ sums.precision[r].sum(0) @ to_twist
            matrix += weight[r] * (own + both + both.T)
            right += weight[r] * (
                to_twist.T @ sums.gradient[r].sum(0) + np.tensordot(sums.habit_distance[r], to_habit, 2)
            )
            if fit.growth is not None and self.free_focal:
                columns = slice(bias.stop, size)
                cross = fit.growth.twist[r] @ to_twist + np.einsum("ch,chn->cn", fit.growth.habit[r], to_habit)
                matrix[columns] += weight[r] * cross
                matrix[:, columns] += weight[r] * cross.T
                matrix[columns, columns] += weight[r] * np.diag(fit.growth.own[r])
                right[columns] += weight[r] * fit.growth.distance[r]
                to_outline[:, columns] += fit.growth.twist[r].T
            if r:
                precision, gradient = weight[r] * sums.precision[r].sum(0), weight[r] * sums.gradient[r].sum(0)
                coupling = precision @ to_twist + weight[r] * to_outline
                prior = self._coordinates.rig_error
                misfit = Misfit(prior, slopes.error, pose.misfit, (precision, gradient), coupling)
                matrix += misfit.matrix
                right += misfit.right
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
        layers = state.layers + shared[self._habits]
        log_focal = state.log_focal + (shared[self.focal] if self.free_focal else 0.0)
        return moved, TakeState(layers, self._layers @ layers, log_focal)
