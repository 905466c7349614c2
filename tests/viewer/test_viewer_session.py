"""Session without a page: sliders, dragging, pins, keys, undo."""

import numpy as np
import pytest
from example_rig import FPS, example_rig

from jawusd.base.errors import FormatError
from jawusd.formats.keys import Key, Keys
from jawusd.geometry import LANDMARKS
from jawusd.viewer.session import Session

RIG = example_rig()


@pytest.fixture
def session():
    return Session(RIG, FPS)


def place(d, index):
    T = RIG.pose(d)
    return T[:3, :3] @ RIG.landmarks[index] + T[:3, 3]


def test_begins_closed_and_valid(session):
    np.testing.assert_allclose(session.d, 0, atol=0.3)
    assert session.readout().inside and session.work.fps == FPS and not session.dragging


def test_ends_of_d2_and_d3_follow_the_opening_as_the_rig_says(session):
    for opening in (0.0, 8.0, 20.0):
        session.set_parameter(0, opening)
        assert session.d[0] == pytest.approx(opening, abs=1e-12)
        expected = np.array(RIG.ranges(*session.d)).reshape(2, 2)
        np.testing.assert_allclose(session.limits()[1:], expected, atol=1e-9)
        np.testing.assert_array_equal(session.limits()[0], RIG.d_range[0])


def test_sliders_stop_at_the_bound_only_where_asked_to(session):
    session.set_parameter(0, 15.0)
    _, high, *_ = RIG.ranges(15.0)
    session.set_parameter(1, 50.0)
    np.testing.assert_allclose(session.d, [15.0, high, 0.0], atol=1e-6)
    session.set_keep_valid(False)
    session.set_parameter(1, 50.0)
    assert session.d[1] == 50.0 and not session.readout().inside
    session.undo()
    assert session.d[1] == pytest.approx(high)  # switching is a separate undo step
    session.redo()
    session.set_keep_valid(True)
    assert session.readout().inside
    np.testing.assert_allclose(session.d, RIG.project([15.0, 50.0, 0.0]), atol=1e-9)


def test_the_opening_wins_and_takes_d2_and_d3_with_it(session):
    """Opening wide in laterotrusion keeps the opening and reduces the laterotrusion as little as possible."""
    session.set_parameter(0, 5.0)
    session.set_parameter(1, 50.0)
    side = session.d[1]
    wide = float(RIG.d_range[0, 1]) * 0.9
    session.set_parameter(0, wide)
    assert session.d[0] == pytest.approx(wide) and 0 < session.d[1] < side and session.readout().inside
    nearly = session.d * [1, 1.05, 1.05]
    assert float(RIG.margin(nearly)) < 0
    session.set_parameter(0, 1000.0)
    assert session.readout().inside and session.d[0] <= RIG.d_range[0, 1] + 1e-9


def test_limits_stay_numbers_outside_the_bound(session):
    session.set_keep_valid(False)
    for d in ([0, 0, 300.0], [300.0, 0, 0], [-50.0, 5, 5]):
        session.set_pose(d)
        limits = session.limits()
        assert np.isfinite(limits).all() and (limits[:, 0] <= limits[:, 1]).all()


def test_values_that_are_no_numbers_are_refused(session):
    with pytest.raises(ValueError, match="d2 must be finite"):
        session.set_parameter(1, float("nan"))


def test_a_drag_follows_the_pointer_as_inverse_kinematics_does(session):
    session.set_parameter(0, 12.0)
    start = session.d
    chin = place(start, 0)
    session.grab(chin)
    target = chin + RIG.T_anatomical_skull[:3, :3].T @ [5.0, 0.0, 0.0]
    for share in np.linspace(0.1, 1.0, 10):
        aim = session.drag_to(chin + share * (target - chin))
    found, distance = RIG.ik(RIG.landmarks[0], target, start=start)
    assert np.linalg.norm(place(session.d, 0) - place(found, 0)) < 0.1
    left = np.linalg.norm(session.grabbed_point() - aim)
    assert left == pytest.approx(float(distance), abs=0.01) and session.readout().inside
    np.testing.assert_allclose(session.grabbed_point(), place(session.d, 0), atol=1e-9)
    session.release()
    assert session.grabbed_point() is None
    session.undo()
    np.testing.assert_allclose(session.d, start)  # a drag is a single undo step


def test_dragging_nothing_is_refused(session):
    with pytest.raises(RuntimeError):
        session.drag_to([0, 0, 0])


