"""Alternative models: PCA, the best sum of curves, and the paper's networks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from jawusd.base.errors import FittingError
from jawusd.evaluator import JawRig
from jawusd.fitting import FittingConfig, fit_model
from jawusd.fitting.additive import fit_pca, in_millimetres
from jawusd.fitting.data import SubjectAnatomy, select_poses
from jawusd.fitting.metric import MandibleMetric
from jawusd.geometry import make_transform, mandible_metric, se3_exp, se3_log
from jawusd.paper import nlpca
from jawusd.paper.model import fit_paper
from jawusd.paper.nlpca import train_nlpca
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person

ALL_SHOWN = np.ones(3, dtype=bool)


@pytest.fixture(scope="module")
def person():
    return Person(1)


@pytest.fixture(scope="module")
def take(person):
    return record(person, 500, 1).T_noisy


@pytest.fixture(scope="module")
def data(person, take):
    T_anatomical_skull = make_transform(np.eye(3), -person.landmarks[0])
    anatomy = SubjectAnatomy.of(T_anatomical_skull, person.landmarks, person.mandible_points, None)
    return select_poses(np.arange(len(take)), take, anatomy).data


def fit(person, take, **config):
    return fit_model(
        (np.arange(len(take)), take),
        T_anatomical_skull=make_transform(np.eye(3), -person.landmarks[0]),
        landmarks=person.landmarks,
        mandible_vertices=person.mandible_points,
        config=FittingConfig(holdout_folds=0, **config),
    )


def mean_error(data, fitted):
    return data.metric.largest(data.metric.nearest(fitted.model, data.motion)[1], data.motion).mean()


def test_twist_root_measures_mean_squared_displacement():
    points = np.random.default_rng(0).normal(size=(500, 3)) * 30
    root = MandibleMetric.of_points(points).twist_root()
    np.testing.assert_allclose(root @ root.T, mandible_metric(points), rtol=1e-9, atol=1e-9)


def test_pca_recovers_a_linear_subspace_exactly(data):
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.normal(size=(6, 3)))[0].T * [0.02, 0.02, 0.02, 1, 1, 1]
    codes = rng.normal(size=(500, 3)) * [8, 3, 2]
    linear = replace(data, motion=se3_exp(codes @ basis), frames=np.arange(500), weights=np.ones(500))
    fitted = fit_pca(linear, ALL_SHOWN)
    assert mean_error(linear, fitted) < 1e-6
    assert fitted.notes["singular_values_mm"][3] < 1e-9 < fitted.notes["singular_values_mm"][2]


def test_pca_parameters_are_incisal_millimetres_at_first_order(data):
    model = fit_pca(data, ALL_SHOWN).model
    small = 1e-4
    for d, expected in (([0, small, 0], [small, 0, 0]), ([0, 0, small], [0, 0, small])):
        R, t = model.decode(np.array([d]))
        np.testing.assert_allclose(R[0] @ data.incisor + t[0] - data.incisor, expected, atol=1e-3 * small)
    R, t = model.decode(np.array([[small, 0, 0]]))
    assert (R[0] @ data.incisor + t[0] - data.incisor)[1] == pytest.approx(-small, rel=1e-3)


def test_additive_lies_between_pca_and_anchored(person, take):
    error = {
        method: fit(person, take, method=method).meta["errors"]["train"]["mandible"]["mean"]
        for method in ("pca", "additive", "anchored")
    }
    assert error["anchored"] < error["additive"] < error["pca"]
    assert error["additive"] <= 0.42


def test_additive_parameters_are_incisal_millimetres(person, take):
    rig = JawRig((model := fit(person, take, method="additive")).arrays, model.meta)
    for axis, direction in enumerate(([0, -1, 0], [1, 0, 0], [0, 0, 1])):
        curve = model.arrays[f"curve{axis + 1}_knots"]
        d = np.zeros((20, 3))
        d[:, axis] = np.linspace(0.9 * max(curve[0], -8), 0.9 * min(curve[-1], 30), 20)
        np.testing.assert_allclose(person.incisor(rig.pose(d)) @ direction, d[:, axis], atol=5e-3)
    assert np.abs(rig.pose(np.zeros(3)) - np.eye(4)).max() < 1e-9


def test_curve_goes_on_where_the_incisal_point_turns_back():
    incisor = np.array([0.0, 0.0, 0.0])

    def curve(t):  # forward up to t = 5, back afterwards, sideways throughout
        zero = np.zeros_like(t)
        twist = np.stack([zero, zero, zero, t, zero, 5 - (t - 5) ** 2 / 5], axis=1)
        return twist, np.stack([zero, zero, zero, zero + 1, zero, -2 * (t - 5) / 5], axis=1)

    moved, steady = in_millimetres(curve, (0.0, 10.0), np.eye(6), incisor, axis=2)
    assert (np.diff(moved.knots) > 0).all()
    assert steady[: len(steady) // 3].all() and not steady[-len(steady) // 3 :].any()
    np.testing.assert_allclose(moved.values[-1, 3:], [10, 0, 0], atol=1e-9)
    early = moved.knots < 3
    np.testing.assert_allclose(moved.knots[early], moved.values[early, 5] - moved.values[0, 5], atol=1e-9)


@pytest.mark.slow
def test_network_finds_a_curve_and_depends_only_on_its_seed():
    rng = np.random.default_rng(2)
    t = np.linspace(-1, 1, 200)
    curve = np.stack([t, t**2, 0.3 * t**3], axis=1) + rng.normal(size=(200, 3)) * 0.002
    network = train_nlpca(curve, 1, seed=0, stages=4)
    assert np.sqrt(((network.decode(network.encode(curve)) - curve) ** 2).sum(1).mean()) < 0.05
    again = train_nlpca(curve, 1, seed=0, stages=4)
    for a, b in zip(network.layers, again.layers, strict=True):
        np.testing.assert_array_equal(a, b)
    other = train_nlpca(curve, 1, seed=1, stages=4)
    assert not np.array_equal(network.layers[0], other.layers[0])


@pytest.mark.slow
def test_training_to_the_end_reaches_the_same_minimum_from_every_start():
    t = np.linspace(-1, 1, 50)
    noise = np.random.default_rng(2).normal(size=(50, 3)) * 0.002
    curve = np.stack([t, t**2, 0.3 * t**3], axis=1) + noise
    whole = [train_nlpca(curve, 1, seed=seed).cost for seed in range(3)]
    part = [train_nlpca(curve, 1, seed=seed, stages=4).cost for seed in range(3)]
    assert max(whole) < 1.0001 * min(whole) and max(whole) < min(part)


@pytest.mark.slow
def test_network_components_come_in_order_of_what_they_explain():
    rng = np.random.default_rng(3)
    codes = rng.normal(size=(300, 3)) * [5, 3, 2]
    points = codes @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    network = train_nlpca(points, 3, seed=0, stages=5)
    found = network.encode(points)
    error = []
    for count in (1, 2, 3):
        kept = np.where(np.arange(3) < count, found, 0)
        error.append(((network.decode(kept) - points) ** 2).sum(1).mean())
    total = (points**2).sum(1).mean()
    assert error[0] < 0.45 * total and error[1] < 0.6 * error[0] and error[2] < 0.6 * error[1]


def test_network_rate_is_the_derivative_of_its_decoder():
    points = np.random.default_rng(4).normal(size=(60, 4))
    network = train_nlpca(points, 2, seed=0, stages=1)
    at, direction = np.array([0.03, -0.02]), np.array([0.6, 0.8])
    for output in range(4):
        slope = approx_fprime([0.0], lambda s, k=output: network.decode((at + s[0] * direction)[None])[0, k], 1e-7)
        assert network.decode_rate(at[None], direction)[0, output] == pytest.approx(slope[0], rel=1e-4, abs=1e-5)


@pytest.fixture(scope="module")
def published(data):
    """Half of the take, and the paper's model of it in both groupings; networks trained for 500 of 3000 iterations."""
    few, nets = data.select(np.arange(len(data)) % 2 == 0), {}

    def shorter(*given, **options):
        return train_nlpca(*given, **options | {"stages": 4})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nlpca, "train_nlpca", shorter)
        fits = {literal: fit_paper(few, ALL_SHOWN, literal, starts=2, seed=0, nets=nets) for literal in (False, True)}
    return few, fits


