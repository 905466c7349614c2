"""The table of the glide surface: both statements of the formula, derivatives, inverse, every kind of number."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta, touching_arrays
from example_rig import touching_rig
from scipy.interpolate import CubicHermiteSpline

from jawusd.base.errors import EvaluatorError
from jawusd.evaluator import JawRig
from jawusd.evaluator.curves import GlideTable

BOX = [0.0, -10.0, -3.0], [40.0, 10.0, 9.0]


def scipy_drop(arrays, d2, d3):
    """Sum the products of scipy's Hermite splines, with slopes by the definition of Catmull and Rom."""
    factors = []
    for name, x in (("glide_d2", d2), ("glide_d3", d3)):
        knots, values = arrays[name], arrays[f"{name}_factors"]
        slopes = np.zeros_like(values)
        for i in range(1, len(knots) - 1):
            slopes[i] = (values[i + 1] - values[i - 1]) / (knots[i + 1] - knots[i - 1])
        factors.append(CubicHermiteSpline(knots, values, slopes)(np.clip(x, knots[0], knots[-1])))
    return (factors[0] * factors[1]).sum(axis=-1)


def test_table_is_the_sum_of_products_of_splines():
    arrays = touching_arrays()
    table = GlideTable.from_arrays(arrays)
    d2, d3 = np.random.default_rng(0).uniform([-11, -4], [11, 10], (500, 2)).T
    down, down_2, down_3 = table.at_arrays(d2, d3)
    np.testing.assert_allclose(down, scipy_drop(arrays, d2, d3), atol=1e-12)
    step = 1e-6
    inner = (np.abs(d2) < 8.9) & (d3 > -1.9) & (d3 < 6.9)
    for slope, (a, b) in ((down_2, (step, 0)), (down_3, (0, step))):
        numeric = (scipy_drop(arrays, d2 + a, d3 + b) - scipy_drop(arrays, d2 - a, d3 - b)) / (2 * step)
        np.testing.assert_allclose(slope[inner], numeric[inner], atol=1e-7)
    single = np.array([table.at_floats(*pair) for pair in zip(d2.tolist(), d3.tolist())])
    np.testing.assert_allclose(single, np.stack([down, down_2, down_3], axis=1), atol=1e-12)


def test_the_surface_moves_the_incisal_point_at_closed_teeth():
    d = np.array([[0.0, 3.0, 1.0]])
    with_table, without = (
        rig.model.gauge.displacement(d) for rig in (touching_rig(), JawRig(example_arrays(), example_meta()))
    )
    expected = [0.0, -scipy_drop(touching_arrays(), d[:, 1], d[:, 2])[0], 0.0]
    np.testing.assert_allclose((with_table - without)[0], expected, atol=1e-12)


def test_poses_jacobians_and_parameters_agree():
    rig = touching_rig()
    d = np.random.default_rng(1).uniform(*BOX, (100, 3))
    poses = rig.pose(d)
    np.testing.assert_allclose([rig.pose(row) for row in d], poses, atol=1e-12)
    np.testing.assert_allclose(rig.encode(poses).d, d, atol=1e-9)
    np.testing.assert_allclose([rig.encode(T).d for T in poses[:5]], d[:5], atol=1e-9)
    step = 1e-6
    for axis, e in enumerate(np.eye(3)):
        slope = (rig.twist(d + step * e) - rig.twist(d - step * e)) / (2 * step)
        np.testing.assert_allclose(rig.jacobian(d)[..., axis], slope, atol=1e-7)
    np.testing.assert_allclose(rig.pose(np.zeros(3)), rig.T_rest, atol=1e-12)


def test_a_surface_that_moves_the_closed_bite_is_refused():
    arrays = touching_arrays()
    arrays["glide_d3_factors"] = arrays["glide_d3_factors"] * [1.0, 1.0, 0.5]
    with pytest.raises(EvaluatorError, match="in occlusion; it must be 0"):
        JawRig({**example_arrays(), **arrays}, example_meta())


@pytest.mark.parametrize("name", ["glide_d2_factors", "glide_d3"])
def test_a_missing_array_is_named(name):
    arrays = {**example_arrays(), **touching_arrays()}
    del arrays[name]
    with pytest.raises(EvaluatorError, match=name):
        JawRig(arrays, example_meta())
