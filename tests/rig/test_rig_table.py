"""The sampled table against scipy's grid interpolation and the model it was sampled from."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta
from scipy.interpolate import RegularGridInterpolator
from scipy.linalg import expm

from jawusd.evaluator import JawRig
from jawusd.rig.table import DecoderTable

RIG = JawRig(example_arrays(), example_meta())


def sampled(counts=(17, 15, 13), uneven=True):
    low, high = RIG.d_range.T
    share = [np.linspace(0, 1, n) ** (1.3 if uneven else 1.0) for n in counts]
    knots = tuple(a + (b - a) * s for a, b, s in zip(low, high, share))
    twists = RIG.twist(np.stack(np.meshgrid(*knots, indexing="ij"), axis=-1))
    return knots, twists


def random_d(count, seed=0):
    low, high = RIG.d_range.T
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def test_twist_is_scipys_linear_interpolation():
    knots, twists = sampled()
    table = DecoderTable("grid", knots, twists)
    d = np.concatenate([random_d(3000), [[k[0] for k in knots], [k[-1] for k in knots], [k[3] for k in knots]]])
    np.testing.assert_allclose(table.twist(d), RegularGridInterpolator(knots, twists)(d), atol=1e-12)


def test_pose_is_the_exponential_of_the_twist():
    knots, twists = sampled()
    table = DecoderTable("grid", knots, twists)
    d = random_d(20)
    for x, T in zip(d, table.pose(d, RIG.T_rest)):
        w1, w2, w3, *v = table.twist(x[None])[0]
        generator = np.zeros((4, 4))
        generator[:3] = [[0, -w3, w2, v[0]], [w3, 0, -w1, v[1]], [-w2, w1, 0, v[2]]]
        np.testing.assert_allclose(T, expm(generator) @ RIG.T_rest, atol=1e-11)
        np.testing.assert_allclose(table.pose(x[None], RIG.T_rest)[0], T, atol=1e-12)


def test_a_finer_table_comes_closer_to_the_model():
    """Twice the knots, about a quarter of the error."""
    d = random_d(2000)
    errors = []
    for counts in ((9, 9, 9), (17, 17, 17), (33, 33, 33)):
        table = DecoderTable("grid", *sampled(counts, uneven=False))
        difference = (table.pose(d, RIG.T_rest) - RIG.pose(d))[:, :3]
        landmarks = np.column_stack([RIG.landmarks, np.ones(5)])
        errors.append(np.linalg.norm(difference @ landmarks.T, axis=1).max())
    assert errors[2] < 0.5 * errors[1] < 0.25 * errors[0]
    assert errors[2] < 0.1


def test_parameters_outside_are_clamped_and_nan_gives_nan():
    knots, twists = sampled()
    table = DecoderTable("grid", knots, twists)
    corner = np.array([[k[-1] for k in knots]])
    np.testing.assert_array_equal(table.pose(corner + 50.0, RIG.T_rest), table.pose(corner, RIG.T_rest))
    assert np.isnan(table.pose([[np.nan, 0.0, 0.0]], RIG.T_rest)[:, :3]).all()
    assert np.isnan(table.twist([[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0]])).all()
    assert table.pose(np.empty((0, 3)), RIG.T_rest).shape == (0, 4, 4)


@pytest.mark.parametrize(
    ("knots", "message"),
    [
        (([0, 1], [0, 1], [0, 1, 2]), "shape"),
        (([0, 1], [1, 0], [0, 1]), "increasing"),
        (([0], [0, 1], [0, 1]), "increasing"),
    ],
)
def test_tables_that_do_not_fit_are_refused(knots, message):
    counts = (2, 2, 2) if message == "shape" else tuple(len(k) for k in knots)
    with pytest.raises(ValueError, match=message):
        DecoderTable("grid", tuple(map(np.array, knots)), np.zeros((*counts, 6), np.float32))
