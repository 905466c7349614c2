"""The bite prior keeps lower teeth from penetrating the upper ones, and has no other effect."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jawusd.tracking.contour.equations import NormalEquations, OutlineSums, Solution, motion_about
from jawusd.tracking.region.jaw_priors import BiteTerm

POINTS = np.array([[0.0, -3.0, 20.0], [18.0, -2.0, -10.0], [-18.0, -2.0, -10.0]])
UP = np.array([0.0, 1.0, 0.0])
TERM = BiteTerm(POINTS, UP, 50.0)


def state(lift_mm):
    """Return a head with a random pose whose lower teeth lie above the closed bite by some height."""
    head = np.eye(4)
    head[:3, :3], head[:3, 3] = Rotation.from_rotvec([0.3, -0.4, 0.2]).as_matrix(), [10.0, -20.0, 300.0]
    jaw = np.eye(4)
    jaw[:3, 3] = lift_mm * UP
    poses = np.stack([head, head @ jaw])
    centres = np.stack([poses[r, :3, 3] + [1.0, 2.0, 3.0] for r in (0, 1)])
    none = np.zeros((2, 6, 6))
    return Solution(poses, OutlineSums.zeros(1), centres, none, none, np.zeros((2, 1)))


def cost(poses):
    """Return half the weighted sum of squared heights above the closed bite, with fixed weights."""
    here = (poses[1, :3, :3] @ POINTS.T).T + poses[1, :3, 3]
    closed = (poses[0, :3, :3] @ POINTS.T).T + poses[0, :3, 3]
    return np.maximum((here - closed) @ (poses[0, :3, :3] @ UP), 0.0)


@pytest.mark.parametrize("lift_mm", [0.0, -0.5, -20.0])
def test_open_and_closed_jaws_are_left_alone(lift_mm):
    equations = NormalEquations()
    TERM.accumulate(state(lift_mm), equations)
    assert not equations.matrix.any() and not equations.right.any()


def test_the_slope_is_that_of_the_heights():
    found, equations = state(0.3), NormalEquations()
    TERM.accumulate(found, equations)
    slopes = np.empty((3, 12))
    for k in range(12):
        heights = []
        for sign in (1, -1):
            twist = np.zeros(12)
            twist[k] = sign * 1e-5
            moved = [motion_about(c, t) @ p for c, t, p in zip(found.centres, twist.reshape(2, 6), found.poses)]
            heights.append(cost(np.stack(moved)))
        slopes[:, k] = (heights[0] - heights[1]) / 2e-5
    weight = 50.0 / 0.2**2 * 4.0 / (4.0 + (0.3 / 0.2) ** 2)
    assert equations.matrix == pytest.approx(weight * slopes.T @ slopes, rel=1e-4, abs=1e-2)
    assert equations.right == pytest.approx(-weight * slopes.T @ np.full(3, 0.3), rel=1e-4, abs=1e-2)


def test_scans_that_are_registered_wrongly_are_not_forced_together():
    pulls = []
    for lift_mm in (0.4, 3.0):
        equations = NormalEquations()
        TERM.accumulate(state(lift_mm), equations)
        pulls.append(np.abs(equations.right[9:]).max())
    assert pulls[1] < 0.5 * pulls[0]
