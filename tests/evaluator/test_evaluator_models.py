"""Forward models against a second implementation in 50-digit arithmetic and against scipy."""

import mpmath as mp
import numpy as np
import pytest
import reference_jaw as reference
from example_model import example_arrays
from scipy.spatial.transform import Rotation

from jawusd.evaluator.curves import HermiteCurve
from jawusd.evaluator.kinds import KINDS, arrays_of
from jawusd.evaluator.models import FORMS, AnchoredModel
from jawusd.geometry.se3 import se3_exp

# inside, on a knot of the curves, past both ends of the path, at rest
POINTS = np.array(
    [[20.0, 3.0, -1.0], [5.25, -6.0, 4.0], [60.0, 2.0, 1.0], [-5.0, -1.0, 0.5], [0.0, 0.0, 0.0], [41.0, 8.9, 6.9]]
)


def matrix(M):
    return np.array([[float(x) for x in row] for row in M.tolist()])


@pytest.fixture(params=KINDS)
def arrays(request):
    return example_arrays(request.param)


def model_of(arrays):
    return FORMS["anchored" if "spline_weights" in arrays else "additive"](arrays)


def random_d(arrays, count, seed=0):
    low, high = arrays["d_range"].T
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def test_every_kind_has_a_form_that_gives_its_arrays_back():
    assert tuple(FORMS) == KINDS
    common = set.intersection(*(set(arrays_of(kind)) for kind in KINDS))
    for kind in KINDS:
        arrays = example_arrays(kind)
        model = FORMS[kind](arrays)
        assert model.kind == kind
        own = model.arrays()
        assert set(own) == set(arrays_of(kind)) - common
        for name, value in own.items():
            np.testing.assert_array_equal(value, arrays[name])


def test_motion_agrees_with_the_reference(arrays):
    """Values agree with the formulas evaluated in 50 digits."""
    R, t = model_of(arrays).decode(POINTS)
    for i, d in enumerate(POINTS):
        M = matrix(reference.motion(arrays, [mp.mpf(float(x)) for x in d]))
        np.testing.assert_allclose(R[i], M[:3, :3], atol=1e-12)
        np.testing.assert_allclose(t[i], M[:3, 3], atol=1e-10)


def test_rest_is_the_identity(arrays):
    """M(0) = I: d = 0 is the closed bite."""
    R, t = model_of(arrays).decode(np.zeros((2, 3)))
    np.testing.assert_allclose(R, np.stack([np.eye(3)] * 2), atol=1e-14)
    np.testing.assert_allclose(t, 0.0, atol=1e-12)


def test_rotations_are_rotations(arrays):
    """scipy accepts the rotations as they are."""
    R, _ = model_of(arrays).decode(random_d(arrays, 200))
    np.testing.assert_allclose(Rotation.from_matrix(R).as_matrix(), R, atol=1e-12)


def test_log_is_the_logarithm_of_the_motion(arrays):
    model = model_of(arrays)
    d = random_d(arrays, 200)
    R, t = model.decode(d)
    M = se3_exp(model.log(d))
    np.testing.assert_allclose(M[:, :3, :3], R, atol=1e-12)
    np.testing.assert_allclose(M[:, :3, 3], t, atol=1e-10)


def test_spatial_derivative_agrees_with_50_digit_differences(arrays):
    """M(d + e) = exp(S e) M(d): S agrees with differences taken in 50 digits to 1e-8 relative."""
    model = model_of(arrays)
    _, _, S = model.decode_derivative(POINTS)
    for i, d in enumerate(POINTS):
        M = reference.motion(arrays, [mp.mpf(float(x)) for x in d])
        inverse = mp.inverse(M)
        columns = reference.derivative(lambda d: list(reference.motion(arrays, d)), d)
        for j, column in enumerate(columns):
            velocity = matrix(mp.matrix(4, 4) + _reshape(column) * inverse)
            expected = [velocity[2, 1], velocity[0, 2], velocity[1, 0], *velocity[:3, 3]]
            np.testing.assert_allclose(S[i, :, j], expected, atol=1e-9 * max(1.0, np.abs(expected).max()))


def test_anchored_model_puts_the_incisor_where_the_gauge_says():
    arrays = example_arrays("anchored")
    model = AnchoredModel.from_arrays(arrays)
    d = random_d(arrays, 100)
    R, t = model.decode(d)
    np.testing.assert_allclose(R @ arrays["incisor"] + t - arrays["incisor"], model.gauge.displacement(d), atol=1e-12)


def test_the_incisor_tells_the_parameters_of_an_anchored_model():
    arrays = example_arrays("anchored")
    model = AnchoredModel.from_arrays(arrays)
    d = random_d(arrays, 300)
    np.testing.assert_allclose(model.chart_parameters(model.chart_start(*model.decode(d))), d, atol=1e-9)


def test_read_off_of_an_additive_model_starts_near():
    """The start is the best point of its grid: within a grid cell."""
    arrays = example_arrays("additive")
    model = model_of(arrays)
    d = random_d(arrays, 300)
    cell = np.diff(arrays["d_range"], axis=1)[:, 0] / (12, 8, 8)
    assert (np.abs(model.chart_start(*model.decode(d)) - d) < 1.5 * cell).all()


def test_spline_is_smooth_through_its_centres():
    """At a centre, where the expanded distance may round below zero, value and gradient stay exact."""
    arrays = example_arrays("anchored")
    model = AnchoredModel.from_arrays(arrays)
    gauge = model.gauge
    q = arrays["spline_centres"][:5] * arrays["spline_scales"]
    gx, gz, _, _ = gauge.path(q[:, 0])
    u = np.stack([q[:, 1] + gx, -q[:, 0], q[:, 2] + gz], axis=1)
    omega, omega_u = model.rotation_jacobian(u)
    for i, at in enumerate(u):
        at = [mp.mpf(float(x)) for x in at]
        np.testing.assert_allclose(omega[i], [float(x) for x in reference.rotation_vector(arrays, at)], atol=1e-13)
        columns = reference.derivative(lambda u: reference.rotation_vector(arrays, u), u[i])
        np.testing.assert_allclose(omega_u[i].T, np.array(columns, dtype=float), atol=1e-10)


def test_hermite_curve_keeps_values_and_slopes_at_knots_and_runs_straight_outside():
    rng = np.random.default_rng(1)
    knots = np.cumsum(rng.uniform(0.5, 2.0, 7))
    values, slopes = rng.normal(size=(7, 3)), rng.normal(size=(7, 3))
    curve = HermiteCurve(knots, values, slopes)
    np.testing.assert_allclose(curve.value(knots), values, atol=1e-12)
    np.testing.assert_allclose(curve.slope(knots), slopes, atol=1e-12)
    outside = np.array([knots[0] - 3.0, knots[-1] + 2.0])
    np.testing.assert_allclose(curve.value(outside), [values[0] - 3 * slopes[0], values[-1] + 2 * slopes[-1]])
    between = rng.uniform(knots[0], knots[-1], 20)
    expected = [[float(y) for y in reference.hermite(knots, values, slopes, x)] for x in between]
    np.testing.assert_allclose(curve.value(between), expected, atol=1e-12)


def _reshape(column):
    M = mp.matrix(4, 4)
    for k, x in enumerate(column):
        M[k // 4, k % 4] = x
    return M
