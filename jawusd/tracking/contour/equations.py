"""The normal equations of one Gauss-Newton step, and the residual terms that contribute to them.

The unknowns are the left twists (omega [rad], v [mm]) of both arches about their centres. Each constraint on the two
poses is a `ResidualTerm`, passed to `ContourSolver.solve`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import make_transform, se3_exp, se3_inverse, se3_log


def translation(t: Array) -> Array:
    """Return the translation by a vector [mm], shape (3,), as a transform (4, 4)."""
    return make_transform(np.eye(3), t)


def motion_about(centre: Array, twist: Array) -> Array:
    """Return the transform of a twist (..., 6) about a world point (3,), shape (..., 4, 4)."""
    motion = se3_exp(twist)
    motion[..., :3, 3] += centre - motion[..., :3, :3] @ centre
    return motion


def twist_between(start: Array, end: Array, centre: Array) -> Array:
    """Return the twist about a world point (3,) that takes one pose (4, 4) to another, shape (6,)."""
    motion = end @ se3_inverse(start)
    motion[:3, 3] += motion[:3, :3] @ centre - centre
    return se3_log(motion)


class OutlineSums(NamedTuple):
    """Sums over matched contour samples per arch and view: weight w, distance d to the mask edge [px], derivative J.

    Annotator bias has three components: at tooth edges [px], at the gum line in the image [px], and at the gum line
    along the crown surface [mm]. It shifts the outline by their scalar product with h, the last columns of a sample.
    At the end of an alignment with masks, smooth outline errors are eliminated from the first five sums (see
    `without_smooth_errors`).
    """

    precision: Array  # sum w J^T J, shape (2, C, 6, 6)
    gradient: Array  # sum w J d, shape (2, C, 6)
    habit_slope: Array  # sum w h J, which couples poses with mask biases, shape (2, C, 3, 6)
    habit_distance: Array  # sum w h d, shape (2, C, 3)
    habit_weight: Array  # sum w h h^T, shape (2, C, 3, 3)
    weight: Array  # sum w, shape (2, C)
    square: Array  # sum w d^2, shape (2, C)
    matched_px: Array  # contour length with residuals within the gate, shape (2, C)
    score_px: Array  # contour length weighted by 1 minus Tukey's loss at the score gate, shape (2, C)

    @classmethod
    def zeros(cls, cameras: int) -> OutlineSums:
        """Return zero sums for a number of views."""
        shapes: tuple[tuple[int, ...], ...] = ((6, 6), (6,), (3, 6), (3,), (3, 3), (), (), (), ())
        return cls(*(np.zeros((2, cameras, *shape)) for shape in shapes))


@dataclass(frozen=True, eq=False)
class Solution:
    """Poses with their linearised residuals: the state of an iteration, and the result of an alignment."""

    poses: Array  # T_world_upper and T_world_lower, shape (2, 4, 4)
    outline: OutlineSums  # sums over the matched samples of silhouettes, borders of the scans and crown-gum lines
    centres: Array  # centres of the twists in world coordinates [mm], shape (2, 3)
    scatters: Array  # first result of `scatter_of_tiles` (outline errors) per arch, summed over views, shape (2, 6, 6)
    gum_scatters: Array  # second result (gum-line errors) per arch, summed over views, shape (2, 6, 6)
    visible_px: Array  # contour length that could have been matched, per arch and view [px], shape (2, C)


class NormalEquations:
    """Normal equations of both arches' twists.

    Attributes:
        matrix, right: precision (12, 12) and right-hand side (12,), with the upper arch first.
        outline_weight: weight of the outline sums per arch [1/px^3], shape (2,): 1, or 1 / (outline variance times
            correlation length) if other terms are log-likelihoods.
    """

    def __init__(self, outline_weight: Array | None = None) -> None:
        self.matrix, self.right = np.zeros((12, 12)), np.zeros(12)
        self.outline_weight = np.ones(2) if outline_weight is None else outline_weight

    def add(self, arch: int, precision: Array, right: Array) -> None:
        """Add the precision (6, 6) and right-hand side (6,) of a constraint on one arch."""
        own = slice(6 * arch, 6 * arch + 6)
        self.matrix[own, own] += precision
        self.right[own] += right

    def add_joint(self, precision: Array, right: Array) -> None:
        """Add the precision (12, 12) and right-hand side (12,) of a joint constraint on both arches."""
        self.matrix += precision
        self.right += right

    def solve(self) -> Array:
        """Solve the equations; return the twists of both arches, shape (2, 6)."""
        return np.asarray(np.linalg.solve(self.matrix, self.right), np.float64).reshape(2, 6)


class ResidualTerm(Protocol):
    """A constraint on the poses of both arches, as a sum of squared residuals."""

    def accumulate(self, state: Solution, equations: NormalEquations) -> None:
        """Add the term's linearised residuals at the poses of a state."""
        ...


class OutlineTerm:
    """Penalises the distances of visible contours from the edges of their masks."""

    def accumulate(self, state: Solution, equations: NormalEquations) -> None:
        """Add the sums over the matched samples of all views."""
        sums = state.outline
        for arch, weight in enumerate(equations.outline_weight):
            equations.add(arch, weight * sums.precision[arch].sum(0), weight * sums.gradient[arch].sum(0))


@dataclass(frozen=True, eq=False)
class StartTerm:
    """A weak prior at the start pose, which bounds motions that the masks do not constrain."""

    start: Array  # T_world_upper and T_world_lower, shape (2, 4, 4)
    strength: Array  # precision of each twist component, in units of the outline's normal equations, shape (2, 6)

    def accumulate(self, state: Solution, equations: NormalEquations) -> None:
        """Add the prior, linearised at the poses of a state."""
        for arch, weight in enumerate(equations.outline_weight):
            away = twist_between(self.start[arch], state.poses[arch], state.centres[arch])
            strength = weight * self.strength[arch]
            equations.add(arch, np.diag(strength), -strength * away)
