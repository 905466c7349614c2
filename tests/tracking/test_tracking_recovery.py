"""Lost frames are searched once, and what is found replaces known poses only where it may."""

from dataclasses import dataclass

import numpy as np
import pytest

from jawusd.tracking.region.recovery import contradicts, lost_stretches, nearest_found, recover, replace_poses

FRAMES = range(10, 30)


@dataclass
class Pose:
    """A pose that is a number."""

    value: float
    is_found: bool = True
    fit: float = 1.0

    @property
    def found(self):
        return np.array([True, self.is_found])


def take(lost=()):
    return {frame: Pose(float(frame), frame not in lost) for frame in FRAMES}


def replaced(known, others):
    way = range(min(others), max(others) + 1)
    return replace_poses(
        way,
        (others[frame] for frame in way),
        known,
        lambda other, before: abs(other.value - before.value) < 0.1,
        lambda other, before: other.fit > before.fit,
    )


def test_stretches_of_three_lost_frames_or_more_are_searched():
    known = take([10, 12, 13, 16, 17, 18, 27, 28, 29])
    assert lost_stretches(known, FRAMES) == [range(16, 19), range(27, 30)]
    assert nearest_found(known, range(16, 19)).value == 15.0
    assert nearest_found(known, range(10, 11)).value == 11.0


def test_every_stretch_is_searched_once_and_what_is_left_of_it_again():
    """A search in 14 to 23 finds the teeth from 20 on; there is nothing to find before."""
    known, searched = take(range(14, 24)), []

    def again(lost):
        searched.append(lost)
        return {frame: Pose(float(frame)) for frame in range(20, 24)} if 20 in lost else None

    recover(known, FRAMES, again)
    assert searched == [range(14, 24), range(14, 20)]
    assert lost_stretches(known, FRAMES) == [range(14, 20)]


def test_a_take_without_any_teeth_is_left_alone():
    known = take(FRAMES)
    recover(known, FRAMES, lambda lost: nearest_found(known, lost))
    assert lost_stretches(known, FRAMES) == [FRAMES]


def test_equal_poses_end_a_replacement():
    known = take([20, 21, 22])
    assert replaced(known, {frame: Pose(float(frame)) for frame in range(20, 28)}) is True
    assert not lost_stretches(known, FRAMES)


@pytest.mark.parametrize(("fit", "ended"), [(0.9, False), (1.1, None)])
def test_different_poses_are_replaced_by_better_ones_only(fit, ended):
    known = take()
    assert replaced(known, {frame: Pose(-1.0, fit=fit) for frame in range(20, 25)}) is ended
    assert [known[frame].value for frame in range(20, 25)] == ([20, 21, 22, 23, 24] if ended is False else [-1] * 5)


def test_a_lost_frame_ends_a_replacement():
    known = take([20, 21, 22])
    assert replaced(known, {20: Pose(20.0), 21: Pose(21.0, False), 22: Pose(22.0)}) is None
    assert [bool(known[frame].found.all()) for frame in (20, 21, 22)] == [True, False, False]


@pytest.mark.parametrize(
    ("meetings", "wrong"),
    [
        ((True, True), False),
        ((True, False), False),
        ((None, None), False),
        ((None, False), True),
        ((False, False), True),
    ],
)
def test_poses_that_only_contradict_others_are_refused(meetings, wrong):
    assert contradicts(list(meetings)) is wrong
