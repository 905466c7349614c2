"""How fast a jaw moves, against numpy's covariances of motion without noise."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta, moving_arrays

from jawusd.base.errors import EvaluatorError
from jawusd.evaluator import JawRig, Speeds


def take(fps, seconds=80.0, seed=0):
    """Chewing-like motion, smooth, of three correlated parameters [mm]."""
    rng = np.random.default_rng(seed)
    times = np.arange(int(seconds * fps)) / fps
    waves = rng.uniform(0.3, 3.0, (12, 1)) * times + rng.uniform(0, 1, (12, 1))
    return (np.sin(2 * np.pi * waves).T @ rng.normal(size=(12, 3))) * [6.0, 2.0, 1.0]


def covariance(d, order, fps):
    changes = np.diff(d, order, axis=0) * fps**order
    return changes.T @ changes / len(changes)


def assert_alike(found, expected, share):
    """The root mean squares along every direction agree to a share."""
    root = np.linalg.cholesky(expected)
    sizes = np.linalg.eigvalsh(np.linalg.solve(root, np.linalg.solve(root, found).T))
    np.testing.assert_allclose(np.sqrt(sizes), 1.0, atol=share)


@pytest.mark.parametrize("fps", [24.0, 50.0, 120.0])
@pytest.mark.parametrize("noise_mm", [0.0, 0.05])
def test_noise_of_the_take_does_not_count_as_motion(fps, noise_mm):
    d = take(fps)
    speeds = Speeds.of_take(d + noise_mm * np.random.default_rng(1).normal(size=d.shape), fps)
    assert_alike(speeds.velocity, covariance(d, 1, fps), 0.02)
    # at 120 frames per second noise is 20 times the motion's own acceleration of d3, squared
    assert_alike(speeds.acceleration, covariance(d, 2, fps), 0.03 if fps < 100 else 0.25)
    np.testing.assert_allclose(speeds.rms_mm_s**2, np.diag(speeds.velocity))
    np.testing.assert_allclose(speeds.rms_mm_s2**2, np.diag(speeds.acceleration))


def test_lost_frames_are_left_out():
    d = take(50.0)
    gaps = d.copy()
    gaps[100:120] = np.nan
    assert_alike(Speeds.of_take(gaps, 50.0).acceleration, Speeds.of_take(d, 50.0).acceleration, 0.03)


def test_a_motion_along_one_line_has_speeds_that_can_be_inverted():
    speeds = Speeds.of_take(take(24.0) * [1.0, 0.0, 0.0], 24.0)
    assert np.linalg.eigvalsh(speeds.velocity).min() > 0
    assert np.linalg.eigvalsh(Speeds.of_take(np.zeros((50, 3)), 24.0).acceleration).min() > 0


@pytest.mark.parametrize(
    ("d", "fps", "message"),
    [
        (np.zeros((40, 2)), 24.0, r"\(40, 2\)"),
        (np.zeros((40, 3)), 0.0, "positive"),
        (np.zeros((33, 3)), 24.0, "consecutive"),
    ],
)
def test_unusable_takes_are_rejected(d, fps, message):
    with pytest.raises(ValueError, match=message):
        Speeds.of_take(d, fps)


def test_rigs_hold_them():
    rig = JawRig({**example_arrays(), **moving_arrays()}, example_meta())
    np.testing.assert_array_equal(rig.speeds.acceleration, moving_arrays()["acceleration_covariance"])
    plain = JawRig(example_arrays(), example_meta())
    assert plain.speeds is None
    assert plain.model_hash != rig.model_hash
    for wrong in (np.diag([1.0, -1.0, 1.0]), np.triu(np.ones((3, 3))) + 3 * np.eye(3)):
        with pytest.raises(EvaluatorError, match="velocity_covariance"):
            JawRig({**example_arrays(), **moving_arrays(), "velocity_covariance": wrong}, example_meta())
