"""Maps from skin to d, learned from takes of a synthetic person with the teeth visible; and takes that are refused."""

import numpy as np
import pytest
from skin_takes import Skin

import jawusd
from jawusd.base.errors import FittingError
from jawusd.geometry import transform_points

UNTRAINED = 4


@pytest.fixture(scope="module")
def take():
    """Return a person, and points, d and seen frames of a calibration without one expression."""
    person = Skin(3)
    return person, *person.calibration(away=(UNTRAINED,))


@pytest.fixture(scope="module")
def skin(take):
    """Return what is learned from it."""
    person, X, d, seen = take
    return jawusd.fit_skin(person.rig, X, d, seen, 0.15)


def test_the_jaw_behind_closed_lips_is_found(take, skin, tmp_path):
    """Speech behind closed lips, which the calibration does not have, is found with honest sigmas."""
    person = take[0]
    Z, T = person.closed_speech(frames=480, away=(UNTRAINED,))
    jawusd.save_skin(tmp_path / "skin.npz", skin)
    found, true = jawusd.load_skin(tmp_path / "skin.npz")(Z), person.rig.encode(T).d
    error = person.errors_mm(person.rig.project(found.d), T)
    assert error[:, 0].mean() < 0.8 and np.quantile(error[:, 0], 0.95) < 1.6 and error[:, 3:].mean() < 0.6
    assert 0.4 < np.mean((found.d - true) ** 2 / np.einsum("fii->fi", found.covariance)) < 2.0
    assert skin.meta["errors_mm"].keys() == {"skin", "carried", "mean", "chin"}
    assert skin.meta["errors_mm"]["skin"] < 0.5 * skin.meta["errors_mm"]["chin"]
    assert skin.actor == person.rig.actor and skin.meta["frames"] == take[3].sum()


def test_an_expression_that_was_not_trained_is_flagged(take, skin):
    """Its frames are flagged, and few of other speech with the teeth visible."""
    person = take[0]
    usual, _ = person.open_speech(away=(UNTRAINED,))
    strange, _ = person.closed_speech(frames=480, strong=(UNTRAINED,))
    assert 0 < skin.meta["false_alarms"] < 0.03
    assert skin(usual).familiar.mean() > 0.97 and skin(strange).familiar.mean() < 0.5


def test_an_error_of_the_head_keeps_sigmas_honest(take):
    """Later takes are stabilised worse than the calibration, and the fit was given their stabilisation error."""
    person, X, d, seen = take
    Z, T = person.closed_speech(frames=480, away=(UNTRAINED,), head=(1.0, 0.5))
    true, z2 = person.rig.encode(T).d, []
    for head_error in ((1e-3, 1e-6), (1.0, np.deg2rad(0.5))):
        found = jawusd.fit_skin(person.rig, X, d, seen, 0.15, head_error=head_error)(Z)
        z2.append(np.mean((found.d - true) ** 2 / np.einsum("fii->fi", found.covariance)))
    assert z2[0] > 3 and 0.4 < z2[1] < 1.6


def test_points_may_be_in_any_frame_of_the_head(take, skin):
    """A rotated and shifted head frame changes neither d nor the baseline of the chin."""
    person, X, d, seen = take
    Q = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    Q = Q * np.linalg.det(Q)
    turned = jawusd.fit_skin(person.rig, X @ Q.T + [100.0, -50.0, 20.0], d, seen, 0.15)
    np.testing.assert_allclose(turned(X[::50] @ Q.T + [100.0, -50.0, 20.0]).d, skin(X[::50]).d, atol=1e-4)
    assert turned.meta["errors_mm"]["chin"] == pytest.approx(skin.meta["errors_mm"]["chin"], rel=0.02)


def test_plain_columns_are_learned_without_a_chin(take):
    """Few columns that are no points: weights of opening, sides and forward."""
    person, X, d, seen = take
    weights = person.performer.face.weights(X[:, :3].mean(axis=1) - person.rest[:3].mean(axis=0))
    found = jawusd.fit_skin(person.rig, weights, d, seen, [0.1, 0.2, 0.1])
    assert found.meta["errors_mm"].keys() == {"skin", "carried", "mean"}
    assert not found.points and found(weights[seen]).familiar.mean() > 0.9
    error = np.linalg.norm(found(weights[seen]).d - d[seen], axis=1).mean()
    assert error < 2.5


def test_one_column_and_those_of_a_mesh_are_learned(take):
    """One column of noise is refused; a mesh of 2,000 vertices is stored by 120 components."""
    person, X, d, seen = take
    with pytest.raises(FittingError, match="At most 65%"):
        jawusd.fit_skin(person.rig, np.random.default_rng(0).normal(size=(len(d), 1)), d, seen)
    mesh = np.tile(X, (1, 50, 1))
    found = jawusd.fit_skin(person.rig, mesh.reshape(len(X), -1), d, seen)
    assert found.arrays["basis"].shape == (120, 6000) and found(mesh[seen][:50].reshape(50, -1)).familiar.mean() > 0.9


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda X, d, seen: (X, d, seen & (np.arange(len(d)) < 70)), "at least 60 are needed"),
        (lambda X, d, seen: (np.where(np.arange(40)[:, None] == 7, np.nan, X), d, seen), "0 frames show the teeth"),
        (lambda X, d, seen: (X, d * [1, 0.01, 1], seen), "the laterotrusion varies by"),
        (lambda X, d, seen: (0 * X + 3, d, seen), "all columns of the face data are constant"),
        (lambda X, d, seen: (np.roll(X, 480, axis=0).reshape(len(X), -1), d, seen), "At most 65%"),
    ],
)
def test_takes_that_cannot_tell_are_refused(take, change, said):
    person, X, d, seen = take
    with pytest.raises(FittingError, match=said):
        jawusd.fit_skin(person.rig, *change(X, d, seen), 0.15)


def test_a_map_no_better_than_a_rigid_chin_is_refused(take):
    """Points that are rigid with the bone: inverse kinematics has the error of the measured d."""
    person, X, d, seen = take
    truth = person.rig.project(np.where(seen[:, None], d, 0.0))
    arms = np.array([[0.0, -30, 5], [12.0, -28, 0], [-12.0, -28, 0], [0, -5, 3]])
    rigid = transform_points(person.rig.pose(truth), person.rig.landmarks[0] + arms)
    with pytest.raises(FittingError, match="of a chin rigid with the bone is 0.0"):
        jawusd.fit_skin(person.rig, rigid, truth, seen, 0.01)


def test_wrong_shapes_and_sigmas_are_refused(take):
    person, X, d, seen = take
    with pytest.raises(ValueError, match="must have shape"):
        jawusd.fit_skin(person.rig, X[:10], d, seen)
    with pytest.raises(ValueError, match="must have shape"):
        jawusd.fit_skin(person.rig, X[..., :2], d, seen)
    with pytest.raises(FittingError, match="sigma of d must be positive"):
        jawusd.fit_skin(person.rig, X, d, seen, 0.0)