@pytest.mark.slow
def test_paper_model_counts_the_constant_once(published):
    _, fits = published
    found = fits[True].network_sum
    t = np.random.default_rng(5).normal(size=(7, 3)) * 0.05
    parts = [part.value(found.net, t[:, i])[0] for i, part in enumerate(found.parts)]
    constant = found.net.decode(np.zeros((1, 5)))
    np.testing.assert_allclose(found.value(t), sum(parts) - 2 * constant, atol=1e-12)
    # a group at its zero code must contribute nothing: only Phi1 remains
    single = fits[False].network_sum
    if all(len(part.group) == 1 for part in single.parts):
        alone = np.array([[0.1, 0.0, 0.0]])
        np.testing.assert_allclose(single.value(alone), single.parts[0].value(single.net, alone[:, 0])[0], atol=1e-9)


@pytest.mark.slow
def test_grouping_by_incisal_motion_beats_the_fixed_groups(published):
    few, fits = published
    assert fits[True].notes["groups"] == [[0], [1, 2], [3, 4]]
    assert mean_error(few, fits[False]) < 0.9
    literal = fits[True].notes["train_errors_as_published"]["mandible"]["mean"]
    assert fits[False].notes["train_errors_as_published"]["mandible"]["mean"] < literal


@pytest.mark.slow
def test_paper_model_rests_at_the_closed_bite(published):
    _, fits = published
    for fitted in fits.values():
        R, t = fitted.model.decode(np.zeros((1, 3)))
        assert np.abs(R - np.eye(3)).max() < 1e-12 and np.abs(t).max() < 1e-9
        assert fitted.notes["rest_offset_mm"] < 1.0


def test_a_component_that_collapsed_is_named():
    still = lambda t: (np.zeros((len(t), 6)), np.zeros((len(t), 6)))  # noqa: E731
    with pytest.raises(FittingError, match="curve moves the incisal point by"):
        in_millimetres(still, (-1.0, 1.0), np.eye(6), np.array([0.0, -30.0, 80.0]), 1)


def test_paper_model_says_what_the_data_must_show(data):
    with pytest.raises(FittingError, match="opening, lateral and protrusive"):
        fit_paper(data, np.array([True, False, True]), False, 1, 0)


@pytest.mark.slow
def test_twists_of_the_published_reconstruction_are_near_the_data(published):
    few, fits = published
    again = fits[False].reconstruct_as_published(few.motion)
    assert np.abs(se3_log(again) - se3_log(few.motion))[:, :3].max() < 0.1
