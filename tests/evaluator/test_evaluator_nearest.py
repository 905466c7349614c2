"""The nearest point inside to one point: against the search over rows, scipy, and differences of the bound."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta, touching_arrays
from key_sets import hollow_rig
from scipy.optimize import minimize

from jawusd.evaluator import JawRig
from jawusd.evaluator.nearest import nearest_in_valley, place

RIGS = {
    "example": JawRig(example_arrays(), example_meta()),
    "touching": JawRig({**example_arrays(), **touching_arrays()}, example_meta()),
    "hollow": hollow_rig(),
}


@pytest.fixture(params=sorted(RIGS))
def rig(request):
    return RIGS[request.param]


def around(rig, count, seed=0):
    low, high = rig.d_range.T
    return np.random.default_rng(seed).uniform(low - 5.0, high + 5.0, (count, 3))


def test_the_bound_around_a_point_is_that_of_rows(rig):
    d, h = around(rig, 60), 1e-4
    distance, gradient = rig.bound.signed_distance_gradient(d)
    for i, row in enumerate(d):
        at = place(rig.bound.formula, tuple(row.tolist()))
        assert at.distance == pytest.approx(distance[i], abs=1e-12)
        np.testing.assert_allclose(at.gradient, gradient[i], atol=1e-12)
    inner = d[np.abs(d[:, :1] - rig.bound.supports.knots).min(axis=1) > 2 * h][:20]  # curvature steps at knots
    for row in inner:
        at = place(rig.bound.formula, tuple(row.tolist()))
        hessian = np.array(at.rounding)[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        hessian[0, 0] -= at.bend
        steps = h * np.eye(3)
        numeric = (rig.bound.signed_distance_gradient(row + steps)[1] - at.gradient) / h
        np.testing.assert_allclose(hessian, numeric, atol=5e-3 * (1 + np.abs(numeric).max()))


def test_one_by_one_is_as_near_as_together(rig):
    d = around(rig, 300, 1)
    together = rig.project(d)
    alone = np.array([rig.project(row) for row in d])
    assert (rig.margin(alone) >= 0).all()
    left, best = (np.linalg.norm(x - d, axis=1) for x in (alone, together))
    assert (left - best).max() <= 1e-6
    np.testing.assert_array_equal(alone[rig.margin(d) >= 0], d[rig.margin(d) >= 0])


def test_no_point_inside_is_nearer_by_scipy():
    rig = RIGS["example"]
    for wanted in around(rig, 30, 2):
        found = rig.project(wanted)
        bound = {"type": "ineq", "fun": lambda x: rig.margin(x), "jac": lambda x: rig.margin_gradient(x)}
        oracle = minimize(
            lambda x, w=wanted: ((x - w) ** 2).sum(),
            found,
            jac=lambda x, w=wanted: 2 * (x - w),
            method="SLSQP",
            constraints=[bound],
            options={"ftol": 1e-12},
        )
        if rig.margin(oracle.x) >= -1e-9:
            assert np.linalg.norm(found - wanted) <= np.linalg.norm(oracle.x - wanted) + 1e-6


def test_a_start_in_the_other_half_of_a_hollow_bound_stays_there():
    bound = RIGS["hollow"].bound
    wanted = (20.0, 9.0, 0.0)
    below, above = (nearest_in_valley(bound.formula, wanted, (d1, 0.0, 0.0)) for d1 in (8.0, 34.0))
    assert below[0] < 20.0 < above[0]
    assert bound.signed_distance(np.array([below, above])).max() <= 0
