"""The jaw learned from the four ARKit jaw weights of synthetic persons, whose weights follow the chin."""

import numpy as np
import pytest
from face_takes import JAW_FPS, Performer

from jawusd.base.errors import FittingError
from jawusd.fitting.face import check_jaw_weights, columns_at, offsets_between, refined_offset
from jawusd.fitting.skin import clock_offset, fit_skin
from jawusd.formats.arkit import shares_of


@pytest.fixture(scope="module")
def take():
    """Return a person, its face capture, and times and d of the jaw."""
    performer = Performer(5)  # the one of twelve that fixed shares fit best
    face, _, measured = performer.perform("training")
    d, _ = performer.rig.encode(measured)
    return performer, face, np.arange(len(d)) / JAW_FPS, d


def test_what_is_learned_poses_the_mandible_better_than_fixed_shares(take):
    """Tested on other exercises, with clocks 1.7 s apart, and frames without a face or a jaw."""
    performer, face, times, d = take
    weights, seen = face.X.copy(), np.ones(len(d), bool)
    weights[300:330] = np.nan
    seen[500:520] = False
    face_s = face.frames / face.fps
    offset_s = clock_offset(face_s, weights, times[seen] + 1.7, d[seen])
    assert abs(offset_s - 1.7) < 0.012
    skin = fit_skin(performer.rig, columns_at(face_s + offset_s, weights, times + 1.7), d, seen)
    other, truth, _ = performer.perform("hidden", 2000, 2)
    at = other.frames / other.fps
    shares = performer.incisal_error(performer.rig.denormalized(shares_of(other.X)), at, truth)
    own = performer.incisal_error(skin(other.X).d, at, truth)
    assert own <= 0.6 * shares
    assert 0.7 < skin.errors_mm["skin"] / own < 1.3


def test_offsets_are_refined_below_their_step(take):
    """The best of the coarse offsets is 0.04 s off."""
    _, face, times, d = take
    face_s = face.frames / face.fps
    assert abs(refined_offset(0.04, face_s, face.X, times, d)) < 0.012


def test_clocks_of_short_and_unrelated_takes_are_refused(take):
    _, face, times, d = take
    face_s = face.frames / face.fps
    with pytest.raises(FittingError, match="at least 10 s"):
        offsets_between(face_s, times[:200])
    mixed = d[np.random.default_rng(0).permutation(len(d))]
    with pytest.raises(FittingError, match="do not follow the jaw at any clock offset"):
        clock_offset(face_s, face.X, times, mixed)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d * [1, 1, 0.1], "range of movement forward"),
        (lambda d: np.minimum(d, [99, 0.5, 99]), "range of movement to the left"),
        (lambda d: np.maximum(d, [-99, -0.5, -99]), "range of movement to the right"),
    ],
)
def test_takes_without_a_direction_are_refused(take, change, said):
    performer, face, times, d = take
    weights = columns_at(face.frames / face.fps, face.X, times)
    check_jaw_weights(performer.rig, weights, d, 0.5)
    with pytest.raises(FittingError, match=said):
        check_jaw_weights(performer.rig, weights, change(d), 0.5)


def test_a_constant_weight_is_refused(take):
    performer, face, times, d = take
    weights = columns_at(face.frames / face.fps, face.X, times)
    weights[:, 3] = 0.02
    with pytest.raises(FittingError, match="movement forward never changes"):
        check_jaw_weights(performer.rig, weights, d, 0.5)


def test_a_jaw_no_better_than_shares_is_refused(take):
    """If the weights equal the shares, nothing that is learned can improve on them."""
    rig, d = take[0].rig, take[3]
    shares = rig.normalized(rig.project(d))
    d = rig.denormalized(np.column_stack([shares[:, :2], np.maximum(shares[:, 2], 0)]))
    opening, side, forward = rig.normalized(d).T
    weights = np.stack([opening, np.maximum(side, 0), np.maximum(-side, 0), forward], axis=1)
    with pytest.raises(FittingError, match="would not be an improvement"):
        check_jaw_weights(rig, weights, d, 0.01)
