"""The compiled table against the plain one and scipy's grid interpolation."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta
from scipy.interpolate import RegularGridInterpolator

from jawusd.evaluator import JawRig
from jawusd.evaluator.table import SampledTable
from jawusd.fast import FastTable

RIG = JawRig(example_arrays(), example_meta())
LOW, HIGH = RIG.arrays["d_range"].T
KNOTS = tuple(a + (b - a) * np.linspace(0, 1, n) ** 1.3 for a, b, n in zip(LOW, HIGH, (17, 15, 13)))
TWISTS = RIG.twist(np.stack(np.meshgrid(*KNOTS, indexing="ij"), axis=-1))
PLAIN, FAST = (each(KNOTS, TWISTS, RIG.arrays["T_rest"]) for each in (SampledTable, FastTable))


def random_d(shape, beyond_mm=0.0):
    return np.random.default_rng(0).uniform(LOW - beyond_mm, HIGH + beyond_mm, (*shape, 3))


def test_twist_is_scipys_linear_interpolation():
    d = np.concatenate([random_d((3000,)), [[k[0] for k in KNOTS], [k[-1] for k in KNOTS], [k[3] for k in KNOTS]]])
    np.testing.assert_allclose(FAST.twist(d), RegularGridInterpolator(KNOTS, TWISTS)(d), atol=1e-12)


def test_poses_agree_inside_and_clamped():
    d = random_d((3000,), 10.0)
    np.testing.assert_allclose(FAST.pose(d), PLAIN.pose(d), atol=1e-10)
    np.testing.assert_allclose([FAST.pose(x) for x in d[:50]], PLAIN.pose(d[:50]), atol=1e-10)


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2), (0,), (2, 0)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_any_batch_shape_and_type(shape, dtype):
    d = random_d(shape).astype(dtype)
    for name in ("pose", "twist"):
        found, expected = getattr(FAST, name)(d), getattr(PLAIN, name)(d)
        assert found.shape == expected.shape and found.dtype == np.float64
        np.testing.assert_allclose(found, expected, atol=1e-10)


@pytest.mark.parametrize("table", [PLAIN, FAST], ids=["plain", "fast"])
@pytest.mark.parametrize("absurd", [np.nan, np.inf, -np.inf, 1e300])
def test_parameters_that_are_not_finite_give_nan(table, absurd):
    d = random_d((3,))
    d[1, 2] = absurd
    assert np.isnan(table.pose(d)[1]).all() and np.isnan(table.twist(d)[1]).all()
    assert np.isnan(table.pose(d[1])).all()
    assert np.isfinite(table.pose(d)[[0, 2]]).all()
