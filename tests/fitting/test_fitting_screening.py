"""Screening of tracking failures of centimetres before a spline is fitted."""

import numpy as np
import pytest

from jawusd.fitting import FittingConfig, fit_model
from jawusd.fitting.data import REASON, SubjectAnatomy, gross_outliers, screened, select_poses
from jawusd.geometry import make_transform, se3_exp
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person


@pytest.fixture(scope="module")
def person():
    return Person(1)


@pytest.fixture(scope="module")
def anatomy(person):
    to_anatomical = make_transform(np.eye(3), -person.landmarks[0])
    return SubjectAnatomy.of(to_anatomical, person.landmarks, person.mandible_points, None)


@pytest.fixture(scope="module")
def poses(person):
    return record(person, 500, 1, "training").T_noisy


def knocked(poses, count, rad, mm):
    """Return the poses with some displaced in random directions, and which ones."""
    rng = np.random.default_rng(3)
    rows = np.sort(rng.choice(len(poses), count, replace=False))
    out = poses.copy()
    for k in rows:
        turn, move = rng.normal(size=(2, 3))
        twist = np.r_[rad * turn / np.linalg.norm(turn), mm * move / np.linalg.norm(move)]
        out[k] = se3_exp(twist) @ out[k]
    return out, rows


def select(poses, anatomy):
    return select_poses(np.arange(100, 100 + len(poses)), poses, anatomy)


def test_clean_takes_lose_nothing(poses, anatomy):
    selection = select(poses, anatomy)
    assert not gross_outliers(selection.data).any() and screened(selection) is selection


@pytest.mark.parametrize("count", [1, 6, 50])
def test_failures_of_centimetres_are_named(poses, anatomy, count):
    bad, rows = knocked(poses, count, 0.5, 40.0)
    selection = screened(select(bad, anatomy))
    assert selection.excluded[REASON] == (100 + rows).tolist()
    assert not selection.used[rows].any() and len(selection.data) == selection.used.sum() == len(poses) - count


def test_pure_opening_and_few_poses_are_left_alone(person, anatomy, poses):
    opening = np.clip(np.sin(np.linspace(0, 20, 200)), 0, None) * 0.9
    hinge = person.pose(opening, np.zeros(200), np.zeros(200))
    assert not gross_outliers(select(hinge[opening > 0], anatomy).data).any()
    assert not gross_outliers(select(knocked(poses[::10], 3, 0.5, 40.0)[0], anatomy).data).any()


@pytest.mark.slow
def test_bounds_do_not_reach_out_to_failures(person, poses):
    bad, rows = knocked(poses, 12, 0.5, 40.0)
    ranges = []
    for given in (poses, bad):
        model = fit_model(
            (np.arange(len(given)), given),
            T_anatomical_skull=make_transform(np.eye(3), -person.landmarks[0]),
            landmarks=person.landmarks,
            mandible_vertices=person.mandible_points,
            config=FittingConfig(holdout_folds=0),
        )
        ranges.append(model.arrays["d_range"])
    assert not model.trained[rows].any()
    np.testing.assert_allclose(ranges[1], ranges[0], atol=0.6)
