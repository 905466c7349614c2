"""Extreme numbers: takes without motion, parameters exactly on the bound, implausible magnitudes."""

import numpy as np
import pytest
from example_model import example_arrays
from example_rig import example_rig

from jawusd.base.errors import FittingError
from jawusd.fitting import fit_model
from jawusd.geometry import make_transform, so3_exp
from jawusd.tracking.sequence.smoothing import smooth_poses


@pytest.mark.parametrize("opened_mm", [0.0, 12.0])
@pytest.mark.parametrize("count", [10, 500])
def test_a_jaw_that_never_moves_is_one_clear_error(opened_mm, count):
    pose = make_transform(so3_exp([0.01 * opened_mm, 0, 0]), [0, -opened_mm, 0])
    with pytest.raises(FittingError):
        fit_model(
            (np.arange(count), np.tile(pose, (count, 1, 1))),
            T_anatomical_skull=np.eye(4),
            landmarks=example_arrays()["landmarks"],
        )


def test_smoothing_leaves_a_jaw_at_rest_where_it_is():
    pose = make_transform(so3_exp([0.1, 0.2, -0.1]), [3.0, -20.0, 150.0])
    poses, covariance = np.tile(pose, (50, 1, 1)), np.tile(1e-4 * np.eye(6), (50, 1, 1))
    smooth = smooth_poses(np.arange(50), poses, covariance, pose[:3, 3])
    np.testing.assert_allclose(smooth, poses, atol=1e-11)


@pytest.fixture(scope="module", params=["anchored", "additive"])
def rig(request):
    return example_rig(request.param)


def test_parameters_on_the_bound_stay_there(rig):
    rng = np.random.default_rng(0)
    low, high = rig.d_range.T
    outside = rng.uniform(low - 5, high + 5, (300, 3))
    outside = outside[rig.margin(outside) < -0.1]
    on = rig.project(outside)
    assert np.abs(rig.margin(on)).max() < 1e-3 and len(on) > 100
    np.testing.assert_allclose(rig.project(on), on, atol=2e-3)
    assert np.isfinite(rig.margin_gradient(on)).all() and np.isfinite(rig.pose(on)).all()
    assert np.isfinite(rig.jacobian(on)).all()


@pytest.mark.parametrize("d", [[0.0, 0, 0], [-0.0, -0.0, -0.0], [5e-324, 0, 0], [1e-300, -1e-300, 0], [0, 1e-12, 0]])
def test_parameters_around_zero_are_the_closed_bite(rig, d):
    assert np.isfinite(rig.jacobian(d)).all() and np.isfinite(rig.margin_gradient(d)).all()
    np.testing.assert_allclose(rig.pose(d), rig.pose([0.0, 0, 0]), atol=1e-9)


def test_parameters_far_away_are_outside_and_finite(rig):
    for d in ([1e4, 0, 0], [0, -1e4, 1e4], [-1e6, 1e6, 0]):
        assert np.isfinite(rig.margin(d)) and rig.margin(d) < 0 and np.isfinite(rig.margin_gradient(d)).all()
        low, high = rig.d_range.T
        assert (rig.project(d) > low - 10).all() and (rig.project(d) < high + 10).all()
