"""Condylar motion as a function of the incisal point, learned from a synthetic joint that is not polynomial."""

from dataclasses import replace

import numpy as np
import pytest
from example_tracks import make_tracks

from jawusd.geometry import make_transform, relative_pose, se3_exp, so3_exp, transform_point
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person
from jawusd.tracking.contour.equations import NormalEquations, OutlineSums, Solution, motion_about
from jawusd.tracking.region.jaw_priors import CondyleMotion, CondyleTerm, widen_strained

SURE = np.diag([1e-6] * 3 + [1e-4] * 3)
HEAD = make_transform(so3_exp(np.array([0.3, -2.0, 0.4])), [12.0, -30.0, 210.0])
AXES = so3_exp(np.array([0.1, 0.2, -0.3]))  # of a scan that is not in anatomical axes
BITE_SCAN = make_transform(AXES, [5.0, -40.0, 9.0])


inverse = np.linalg.inv


def jaws(person, frames=400):
    """Return T_upper_lower in the axes of the scan, shape (F, 4, 4)."""
    return inverse(BITE_SCAN) @ record(person, frames, seed=3).T_true @ BITE_SCAN


def taught(person, poses):
    landmarks = transform_point(inverse(BITE_SCAN), person.landmarks)
    motion = CondyleMotion(landmarks, AXES)
    for relative in poses:
        motion.learn(relative, SURE)
    return motion, landmarks


def state(poses):
    nothing = np.zeros((2, 6, 6))
    centres = np.array([[3.0, -2.0, 200.0], [1.0, 4.0, 205.0]])
    return Solution(poses, OutlineSums.zeros(1), centres, nothing, nothing, np.zeros((2, 1)))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_poses_of_the_same_jaw_are_expected_and_others_are_not(seed):
    person = Person(seed)
    poses = jaws(person)
    motion, landmarks = taught(person, poses[::2])
    strains = [motion.strain(relative) / 6 for relative in poses[1::2]]
    assert np.mean(strains) < 1.0 and np.percentile(strains, 99) < 4.0
    molars = landmarks[1:3].mean(0)
    turned = make_transform(np.eye(3), molars) @ se3_exp(np.append(np.deg2rad(-4.0) * AXES[0], np.zeros(3)))
    wrong = turned @ make_transform(np.eye(3), -molars)
    raised = [motion.strain(relative @ wrong) / 6 for relative in poses[1::20]]
    assert np.min(raised) > 8.0


def test_without_frames_both_sides_are_expected_alike():
    motion, _ = taught(Person(4), [])
    right_ahead, left_ahead = (motion.expected(np.array([x, -12.0, -3.0]))[0].reshape(2, 3) for x in (6.0, -6.0))
    assert right_ahead == pytest.approx(left_ahead[::-1] * [-1, 1, 1])
    assert right_ahead[1, 2] > right_ahead[0, 2] + 3.0  # the right condyle advances if the jaw moves to the left
    closed, wide = (np.sqrt(motion.expected(np.array([0.0, y, y / 3]))[2]) for y in (0.0, -30.0))
    assert closed == pytest.approx(np.sqrt(np.tile([1.09, 1.64, 1.25], 2)))  # uncertainty of the bite alone
    assert (wide > closed).all() and wide.max() < 6.0


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_jaws_open_about_as_others_do(seed):
    person = Person(seed)
    motion, landmarks = taught(person, [])
    for opening in np.linspace(0.0, 0.9, 6):
        true = inverse(BITE_SCAN) @ person.pose(opening, 0.0, 0.0) @ BITE_SCAN
        incisor, condyles = ((transform_point(true, landmarks) - landmarks) @ AXES.T)[[0, -1]]
        found = (transform_point(motion.placed(0.0, -incisor[1], 0.0), landmarks) - landmarks) @ AXES.T
        assert np.abs(found[0] - incisor).max() < 4.0
        assert np.abs(found[-1] - condyles).max() < 4.0


