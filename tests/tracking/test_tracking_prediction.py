"""Predictions of head and jaw, for consecutive frames and after dropped frames."""

from types import SimpleNamespace

import numpy as np
import pytest
from example_model import LANDMARKS_ANATOMICAL, example_arrays, example_meta

from jawusd.evaluator import JawRig
from jawusd.tracking.performance.coordinates import Coordinates, Pose
from jawusd.tracking.performance.motion import KNOWN, Prediction

BOTH = np.ones(2, bool)


@pytest.fixture(scope="module")
def coordinates():
    same = {"T_anatomical_skull": np.eye(4), "T_rest": np.eye(4), "landmarks": LANDMARKS_ANATOMICAL}
    scan = SimpleNamespace(centre=np.zeros(3))
    return Coordinates(JawRig({**example_arrays(), **same}, example_meta()), (scan, scan))


def following(coordinates, step_mm, frames=4, head=1.0):
    """Return the prediction after frames of uniform opening, and the last pose."""
    pose = Pose(np.eye(4), np.zeros(3))
    motion = Prediction(coordinates, pose, BOTH, head=head)
    for k in range(1, frames + 1):
        motion.expected()
        pose = Pose(np.eye(4), np.array([step_mm * k, 0.0, 0.0]))
        motion.take(pose, BOTH)
    return motion, pose


def test_a_motion_goes_on_and_dies_away(coordinates):
    """After long gaps, the extrapolation reaches the limit of a damped motion: 0.8 / (1 - 0.8) steps."""
    motion, last = following(coordinates, 0.5)
    one = motion.expected().pose.d[0] - last.d[0]
    assert 0.25 < one < 0.5
    assert one < motion.expected(2.0).pose.d[0] - last.d[0] < 2 * one
    assert motion.expected(100.0).pose.d[0] - last.d[0] == pytest.approx(0.5 * 4.0, abs=1e-6)


def test_frames_left_out_make_predictions_less_sure(coordinates):
    motion, _ = following(coordinates, 0.5)
    assert (motion.expected(3.0).precision < motion.expected().precision).all()


def test_speed_is_that_of_one_frame_however_many_were_left_out(coordinates):
    motion, last = following(coordinates, 0.5)
    motion.expected(4.0)
    later = Pose(np.eye(4), last.d + [2.0, 0.0, 0.0])
    motion.take(later, BOTH)
    assert motion.expected().pose.d[0] - later.d[0] == pytest.approx(0.8 * 0.5, abs=1e-9)


def test_what_is_out_of_sight_stands_still_and_gets_unsure(coordinates):
    motion, last = following(coordinates, 0.5)
    sure = motion.expected().precision
    for _ in range(5):
        motion.expected()
        motion.take(last, np.zeros(2, bool))
    np.testing.assert_allclose(motion.expected().pose.d, last.d)
    assert (motion.expected().precision < sure).all() and (motion.blind == 5).all()


def test_a_known_head_stays_where_it_is(coordinates):
    free, _ = following(coordinates, 0.5)
    known, _ = following(coordinates, 0.5, head=KNOWN)
    assert (known.expected().precision[:6] > 1e6 * free.expected().precision[:6]).all()
    np.testing.assert_allclose(known.expected().precision[6:], free.expected().precision[6:])


def test_a_jaw_from_elsewhere_is_predicted_with_its_own_variance(coordinates):
    """It replaces that of a hidden jaw until the next frame; the head is as uncertain as before."""
    motion, last = following(coordinates, 0.5)
    for _ in range(5):
        motion.expected()
        motion.take(last, np.zeros(2, bool))
    hidden = motion.expected()
    motion.carry(np.array([5.0, 1.0, 0.5]), np.array([0.04, 0.09, 0.01]))
    found = motion.expected()
    np.testing.assert_array_equal(found.pose.d, [5.0, 1.0, 0.5])
    np.testing.assert_allclose(found.precision[6:], 1 / (0.7**2 + np.array([0.04, 0.09, 0.01])))
    np.testing.assert_array_equal(found.precision[:6], hidden.precision[:6])
    motion.take(found.pose, np.zeros(2, bool))
    assert (motion.expected().precision < hidden.precision).all()
