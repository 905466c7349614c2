"""Alignment of head and jaw with the masks of one video frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.rendering import Rendering
from jawusd.tracking.contour.scan import ARCHES, thinned
from jawusd.tracking.contour.solver import ContourSolver, Matched
from jawusd.tracking.contour.views import View
from jawusd.tracking.performance.coordinates import HEAD, JAW, LOCAL, OPENING, Coordinates, Pose

# Standard deviation of the rig's soft bound, and distance beyond it from which the penalty grows linearly [mm]. Jaws
# leave the captured range by distances that are distributed exponentially, see docs/explanation/constants.md.
_BOUND_MM, _BOUND_LINEAR_MM = 1.0, 0.6
# Standard deviation of openings below the smallest captured one [mm]: closed teeth cannot close further.
CLOSED_MM = 0.1
_QUICK_FACES, _QUICK_REDRAW_PX = 6_000, 2.0


@dataclass(frozen=True, eq=False)
class Expected:
    """Prior on the poses of head and jaw in one video frame."""

    pose: Pose
    precision: Array  # inverse variances of the deviation from the expected pose, shape (9,)


@dataclass(frozen=True, eq=False)
class Aligned:
    """An alignment: the pose, its matched outlines, and the prior on the pose."""

    pose: Pose
    solution: Solution
    expected: Expected


class Misfit:
    """The misfit: the part of the mandible's pose that the rig cannot reproduce, as an unknown of every frame.

    Without it, masks of both arches that contradict the rig would push the head and the jaw away, or a correct mask
    would be left unmatched. Its prior is the covariance of the rig's own error. It is eliminated from the normal
    equations of a frame in N unknowns, and estimated after each step.

    Attributes:
        matrix, right: what the elimination adds to the normal matrix (N, N) and the right-hand side (N,).
        precision: precision of the lower arch's twist if the misfit is unknown, shape (6, 6).
    """

    def __init__(
        self,
        rig_error: Array,
        slope: Array,
        misfit: Array,
        sums: tuple[Array, Array],
        coupling: Array,
    ) -> None:
        """Eliminate the misfit at a pose.

        Args:
            rig_error: its prior covariance, as in `Coordinates`, shape (6, 6).
            slope: derivative of the lower arch's twist with respect to it, `Slopes.error`, shape (6, 6).
            misfit: misfit of the pose, shape (6,).
            sums: precision (6, 6) and gradient (6,) of the lower arch's twist, as in `Slopes`.
            coupling: block of the normal matrix that couples this twist with the unknowns, shape (6, N).
        """
        precision, gradient = sums
        self._slope, self._coupling = slope, coupling
        prior, offset = slope @ rig_error @ slope.T, slope @ misfit
        kept = np.linalg.inv(np.eye(6) + precision @ prior)
        self.precision, self._spread = kept @ precision, prior @ kept
        self._gradient = gradient + precision @ offset  # at zero misfit
        self.matrix = -coupling.T @ self._spread @ coupling
        self.right = coupling.T @ (offset - self._spread @ self._gradient)

    def after(self, step: Array) -> Array:
        """Return the misfit, shape (6,) [rad, mm], after a step of the unknowns, shape (N,)."""
        moved = self._spread @ (self._gradient - self._coupling @ step)
        return np.asarray(np.linalg.solve(self._slope, moved), np.float64)


class Equations(NamedTuple):
    """Normal equations of a step: matrix (9, 9), right-hand side (9,), and the misfit eliminated from them."""

    matrix: Array
    right: Array
    misfit: Misfit


class InstantSolver:
    """Gauss-Newton solver for head pose and jaw parameters; between frames, it keeps only renderings."""

    def __init__(self, solver: ContourSolver, coordinates: Coordinates) -> None:
        self.solver, self.coordinates = solver, coordinates
        self.config = solver.config

    def align(
        self,
        start: Pose,
        views: Sequence[View],
        use: Mask,
        gates_px: Sequence[float],
        expected: Expected,
        outline_weight: Array,
        rendering: Rendering | None = None,
    ) -> Aligned:
        """Return the most likely pose.

        Args:
            use: the masks to use, shape (2, C).
            gates_px: residual gate of every step.
            outline_weight: 1 / (outline variance times correlation length) of both arches [1/px^3], shape (2,).
            rendering: rendering of these views; default: a new rendering.
        """
        rendering = rendering or self.solver.rendering(views)
        pose, left, moved_mm = start, tuple(gates_px), np.inf
        while left:
            state = self.linearise(pose, views, use, rendering, left[0])
            matrix, right, misfit = self.equations(pose, state, outline_weight)
            away = self.coordinates.step(expected.pose, pose)
            pulled = right - expected.precision * away
            step = np.asarray(np.linalg.solve(matrix + np.diag(expected.precision), pulled), np.float64)
            pose = replace(self.coordinates.moved(pose, step), misfit=misfit.after(step))
            moved_mm = self._motion_mm(step)
            left = self.config.gates_after(left, moved_mm)
        if moved_mm > self.config.judged_mm:
            state = self.linearise(pose, views, use, rendering, self.config.final_gate_px[1], final=True)
        return Aligned(pose, state, expected)

    def linearise(
        self,
        pose: Pose,
        views: Sequence[View],
        use: Mask,
        rendering: Rendering,
        gate: float,
        final: bool = False,
        matched: list[Matched] | None = None,
    ) -> Solution:
        """Match the outlines at a pose and accumulate their normal equations; see `ContourSolver.linearise`."""
        return self.solver.linearise(self.coordinates.arches(pose), views, use, gate, rendering, final, matched)

    def equations(self, pose: Pose, state: Solution, outline_weight: Array) -> Equations:
        """Return the equations of a step, from matched outlines and the rig's bound."""
        matrix, right = bound_equations(self.coordinates, pose.d)
        outlines = self.outline_equations(pose, state, outline_weight)
        return Equations(matrix + outlines.matrix, right + outlines.right, outlines.misfit)

    def outline_equations(self, pose: Pose, state: Solution, outline_weight: Array) -> Equations:
        """Return the part of `equations` from matched outlines."""
        outline, slopes = state.outline, self.coordinates.slopes(pose)
        precision = [outline_weight[r] * outline.precision[r].sum(0) for r in ARCHES]
        gradient = [outline_weight[r] * outline.gradient[r].sum(0) for r in ARCHES]
        upper, lower = slopes.arches
        coupling = precision[1] @ lower
        sums = precision[1], gradient[1]
        misfit = Misfit(self.coordinates.rig_error, slopes.error, pose.misfit, sums, coupling)
        return Equations(
            upper.T @ precision[0] @ upper + lower.T @ coupling + misfit.matrix,
            upper.T @ gradient[0] + lower.T @ gradient[1] + misfit.right,
            misfit,
        )

    def _motion_mm(self, step: Array) -> float:
        """Return an estimate of the distance by which a step moves the crowns [mm]."""
        turn = float(np.linalg.norm(step[HEAD][:3])) * self.solver.scans[0].radius_mm
        return turn + float(np.linalg.norm(step[HEAD][3:])) + float(np.linalg.norm(step[JAW]))


