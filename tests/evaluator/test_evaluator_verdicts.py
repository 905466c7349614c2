"""Verdicts on poses and parameters: each reason alone, thresholds, speeds, and implausible poses by the thousand."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta

from jawusd.evaluator import JawRig, Reason
from jawusd.geometry.se3 import se3_exp

RIG = JawRig(example_arrays(), example_meta())
INSIDE = RIG.project(np.random.default_rng(0).uniform(*RIG.d_range.T, (400, 3)) * 0.9)


def reasons(verdicts):
    return [Reason(int(code)) for code in verdicts.reason.ravel()]


def test_poses_of_valid_parameters_are_valid():
    verdicts = RIG.validate(RIG.pose(INSIDE))
    assert verdicts.valid.all() and not verdicts.reason.any()
    np.testing.assert_allclose(verdicts.d, INSIDE, atol=1e-7)
    assert verdicts.residual_mm.max() < 1e-7
    np.testing.assert_allclose(verdicts.margin_mm, RIG.margin(INSIDE), atol=1e-7)


def test_points_on_the_bound_count_as_inside():
    """Parameters projected onto the bound round to either side of it when read back from poses."""
    edge = RIG.project(np.random.default_rng(1).uniform([-6, -14, -6], [50, 14, 12], (500, 3)))
    assert RIG.validate(RIG.pose(edge)).valid.all()


def test_each_reason_is_named():
    T = RIG.pose([15.0, 1.0, 1.0])
    nan, infinite, scaled, mirrored, off = (T.copy() for _ in range(5))
    nan[2, 1] = np.nan
    infinite[0, 3] = np.inf
    scaled[:3, :3] *= 1.01
    mirrored[:3, 0] *= -1.0
    off = se3_exp([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]) @ off
    outside = RIG.pose([15.0, 14.0, 1.0])
    verdicts = RIG.validate(np.stack([T, nan, infinite, scaled, mirrored, off, outside]))
    assert reasons(verdicts)[:5] == [
        Reason.VALID,
        Reason.NOT_FINITE,
        Reason.NOT_FINITE,
        Reason.NOT_RIGID,
        Reason.NOT_RIGID,
    ]
    assert Reason.OFF_MODEL in reasons(verdicts)[5]
    assert reasons(verdicts)[6] == Reason.OUTSIDE_BOUNDS
    np.testing.assert_array_equal(verdicts.valid, [True] + [False] * 6)
    assert np.isnan(verdicts.d[1:5]).all() and np.isnan(verdicts.margin_mm[1:5]).all()
    assert verdicts.margin_mm[6] == pytest.approx(float(RIG.margin([15.0, 14.0, 1.0])))
    assert verdicts.words()[0] == "inside" and verdicts.words()[6] == "outside"
    assert Reason(12).words == "off the model, outside"


def test_thresholds_are_the_rigs_and_can_be_overridden():
    T = se3_exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.5]) @ RIG.pose(INSIDE)
    residual_mm = RIG.encode(T)[1]
    verdicts = RIG.validate(T, residual_limit_mm=float(np.median(residual_mm)), tolerance_mm=50.0)
    np.testing.assert_array_equal(verdicts.valid, residual_mm <= np.median(residual_mm))
    assert RIG.limits.residual_mm == 0.9
    strict = JawRig(dict(RIG.arrays, residual_limit_mm=np.array(1e-9)), RIG.meta)
    assert not strict.validate(T).valid.any()
    outside = np.array([15.0, 9.0, 1.0])
    by_mm = -float(RIG.margin(outside))
    assert not RIG.validate_parameters(outside, tolerance_mm=by_mm - 0.01).valid
    assert RIG.validate_parameters(outside, tolerance_mm=by_mm + 0.01).valid


def test_speed_is_asked_for_between_consecutive_poses():
    d = np.zeros((6, 3))
    d[:, 0] = [0.0, 1.0, 2.0, 12.0, 13.0, 14.0]
    times = np.arange(6) / 24.0
    for verdicts in (
        RIG.validate(RIG.pose(d), times_s=times, speed_limit_mm_s=150.0),
        RIG.validate_parameters(d, times_s=times, speed_limit_mm_s=150.0),
    ):
        assert [bool(r & Reason.TOO_FAST) for r in reasons(verdicts)] == [False, False, False, True, False, False]
    # twice the time between frames, half the speed
    assert not (RIG.validate(RIG.pose(d), times_s=2 * times, speed_limit_mm_s=150.0).reason & Reason.TOO_FAST).any()


def test_as_many_poses_as_landmarks_are_no_pairs():
    d = np.zeros((5, 3))
    d[4, 0] = 10.0
    for verdicts in (
        RIG.validate(RIG.pose(d), times_s=np.arange(5.0), speed_limit_mm_s=5.0),
        RIG.validate_parameters(d, times_s=np.arange(5.0), speed_limit_mm_s=5.0),
    ):
        assert [bool(r & Reason.TOO_FAST) for r in reasons(verdicts)] == [False] * 4 + [True]


def test_speed_is_measured_from_the_last_good_frame():
    """Across a lost frame, and not from a frame that was itself invalid."""
    d = np.zeros((3, 3))
    d[:, 0] = [0.0, np.nan, 30.0]
    verdicts = RIG.validate_parameters(d, times_s=[0.0, 0.1, 0.2], speed_limit_mm_s=10.0)
    assert reasons(verdicts) == [Reason.VALID, Reason.NOT_FINITE, Reason.TOO_FAST]
    assert RIG.validate_parameters(d, times_s=[0.0, 0.1, 9.0], speed_limit_mm_s=10.0).valid[2]
    glitch = np.zeros((2, 5, 3))
    glitch[0, 2] = [15.0, 14.0, 1.0]  # outside the bound
    glitch[1, 2] = [15.0, 0.0, 0.0]  # possible, but too far
    verdicts = RIG.validate_parameters(glitch, times_s=np.arange(5.0), speed_limit_mm_s=5.0)
    np.testing.assert_array_equal(verdicts.valid, [[True, True, False, True, True]] * 2)
    assert reasons(verdicts)[2] == Reason.OUTSIDE_BOUNDS | Reason.TOO_FAST and reasons(verdicts)[7] == Reason.TOO_FAST


def test_a_lasting_jump_is_accepted_once_there_was_time_for_it():
    d = np.zeros((6, 3))
    d[1:, 0] = 10.0
    verdicts = RIG.validate_parameters(d, times_s=np.arange(6.0), speed_limit_mm_s=3.0)
    assert verdicts.valid.tolist() == [True, False, False, False, True, True]


def take(seed):
    """Return poses of a take with steps of a few mm, glitches of every kind, and their times."""
    rng = np.random.default_rng(seed)
    d = RIG.project(np.cumsum(rng.normal(size=(120, 3)), axis=0) * [1.0, 0.3, 0.3] + [15.0, 0.0, 0.0])
    d[::17, 0] += 12.0
    d[5::19, 1] += 14.0
    T = RIG.pose(d)
    T[10:14] = np.nan
    T[::23, :3, :3] *= 1.02
    T[::29] = se3_exp([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]) @ T[::29]
    return T, np.cumsum(rng.uniform(0.02, 0.06, 120))


@pytest.mark.parametrize(
    "given", [{}, {"speed_limit_mm_s": 80.0}, {"speed_limit_mm_s": 150.0, "tolerance_mm": 0.0, "bound": "polygons"}]
)
@pytest.mark.parametrize("seed", range(3))
def test_a_stream_is_judged_as_its_poses_together(given, seed):
    T, times = take(seed)
    batch = RIG.validate(T, times_s=times, **given)
    stream = RIG.verdicts(**given)
    found = [stream(pose, time) for pose, time in zip(T, times)]
    assert [int(each.reason) for each in found] == batch.reason.tolist()
    assert [bool(each.valid) for each in found] == batch.valid.tolist()
    assert [each.words()[0] for each in found] == batch.words()
    for name in ("residual_mm", "margin_mm", "d"):
        np.testing.assert_allclose([getattr(each, name) for each in found], getattr(batch, name), rtol=0, atol=1e-9)
    last = np.flatnonzero(batch.valid)[-1]
    assert stream.last_good.time_s == times[last]
    np.testing.assert_array_equal(stream.last_good.T_skull_mandible, T[last])
    if "speed_limit_mm_s" in given:
        assert any(Reason.TOO_FAST in reason for reason in reasons(batch))


def test_a_stream_rejects_what_is_no_next_pose():
    stream = RIG.verdicts(speed_limit_mm_s=100.0)
    assert stream(RIG.pose([5.0, 0.0, 0.0]), 1.0).valid
    for time_s in (1.0, 0.5, np.nan, np.inf):
        with pytest.raises(ValueError, match="time_s"):
            stream(RIG.pose([5.0, 0.0, 0.0]), time_s)
    with pytest.raises(ValueError, match="shape"):
        stream(RIG.pose(np.zeros((1, 3))), 2.0)
    with pytest.raises(ValueError, match="bound"):
        RIG.verdicts(bound="box")


@pytest.mark.parametrize("times", [None, [0.0, 1.0], [0.0, 1.0, 1.0]])
def test_a_speed_limit_needs_rising_times(times):
    with pytest.raises(ValueError, match="times_s"):
        RIG.validate(RIG.pose(np.zeros((3, 3))), times_s=times, speed_limit_mm_s=100.0)


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2), (0,)])
def test_verdicts_have_the_batch_shape(shape):
    d = np.random.default_rng(2).uniform(0, 5, (*shape, 3)).astype(np.float32)
    for verdicts in (RIG.validate(RIG.pose(d).astype(np.float32)), RIG.validate_parameters(d)):
        assert verdicts.valid.shape == verdicts.reason.shape == verdicts.residual_mm.shape == shape
        assert verdicts.margin_mm.shape == shape and verdicts.d.shape == (*shape, 3)


def test_parameters_are_judged_by_the_bound_alone():
    d = np.random.default_rng(3).uniform([-6, -14, -6], [50, 14, 12], (500, 3))
    d[0] = np.nan
    verdicts = RIG.validate_parameters(d)
    np.testing.assert_array_equal(verdicts.valid[1:], RIG.margin(d[1:]) >= 0)
    assert reasons(verdicts)[0] == Reason.NOT_FINITE
    assert np.isnan(verdicts.residual_mm[0]) and not verdicts.residual_mm[1:].any()


def test_the_papers_polygons_can_judge_instead():
    corner = np.array([2.0, 8.0, 5.5])  # inside both outlines, outside the joint section
    assert RIG.validate_parameters(corner, bound="polygons").valid
    assert not RIG.validate_parameters(corner).valid


def test_implausible_poses_are_refused():
    """Random twists of plausible size, poses knocked 3 mm and 3 degrees off the model, mirrored and half-turned."""
    rng = np.random.default_rng(4)
    T = RIG.pose(INSIDE)
    random_twists = rng.uniform(-1, 1, (2500, 6)) * ([0.5, 0.2, 0.2, 15.0, 30.0, 20.0])
    directions = rng.normal(size=(2500, 2, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    knock = np.concatenate([np.deg2rad(3.0) * directions[:, 0], 3.0 * directions[:, 1]], axis=1)
    centre = RIG.landmarks.mean(axis=0)
    shift = np.eye(4)
    shift[:3, 3] = centre
    knocked = T[rng.integers(len(T), size=2500)] @ shift @ se3_exp(knock) @ np.linalg.inv(shift)
    A = RIG.T_anatomical_skull
    turn = np.eye(4)
    turn[:3, :3] = RIG.pose([40.0, 0.0, 0.0])[:3, :3]
    rotated = np.linalg.inv(A) @ turn @ A @ RIG.T_rest
    mirrored = T[:500].copy()
    mirrored[:, 0] *= -1.0
    poses = np.concatenate([se3_exp(random_twists) @ RIG.T_rest, knocked, rotated[None], mirrored])
    assert (~RIG.validate(poses).valid).mean() >= 0.99


def test_reasons_print_their_names():
    assert str(Reason.OFF_MODEL | Reason.TOO_FAST) == "OFF_MODEL|TOO_FAST" and str(Reason.VALID) == "VALID"
    assert "OFF_MODEL" in repr(Reason(4))
