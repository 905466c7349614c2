"""A take is followed both ways, later poses judge earlier ones, and lost frames are searched once."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from jawusd.base.errors import TrackingError
from jawusd.tracking.follow import Begin, TwoWays, lost_stretches, nearest_found

FRAMES = range(10, 30)


@dataclass
class Pose:
    """A pose that is a number, the position of the lower teeth [mm]."""

    value: float
    is_found: bool = True
    fit: float = 1.0
    uncertain: bool = False
    has_upper: bool = True

    @property
    def found(self):
        return np.array([self.has_upper, self.is_found])


@dataclass
class Tracker:
    """Yield poses that move with the frame number, or given others; record what is asked for.

    If `start` is given, the others are yielded from there only.
    """

    others: dict = field(default_factory=dict)
    start: float | None = None
    asked: list = field(default_factory=list)

    def __call__(self, way, pose):
        self.asked.append((pose.value, list(way)))
        others = self.others if self.start in (None, pose.value) else {}
        return iter([others.get(frame, Pose(float(frame))) for frame in way])


def of_frames(**given):
    return TwoWays(FRAMES, lambda pose: np.array([[pose.value, 0.0, 0.0]]), lambda pose: pose.fit, 1.05, **given)


def take(lost=(), wrong=None):
    known = {frame: Pose(float(frame), frame not in lost) for frame in FRAMES} | (wrong or {})
    return of_frames(known=known)


def replaced(known, others):
    way = range(min(others), max(others) + 1)
    return known.replace(way, iter([others[frame] for frame in way]))


def values(known):
    return {frame: pose.value for frame, pose in known.known.items()}


def test_stretches_of_three_lost_frames_or_more_are_searched():
    known = take([10, 12, 13, 16, 17, 18, 27, 28, 29]).known
    assert lost_stretches(known, FRAMES) == [range(16, 19), range(27, 30)]
    assert nearest_found(known, range(16, 19)).value == 15.0
    assert nearest_found(known, range(10, 11)).value == 11.0


def test_every_stretch_is_searched_once_and_what_is_left_of_it_again():
    """A search in 14 to 23 finds the teeth from 20 on; there is nothing to find before."""
    known, searched = take(range(14, 24)), []
    tracker = Tracker({frame: Pose(0.0, False) for frame in range(14, 20)})

    def search(lost, near):
        searched.append((lost, near.value))
        if 20 not in lost:
            raise TrackingError("no teeth")
        return Begin(20, Pose(20.0), tracker)

    known.recover(search)
    assert searched == [(range(14, 24), 13.0), (range(14, 20), 13.0)]
    assert lost_stretches(known.known, FRAMES) == [range(14, 20)]


def test_a_take_without_any_teeth_is_left_alone():
    known = take(FRAMES)
    known.recover(lambda lost, near: pytest.fail("nothing to start from"))
    assert lost_stretches(known.known, FRAMES) == [FRAMES]


@pytest.mark.parametrize(("other", "kept"), [([], True), ([13], True), ([13, 17], False)])
def test_what_a_search_finds_is_discarded_if_it_only_contradicts(other, kept):
    """Lost in 14 to 16; the teeth found in 15 are followed to the known poses of 13 and 17."""
    known = take([14, 15, 16])
    before = values(known)
    tracker = Tracker({frame: Pose(9.0) for frame in other})
    known.recover(lambda lost, near: Begin(15, Pose(15.0, fit=2.0), tracker))
    assert (lost_stretches(known.known, FRAMES) == []) is kept
    assert kept or values(known) == before


@pytest.mark.parametrize(("apart_mm", "kept"), [(0.5, True), (1.5, False)])
def test_what_a_search_finds_is_kept_if_it_differs_little_from_known_poses(apart_mm, kept):
    known = take([14, 15, 16])
    tracker = Tracker({frame: Pose(frame + apart_mm) for frame in (13, 17)})
    known.recover(lambda lost, near: Begin(15, Pose(15.0), tracker))
    assert (lost_stretches(known.known, FRAMES) == []) is kept
    assert (known.known[13].value, known.known[17].value) == (13.0, 17.0)


@pytest.mark.parametrize("own", [0.5, 1.5])
def test_frames_found_by_a_search_are_followed_with_the_colours_of_the_take_too(own):
    """Lost in 14 to 16, found in 15; `own` is the fit with the colours of the take, 1 with those of frame 15."""
    known = take([14, 15, 16])
    begin = Begin(15, Pose(15.0), Tracker({frame: Pose(frame + 0.1, fit=1.0) for frame in (14, 16)}))
    follow = Tracker({frame: Pose(frame - 0.1, fit=own) for frame in (14, 16)})
    known.fit_px = lambda pose: 1.0
    known.recover(lambda lost, near: begin, follow, lambda pose: pose.fit)
    off_mm = 0.1 if own < 1.0 else -0.1
    assert [known.known[frame].value for frame in range(13, 18)] == [13.0, 14 + off_mm, 15.0, 16 + off_mm, 17.0]


def test_equal_poses_end_a_replacement():
    known = take([20, 21, 22])
    assert replaced(known, {frame: Pose(float(frame)) for frame in range(20, 28)}) is True
    assert not lost_stretches(known.known, FRAMES)


@pytest.mark.parametrize(("fit", "ended"), [(1.04, False), (1.1, None)])
def test_different_poses_are_replaced_by_better_ones_only(fit, ended):
    known = take()
    assert replaced(known, {frame: Pose(-1.0, fit=fit) for frame in range(20, 25)}) is ended
    assert [known.known[frame].value for frame in range(20, 25)] == (
        [20, 21, 22, 23, 24] if ended is False else [-1] * 5
    )


def test_uncertain_poses_keep_the_better_fit():
    known = take(wrong={21: Pose(0.0, fit=2.0, uncertain=True), 22: Pose(0.0, fit=0.5, uncertain=True)})
    known.known[20].is_found = False
    assert replaced(known, {frame: Pose(float(frame)) for frame in range(20, 28)}) is True
    assert [known.known[frame].value for frame in (20, 21, 22, 23)] == [20.0, 0.0, 22.0, 23.0]


@pytest.mark.parametrize(("patience", "lost"), [(1, [21, 22]), (2, [22])])
def test_following_back_goes_on_through_a_few_lost_frames(patience, lost):
    known = take([21, 22, 23])
    known.patience = patience
    followed = [Pose(23.0), Pose(22.0, False), Pose(21.0), Pose(20.0)]
    assert known.replace(range(23, 19, -1), iter(followed)) is (True if patience > 1 else None)
    assert [frame for frame in FRAMES if not known.known[frame].is_found] == lost


def test_an_arch_that_is_gained_alone_is_kept():
    known = take([20, 21])
    known.known[21].has_upper = False
    assert known.replace(range(21, 19, -1), iter([Pose(21.0, False), Pose(20.0, False)])) is None
    assert known.known[21].has_upper


def test_doubted_poses_are_not_trusted():
    """Poses equal to doubted ones do not end a replacement, nor do better doubted ones; these are kept."""
    known = take(wrong={21: Pose(0.0, fit=2.0)})
    followed = iter([Pose(frame + 0.1) for frame in range(20, 28)])
    assert known.replace(range(20, 28), followed, range(20, 23)) is True
    assert [known.known[frame].value for frame in (20, 21, 22, 23)] == [20.1, 0.0, 22.1, 23.0]


def test_a_lost_frame_ends_a_replacement():
    known = take([20, 21, 22])
    assert replaced(known, {20: Pose(20.0), 21: Pose(21.0, False), 22: Pose(22.0)}) is None
    assert [bool(known.known[frame].found.all()) for frame in (20, 21, 22)] == [True, False, False]


@pytest.mark.parametrize("step", [1, -1])
def test_teeth_are_followed_back_from_where_they_were_found(step):
    """Lost from the third frame on, and found in the eighth: the frames before it are followed again."""
    start = FRAMES[0] if step > 0 else FRAMES[-1]
    way = range(start + step, FRAMES[10] + step, step)
    tracker = Tracker({frame: Pose(float(frame), False) for frame in way[2:7]}, start)
    known = of_frames()
    known.follow(Begin(start, Pose(float(start)), tracker))
    assert [asked for asked in tracker.asked if asked[0] != start] == [(way[7], list(way[6::-1]))]
    assert not lost_stretches(known.known, FRAMES, 1)


@pytest.mark.parametrize("at_once", [False, True])
def test_frames_are_followed_back_at_the_end_or_while_their_images_are_in_memory(at_once):
    """Lost from 12 to 14: the frames before 15 are read after 29, or right after 15."""
    read = []

    def follow(way, pose):
        for frame in way:
            read.append(frame)
            yield Pose(float(frame), pose.value != 10.0 or frame not in (12, 13, 14))

    of_frames(at_once=at_once).follow(Begin(10, Pose(10.0), follow))
    again = [14, 13, 12, 11]
    assert read == [*range(11, 16), *again, *range(16, 30)] if at_once else [*range(11, 30), *again]


def test_a_jaw_that_jumps_is_followed_back():
    """Wrong from 18 to 21: the poses that jump are followed back, and the correct ones replace the wrong ones."""
    tracker = Tracker({frame: Pose(frame + 2.0, fit=0.5) for frame in range(18, 22)}, 10)
    known = of_frames()
    known.follow(Begin(10, Pose(10.0), tracker))
    assert values(known) == {frame: float(frame) for frame in FRAMES}


def test_jumps_are_plausible_if_other_evidence_judges_poses():
    tracker = Tracker({frame: Pose(frame + 2.0, fit=0.5) for frame in range(18, 22)}, 10)
    known = of_frames(jump_mm=np.inf)
    known.follow(Begin(10, Pose(10.0), tracker))
    assert [frame for frame, value in values(known).items() if value != frame] == [18, 19, 20, 21]


def test_progress_counts_the_frames_followed():
    told = []
    known = of_frames(progress=lambda *step: told.append(step))
    known.follow(Begin(15, Pose(15.0), Tracker()))
    assert told == [(k, 20) for k in range(1, 21)]


def test_poses_that_nothing_confirms_are_uncertain():
    """Lost from 20 on, wrong from 17 on; the way back differs there, and agrees with 16."""
    known = take(range(20, 30), {frame: Pose(frame + 3.0) for frame in (17, 18, 19)})
    known.jump_mm = np.inf
    tracker = Tracker({18: Pose(21.5), 17: Pose(18.0)})
    assert known.unconfirmed(tracker) == pytest.approx({19: 0.5, 18: 0.5, 17: 2.0})
    assert tracker.asked == [(22.0, list(range(18, 9, -1)))]


@pytest.mark.parametrize(("fit", "doubted"), [(1.0, [17, 18, 19]), (1.1, [18, 19])])
def test_a_pose_that_fits_clearly_better_needs_no_confirmation(fit, doubted):
    known = take(range(20, 30), {17: Pose(17.0, fit=fit)})
    assert sorted(known.unconfirmed(Tracker({18: Pose(21.5), 17: Pose(18.0)}))) == doubted


@pytest.mark.parametrize(("fit", "doubted"), [(1.0, range(20, 30)), (1.1, ())])
def test_poses_after_a_jump_are_uncertain_unless_they_fit_clearly_better(fit, doubted):
    """From 20 on, poses are 3 mm from those followed from 19; before it, both agree."""
    known = take((), {frame: Pose(frame + 3.0, fit=fit) for frame in range(20, 30)})
    assert known.unconfirmed(Tracker()) == dict.fromkeys(doubted, 3.0)


def test_both_sides_of_a_loss_are_uncertain():
    known = take([20, 21])
    assert known.unconfirmed(Tracker()) == {19: 0.5, 22: 0.5}
    known.known[19] = Pose(23.0)  # 4 mm from the motion of its neighbours
    assert known.unconfirmed(Tracker()) == {19: 4.0, 22: 0.5}