def test_frames_that_do_not_show_the_condyles_teach_little():
    person = Person(5)
    poses = jaws(person, frames=60)
    known = taught(person, poses)[0].expected(np.array([0.0, -10.0, -4.0]))[2]
    motion = CondyleMotion(transform_point(inverse(BITE_SCAN), person.landmarks), AXES)
    for relative in poses:
        motion.learn(relative, np.diag([0.01] * 3 + [25.0] * 3))
        motion.learn(relative, np.diag([np.inf] * 6))
    assert (motion.expected(np.array([0.0, -10.0, -4.0]))[2] > 2.0 * known).all()


def test_the_term_adds_the_slopes_of_finite_differences():
    person = Person(6)
    poses = jaws(person)
    motion, _ = taught(person, poses)
    now = np.stack([HEAD, HEAD @ poses[77]])
    residual, _, variance = motion.residual(poses[77])
    slope, step = np.zeros((6, 12)), 1e-5
    for r in (0, 1):
        for k in range(6):
            moved = now.copy()
            moved[r] = motion_about(state(now).centres[r], step * np.eye(6)[k]) @ now[r]
            slope[:, 6 * r + k] = (motion.residual(relative_pose(*moved))[0] - residual) / step
    equations = NormalEquations()
    CondyleTerm(motion, 54.0).accumulate(state(now), equations)
    expected = 54.0 * slope.T @ (slope / variance[:, None])
    assert equations.matrix == pytest.approx(expected, rel=1e-2, abs=2e-3 * np.abs(expected).max())
    right = -54.0 * slope.T @ (residual / variance)
    assert equations.right == pytest.approx(right, rel=1e-2, abs=2e-3 * np.abs(right).max())


def test_the_term_brings_condyles_back():
    person = Person(7)
    poses = jaws(person)
    motion, _ = taught(person, poses)
    now = np.stack([HEAD, HEAD @ poses[50] @ se3_exp(np.append(np.deg2rad(-3.0) * AXES[0], np.zeros(3)))])
    before = motion.strain(relative_pose(*now))
    for _ in range(8):
        equations = NormalEquations()
        equations.add_joint(np.diag([1e4] * 6 + [1e-2] * 6), np.zeros(12))  # a clearly visible head
        CondyleTerm(motion, 54.0).accumulate(state(now), equations)
        step = equations.solve()
        now = np.stack([motion_about(state(now).centres[r], step[r]) @ now[r] for r in (0, 1)])
    assert motion.strain(relative_pose(*now)) < 0.02 * before


def test_frames_whose_condyles_are_out_of_the_way_claim_less():
    person, count = Person(8), 200
    poses = jaws(person, count)
    molars = make_transform(np.eye(3), transform_point(inverse(BITE_SCAN), person.landmarks)[1:3].mean(0))
    poses[60:63] = poses[60:63] @ molars @ se3_exp(np.append(np.deg2rad(-4.0) * AXES[0], np.zeros(3))) @ inverse(molars)
    poses[9] = np.nan
    tracks = replace(
        make_tracks(count),
        **{name: np.tile(HEAD, (count, 1, 1)) for name in ("T_world_upper", "raw_T_world_upper")},
        **{name: HEAD @ poses for name in ("T_world_lower", "raw_T_world_lower")},
        **{name: poses for name in ("T_upper_lower", "raw_T_upper_lower")},
        **{f"covariance_{name}": np.tile(SURE, (count, 1, 1)) for name in ("upper", "lower", "relative")},
    )
    landmarks = transform_point(inverse(BITE_SCAN), person.landmarks)
    wider = widen_strained(tracks, landmarks, AXES).covariance_relative[:, 3, 3] / SURE[3, 3]
    assert (wider[60:63] > 10.0).all()
    assert np.delete(wider, [60, 61, 62]) == pytest.approx(1.0)
    assert widen_strained(replace(tracks, raw_T_world_lower=tracks.raw_T_world_lower * np.nan), landmarks, AXES)
