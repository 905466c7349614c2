"""Dropped frames and late cameras, found by the neighbouring masks that fit best."""

import numpy as np
import pytest

from jawusd.tracking.sequence.time_checks import SHIFTS, FrameShifts

FRAMES = np.arange(40, 52)


def _shifts(*shown: tuple[int, ...]) -> FrameShifts:
    """Return shifts with the best fit at the given shift of every frame and camera."""
    fit = np.full((len(FRAMES), len(shown), len(SHIFTS)), -0.2)
    for c, best in enumerate(shown):
        fit[np.arange(len(FRAMES)), c, [SHIFTS.index(shift) for shift in best]] = 0.4
    return FrameShifts(FRAMES, fit)


def test_a_step_is_located():
    found = _shifts((0,) * 12, (0,) * 7 + (-1,) * 5).clearest()
    assert found == (1, 1, 47)  # it shows the instant after


def test_the_camera_that_steps_most_clearly_is_named():
    shifts = _shifts((0,) * 7 + (1,) * 5, (0,) * 7 + (-1,) * 5)
    shifts.fit[7:, 0, 0] = 0.25  # the poses follow one camera, so the other seems to step too
    assert shifts.clearest().camera == 1


@pytest.mark.parametrize("wrong", [(3,), (3, 8), (10, 11)])
def test_single_wrong_masks_are_not_a_step(wrong):
    best = np.zeros(12, int)
    best[list(wrong)] = -1
    assert _shifts((0,) * 12, tuple(best.tolist())).clearest() is None


def test_two_wrong_masks_do_not_hide_a_step():
    best = np.repeat([0, 1], 6)
    best[[1, 9]] = 1, -1
    assert _shifts((0,) * 12, tuple(best.tolist())).clearest().frames == -1


def test_a_camera_late_from_the_start_is_not_a_step():
    shifts = _shifts((0,) * 12, (-1,) * 12)
    assert shifts.clearest() == (1, 1, None)
    shifts.fit[:5, 0, 0] = 0.6  # the poses follow it sometimes
    assert shifts.clearest() == (1, 1, None)
    assert _shifts((0,) * 12, (0,) * 12).clearest() is None


def test_masks_that_never_fit_are_not_a_shift():
    shifts = _shifts((0,) * 12, (0,) * 7 + (-1,) * 5)
    shifts.fit[:] -= 0.7  # a wrong lens, for example
    assert shifts.clearest() is None
    assert shifts.is_timely(0)


@pytest.mark.parametrize(("better", "found"), [(0.0, False), (0.25, True)])
def test_a_step_that_lost_the_jaw_is_found_where_its_camera_fits_better_than_the_others(better, found):
    shifts = _shifts((0,) * 12, (0,) * 7 + (-1,) * 5, (0,) * 12)
    shifts.fit[7:] -= 0.8
    shifts.fit[7:, 1, SHIFTS.index(-1)] += better
    assert (shifts.clearest() == (1, 1, 47)) == found


def test_a_jaw_at_rest_gives_no_evidence():
    still = FrameShifts(FRAMES, np.random.default_rng(0).normal(0.4, 0.01, (12, 3, 3)))
    assert still.clearest() is None
    unseen = FrameShifts(FRAMES, np.full((12, 3, 3), np.nan))
    assert unseen.clearest() is None
