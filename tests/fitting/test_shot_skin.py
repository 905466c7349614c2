"""The jaw in a shot from points on its skin, which lips move where the teeth are hidden."""

import numpy as np
import pytest
from skin_takes import Skin

from jawusd.base.errors import FittingError
from jawusd.fitting.shot_skin import PointModel, jaw_of_points
from jawusd.geometry import so3_exp

FRAMES, FIXED = 240, 12


@pytest.fixture(scope="module")
def shot():
    """Return a person, points on the head and the lower face, true d and poses, and where the teeth are seen."""
    person, rng = Skin(2), np.random.default_rng(0)
    T = person.speech(FRAMES, rng)
    points, d, seen = person.calibration()
    rows = np.flatnonzero(seen[:2160])[:: max(seen[:2160].sum() // FRAMES, 1)]
    closed = person.points(T, rng, np.ones(FRAMES))
    X = np.concatenate([points[rows], closed])
    head = person.rest.mean(axis=0) + rng.uniform([-40, 30, -20], [40, 70, 10], (FIXED, 3))
    X = np.concatenate([X, head + 0.1 * rng.normal(size=(len(X), FIXED, 3))], axis=1)
    true = person.rig.encode(T).d
    d = np.concatenate([d[rows], np.zeros_like(true)])
    return person, X, d, np.arange(len(X)) < len(rows), true, T


def errors_mm(shot, found):
    person, _, _, seen, _, T = shot
    return person.errors_mm(person.rig.project(found[~seen]), T)[:, 0]


def test_hidden_frames_are_found_although_the_lips_move_some_points(shot):
    """Points near the lips are 4 mm higher behind closed lips: they count little, and sigmas stay honest."""
    person, X, d, seen, true, _ = shot
    lips = np.flatnonzero(person.rest[:, 1] > person.rest[:, 1].max() - 12)
    moved = X.copy()
    moved[np.ix_(~seen, lips)] += [0.0, 4.0, 1.0]
    found = jaw_of_points(person.rig, moved, d, seen, 0.15)
    assert len(lips) > 5 and errors_mm(shot, found.jaw.d).mean() < 0.8
    z2 = (found.jaw.d[~seen] - true) ** 2 / np.einsum("fii->fi", found.jaw.covariance[~seen])
    assert z2.mean() < 2.0
    model = PointModel(moved[seen], d[seen])
    unaware = errors_mm(shot, model.jaw(moved)[0]).mean()
    assert unaware > 1.5 * errors_mm(shot, found.jaw.d).mean()
    departures = model.departures(moved[~seen])
    assert np.median(departures[lips]) > 4 * np.median(np.delete(departures, lips))
    np.testing.assert_array_equal(model.departures(moved[:0]), 0)


def test_an_error_of_the_head_in_hidden_frames_changes_little(shot):
    """The pose of the head is wrong by 1 mm and a degree where the teeth are hidden."""
    person, X, d, seen, _, _ = shot
    centre = person.rest.mean(axis=0)
    wrong = X.copy()
    wrong[~seen] = (X[~seen] - centre) @ so3_exp(np.deg2rad([1.0, 0.3, 0.2])).T + centre + [0.5, 0.7, 0.5]
    right, off = (jaw_of_points(person.rig, points, d, seen, 0.15).jaw.d for points in (X, wrong))
    assert errors_mm(shot, off).mean() < errors_mm(shot, right).mean() + 0.2


def test_missing_points_widen_sigma_and_too_few_leave_a_frame_unknown(shot):
    person, X, d, seen, _, _ = shot
    rng = np.random.default_rng(1)
    part = X.copy()
    part[rng.random(X.shape[:2]) < 0.3] = np.nan
    part[-1, 11:] = np.nan
    whole, found = (jaw_of_points(person.rig, points, d, seen, 0.15) for points in (X, part))
    assert errors_mm(shot, np.nan_to_num(found.jaw.d))[:-1].mean() < 0.8
    assert not found.jaw.familiar[-1] and np.isnan(found.jaw.d[-1]).all() and found.jaw.familiar[:-1].all()
    wider = found.jaw.covariance[~seen][:-1] / whole.jaw.covariance[~seen][:-1]
    assert np.median(np.einsum("fii->fi", wider)) > 1.1
    assert found.frames == seen.sum() and found.errors_mm.keys() == {"skin", "carried", "mean", "chin"}


def test_a_jaw_far_wider_open_than_in_the_training_frames_is_unknown(shot):
    """Teeth are visible while the jaw is nearly closed; then it opens wide."""
    person, X, d, seen, _, _ = shot
    narrow = seen & (d[:, 0] < np.quantile(d[seen, 0], 0.6))
    wide = seen & (d[:, 0] > d[narrow, 0].mean() + 6 * d[narrow, 0].std())
    found = jaw_of_points(person.rig, X, d, narrow, 0.15).jaw
    assert wide.sum() > 5 and not found.familiar[wide].any() and np.isnan(found.d[wide]).all()
    assert np.isnan(found.covariance[wide]).all() and found.familiar[narrow | ~seen].all()


def test_points_of_another_moment_are_refused(shot):
    person, X, d, seen, _, _ = shot
    late = X.copy()
    late[seen] = np.roll(X[seen], 100, axis=0)
    with pytest.raises(FittingError, match="At most 65%"):
        jaw_of_points(person.rig, late, d, seen, 0.15)
    with pytest.raises(FittingError, match="at least 60 are needed"):
        jaw_of_points(person.rig, X, d, np.arange(len(X)) < 40, 0.15)


def test_the_model_predicts_points_that_are_missing_in_its_training_frames(shot):
    _, X, d, seen, _, _ = shot
    some = X[seen].copy()
    gone = np.random.default_rng(2).random(some.shape[:2]) < 0.1
    some[gone] = np.nan
    filled = PointModel(some, d[seen]).filled
    np.testing.assert_allclose(filled[~gone], some[~gone])
    assert np.abs(filled - X[seen])[gone].mean() < 0.6