@pytest.mark.parametrize("name", ["condyle_left", "condyle_right"])
def test_a_pinned_condyle_stays_while_the_chin_is_dragged(session, name):
    index = LANDMARKS.index(name)
    moved = {}
    for pinned in (False, True):
        session.set_pose([8.0, 0.0, 0.0])
        session.set_pin(name, pinned)
        before = place(session.d, index)
        chin = place(session.d, 0)
        session.grab(chin)
        session.drag_to(chin + RIG.T_anatomical_skull[:3, :3].T @ [0.0, 3.0, 4.0])
        moved[pinned] = np.linalg.norm(place(session.d, index) - before)
        session.release()
    assert moved[True] < 0.35 * moved[False] and moved[True] < 0.5
    session.set_pin(name, False)
    assert session.work.pins == ()


def test_undo_and_redo_walk_through_every_kind_of_change(session):
    states = [session.work]
    for change in (
        lambda: session.set_parameter(0, 10.0),
        lambda: session.set_pin("condyle_left", True),
        lambda: session.add_key(0),
        lambda: session.set_interpolation("linear"),
        lambda: session.set_fps(30.0),
        lambda: session.load_keys(Keys(fps=12, keys=(Key(frame=3, d=(1, 0, 0)),))),
    ):
        change()
        states.append(session.work)
    for state in states[-2::-1]:
        assert session.undo() and session.work == state
    assert not session.undo()
    for state in states[1:]:
        assert session.redo() and session.work == state
    assert not session.redo()
    session.undo()
    session.set_parameter(0, 3.0)
    assert not session.redo()  # a new change clears the redo history


def test_a_run_of_slider_moves_is_one_step_and_playing_is_none(session):
    for value in (1.0, 2.0, 3.0):
        session.set_parameter(0, value)
    session.set_parameter(1, 0.5)
    session.undo()
    assert session.d[0] == 3.0 and session.d[1] == 0.0
    session.show([9.0, 1.0, 0.0])
    session.undo()
    np.testing.assert_allclose(session.d, 0, atol=0.3)


def test_dragging_keys_along_the_timeline_is_one_step(session):
    keys = (Key(frame=0, d=(0, 0, 0)), Key(frame=10, d=(10, 0, 0)))
    session.load_keys(Keys(fps=24, interpolation="linear", keys=keys))
    before = session.work
    for last in (12, 16, 20):
        session.move_keys([0, last], 5)
        np.testing.assert_allclose(session.d, [50 / last, 0, 0])
    with pytest.raises(FormatError, match="every key needs its own frame"):
        session.move_keys([20, 20], 5)
    assert session.undo() and session.work == before


@pytest.mark.parametrize("interpolation", ["linear", "smooth"])
def test_the_keys_play_as_the_rig_interpolates(session, interpolation):
    assert session.key_clip() is None and session.saved_keys() is None
    poses = {0: [2.0, 0, 0], 12: [18.0, 2.0, 0.5], 30: [5.0, -1.0, 1.0]}
    for frame, d in poses.items():
        session.set_pose(d)
        session.add_key(frame)
    session.set_interpolation(interpolation)
    clip = session.key_clip()
    at = np.arange(0, 31)
    expected = RIG.interpolate(list(poses), [RIG.project(d) for d in poses.values()], at, interpolation)
    np.testing.assert_allclose(clip.at(at), expected, atol=1e-9)
    assert clip.span == (0.0, 30.0) and clip.fps == FPS
    saved = session.saved_keys()
    assert saved.interpolation == interpolation and [key.frame for key in saved.keys] == [0, 12, 30]


@pytest.mark.parametrize("interpolation", ["linear", "smooth"])
def test_keys_outside_play_inside_unless_told_otherwise(session, interpolation):
    keys = tuple(Key(frame=frame, d=d) for frame, d in ((0, (10, 0, 0)), (20, (15, 14, 0)), (40, (10, 0, 0))))
    session.load_keys(Keys(fps=24, interpolation=interpolation, keys=keys))
    at = np.arange(0, 40.05, 0.1)
    played = session.key_clip()
    assert RIG.margin(played.at(at)).min() > -1e-6 and session.key_clip() is played
    session.set_keep_valid(False)
    free = session.key_clip()
    np.testing.assert_allclose(free.at([0, 20, 40]), [key.d for key in keys], atol=1e-12)
    step, own = (np.linalg.norm(np.diff(clip.at(np.arange(41)), axis=0), axis=1) for clip in (played, free))
    assert (step <= 1.05 * own + 1e-9).all()


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), 1e9])
def test_impossible_frame_rates_are_refused(session, fps):
    with pytest.raises(ValueError, match="fps"):
        session.set_fps(fps)


def test_two_sessions_share_nothing():
    one, other = Session(RIG, FPS), Session(RIG, FPS)
    one.set_parameter(0, 12.0)
    one.add_key(0)
    one.set_pin("incisor", True)
    assert other.work.keys == () and other.work.pins == () and other.d[0] < 1.0
