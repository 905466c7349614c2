"""The semantic gauge: values, derivatives, inverse."""

import mpmath as mp
import numpy as np
import reference_jaw as reference
from example_model import example_arrays
from hypothesis import given, settings
from hypothesis import strategies as st

from jawusd.evaluator.gauge import Gauge
from jawusd.evaluator.models import AnchoredModel

ARRAYS = example_arrays("anchored")
GAUGE = Gauge.from_arrays(ARRAYS)
numbers = st.floats(-1.0, 1.0)


def test_displacement_and_jacobian_agree_with_50_digits():
    points = np.array([[20.0, 3.0, -1.0], [0.0, 0.0, 0.0], [60.0, -7.0, 4.0], [-6.0, 2.0, -3.0], [1e-3, -1e-3, 1e-3]])
    u, jacobian = GAUGE.displacement_jacobian(points)
    np.testing.assert_array_equal(u, GAUGE.displacement(points))
    for i, d in enumerate(points):
        exact = reference.gauge(ARRAYS, [mp.mpf(float(x)) for x in d])
        np.testing.assert_allclose(u[i], [float(x) for x in exact], rtol=1e-13, atol=1e-13)
        columns = reference.derivative(lambda d: reference.gauge(ARRAYS, d), d)
        np.testing.assert_allclose(jacobian[i].T, np.array(columns, dtype=float), rtol=1e-10, atol=1e-11)


def test_rest_stays_at_rest():
    np.testing.assert_allclose(GAUGE.displacement(np.zeros((1, 3))), 0.0, atol=1e-15)


@settings(max_examples=200, deadline=None)
@given(st.floats(-8.0, 70.0), st.floats(-15.0, 15.0), st.floats(-8.0, 12.0))
def test_inverse_undoes_the_gauge_far_beyond_the_valid_box(d1, d2, d3):
    d = np.array([[d1, d2, d3]])
    np.testing.assert_allclose(GAUGE.inverse(GAUGE.displacement(d)), d, atol=1e-9)


def test_inverse_survives_a_gauge_with_a_steep_glide_surface():
    """Where plain Newton overshoots, the bracket finds the root: u is reproduced."""
    steep = dict(ARRAYS, glide_drop=np.array([0.5, 0.5, 0.4, 0.4]), glide_fade_mm=np.array(5.0))
    gauge = Gauge.from_arrays(steep)
    rng = np.random.default_rng(2)
    u = rng.uniform([-12, -50, -20], [12, 10, 10], (5000, 3))
    d = gauge.inverse(u)
    assert np.isfinite(d).all()
    np.testing.assert_allclose(gauge.displacement(d), u, atol=1e-9)


def test_one_row_is_inverted_as_many_are():
    """The float path agrees with the array path, also where plain Newton overshoots."""
    model = AnchoredModel.from_arrays(ARRAYS)
    rng = np.random.default_rng(3)
    u = rng.uniform([-14, -60, -20], [14, 10, 12], (300, 3))
    expected = GAUGE.inverse(u)
    np.testing.assert_allclose([model.chart_parameters(row[None])[0] for row in u], expected, atol=1e-9)
    steep = AnchoredModel.from_arrays(
        dict(ARRAYS, glide_drop=np.array([0.5, 0.5, 0.4, 0.4]), glide_fade_mm=np.array(5.0))
    )
    found = np.array([steep.chart_parameters(row[None])[0] for row in u])
    np.testing.assert_allclose(steep.gauge.displacement(found), u, atol=1e-9)


def test_inverse_passes_nan_rows_through():
    u = np.array([[1.0, -5.0, 2.0], [np.nan, -5.0, 2.0], [1.0, -5.0, 2.0]])
    d = GAUGE.inverse(u)
    assert np.isnan(d[1]).all()
    np.testing.assert_array_equal(d[0], d[2])
    assert GAUGE.inverse(np.empty((0, 3))).shape == (0, 3)