def bound_equations(coordinates: Coordinates, d: Array, at: Array | None = None) -> tuple[Array, Array]:
    """Return normal matrix (9, 9) and right-hand side (9,) of the penalties on poses outside the bound or overclosed.

    Outlines of closed teeth fit nearly as well with the lower teeth some millimetres higher, inside the upper teeth.
    The penalties at d (3,) are linearised at the jaw parameters `at` (3,); default: `d`.
    """
    matrix, right = np.zeros((LOCAL, LOCAL)), np.zeros(LOCAL)
    at = d if at is None else at
    margin = float(coordinates.jaw.margin(at))
    if margin < 0:
        gradient = coordinates.jaw.margin_gradient(at)
        weight = min(1.0, _BOUND_LINEAR_MM / -margin) / _BOUND_MM**2  # Huber's weight
        matrix[JAW, JAW] = weight * np.outer(gradient, gradient)
        right[JAW] = -weight * gradient * (margin + gradient @ (d - at))
    if at[0] < coordinates.closed_mm:
        matrix[OPENING, OPENING] += CLOSED_MM**-2.0
        right[OPENING] += (coordinates.closed_mm - float(d[0])) / CLOSED_MM**2
    return matrix, right


def rig_gain(coordinates: Coordinates, pose: Pose, matrix: Array, lower: Array, *, fixed_head: bool = False) -> Array:
    """Return the derivative (3, 6) of the estimated d with respect to an error of the rig, from one frame.

    Where the outlines determine d poorly, an error of the rig is amplified: the head and d move until the outlines fit.
    `matrix` is the normal matrix of the frame, positive definite, shape (9, 9); `lower` is the precision of the lower
    arch's twist, shape (6, 6), as in `Misfit`.
    """
    free = JAW if fixed_head else slice(0, LOCAL)
    slopes = coordinates.slopes(pose)
    gain = np.linalg.solve(matrix[free, free], slopes.arches[1][:, free].T @ lower @ slopes.error)
    return np.asarray(gain[-3:], np.float64)


def quick(solver: ContourSolver) -> ContourSolver:
    """Return a solver with decimated scans and less frequent rendering, for the many steps of the first pass."""
    scans = [thinned(replace(scan.thin or scan, thin=None), _QUICK_FACES) for scan in solver.scans]
    return ContourSolver(scans, replace(solver.config, redraw_px=_QUICK_REDRAW_PX))


def whole(solver: ContourSolver) -> ContourSolver:
    """Return a solver that always uses all faces of the scans."""
    return ContourSolver([replace(scan, thin=None) for scan in solver.scans], solver.config)
