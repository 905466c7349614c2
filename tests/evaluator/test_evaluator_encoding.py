"""Encoding against scipy's least squares, inside and outside the bound, plain and weighted."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta
from scipy.optimize import least_squares
from scipy.optimize import minimize as scipy_minimize

from jawusd.evaluator import JawRig
from jawusd.evaluator.solver import solve_symmetric
from jawusd.geometry.anatomy import LANDMARKS
from jawusd.geometry.se3 import se3_exp, se3_log, transform_points
from jawusd.geometry.so3 import hat

RIGS = {kind: JawRig(example_arrays(kind), example_meta(kind)) for kind in ("anchored", "additive")}


@pytest.fixture(params=sorted(RIGS))
def rig(request):
    return RIGS[request.param]


def noisy_poses(rig, count, seed, angle_rad=0.004, shift_mm=0.3):
    rng = np.random.default_rng(seed)
    low, high = rig.d_range.T
    d = rng.uniform(low, high, (count, 3))
    noise = rng.normal(size=(count, 6)) * ([angle_rad] * 3 + [shift_mm] * 3)
    return d, se3_exp(noise) @ rig.pose(d)


def landmark_differences(rig, d, T):
    difference = rig.pose(d) - T
    landmarks = rig.landmarks
    return landmarks @ difference[:3, :3].T + difference[:3, 3]


def test_encode_inverts_pose(rig):
    d, _ = noisy_poses(rig, 500, 0)
    found, residual_mm = rig.encode(rig.pose(d))
    np.testing.assert_allclose(found, d, atol=1e-8)
    np.testing.assert_allclose(residual_mm, 0.0, atol=1e-8)


def test_residual_is_the_rms_landmark_distance(rig):
    _, T = noisy_poses(rig, 50, 1)
    d, residual_mm = rig.encode(T)
    for i in range(len(T)):
        expected = np.sqrt((landmark_differences(rig, d[i], T[i]) ** 2).sum(axis=1).mean())
        assert residual_mm[i] == pytest.approx(expected, abs=1e-12)


def test_encode_is_as_near_as_scipy_least_squares(rig):
    """No start of the oracle ends nearer than 1e-4 mm, for noise up to a gross 4 mm."""
    for seed, shift_mm in ((2, 0.3), (3, 4.0)):
        true_d, T = noisy_poses(rig, 40, seed, shift_mm=shift_mm)
        d, residual_mm = rig.encode(T)
        for i in range(len(T)):
            for start in (true_d[i], d[i]):
                oracle = least_squares(
                    lambda x, T=T[i]: landmark_differences(rig, x, T).ravel() / np.sqrt(5), start, xtol=1e-13
                )
                assert residual_mm[i] <= np.sqrt(2 * oracle.cost) + 1e-4


def test_encode_accepts_matrices_that_are_not_quite_rigid(rig):
    """float32 and rounded matrices give nearly the same parameters."""
    d, _ = noisy_poses(rig, 100, 4)
    T = rig.pose(d)
    found, residual_mm = rig.encode(T.astype(np.float32))
    np.testing.assert_allclose(found, d, atol=1e-3)
    assert residual_mm.max() < 1e-3


def test_bounded_encode_stays_inside_and_is_the_best_there(rig):
    """Inside the bound nothing changes; outside, SLSQP under the same bound finds nothing nearer."""
    d, T = noisy_poses(rig, 60, 5)
    free, free_mm = rig.encode(T)
    bounded, bounded_mm = rig.encode(T, inside=True)
    assert (rig.margin(bounded) >= -1e-12).all()
    inside = rig.margin(free) >= 0
    assert inside.any() and not inside.all()
    np.testing.assert_array_equal(bounded[inside], free[inside])
    assert (bounded_mm >= free_mm - 1e-12).all()
    for i in np.flatnonzero(~inside)[:15]:
        oracle = scipy_minimize(
            lambda x, T=T[i]: (landmark_differences(rig, x, T) ** 2).sum(axis=1).mean(),
            rig.project(free[i]),
            constraints={"type": "ineq", "fun": rig.margin, "jac": rig.margin_gradient},
            method="SLSQP",
            options={"ftol": 1e-14},
        )
        if rig.margin(oracle.x) >= -1e-9:
            assert bounded_mm[i] <= np.sqrt(oracle.fun) + 1e-4


def weighted_cost(rig, d, T, precision):
    xi = se3_log(T @ np.linalg.inv(rig.pose(d)))
    return float(xi @ precision @ xi)


def test_weighted_encode_minimises_the_mahalanobis_distance(rig):
    rng = np.random.default_rng(6)
    _, T = noisy_poses(rig, 20, 6)
    root = rng.normal(size=(20, 6, 6)) * 0.1 + np.diag([0.01] * 3 + [0.5] * 3)
    covariance = root @ np.swapaxes(root, 1, 2) + np.diag([1e-6] * 3 + [1e-3] * 3)
    d, residual_mm, _ = rig.encode(T, covariance=covariance)
    for i in range(20):
        precision = np.linalg.inv(covariance[i])
        oracle = scipy_minimize(
            lambda x, T=T[i], precision=precision: weighted_cost(rig, x, T, precision),
            d[i] + 0.05,
            method="Nelder-Mead",
            options={"xatol": 1e-7, "fatol": 1e-10, "maxiter": 2000},
        )
        assert weighted_cost(rig, d[i], T[i], precision) <= oracle.fun + 1e-6
    assert (residual_mm >= rig.encode(T)[1] - 1e-12).all()


def test_weighted_encode_trusts_what_was_measured_well(rig):
    """A translation measured poorly along one axis pulls the result less than with equal weights."""
    d = np.array([20.0, 1.0, 1.0])
    A = rig.T_anatomical_skull
    x_skull = A[:3, :3].T @ [1.0, 0.0, 0.0]
    T = rig.pose(d).copy()
    T[:3, 3] += 2.0 * x_skull
    covariance = np.diag([1e-4] * 3 + [0.01] * 3)
    covariance[3:, 3:] += 25.0 * np.outer(x_skull, x_skull)
    plain, _ = rig.encode(T)
    weighted, *_ = rig.encode(T, covariance=covariance)
    assert np.linalg.norm(weighted - d) < 0.3 * np.linalg.norm(plain - d)


def test_covariance_rows_with_nan_give_nan_and_bad_ones_are_refused(rig):
    d, T = noisy_poses(rig, 3, 7)
    covariance = np.tile(np.eye(6), (3, 1, 1))
    covariance[1] = np.nan
    found, residual_mm, of_d = rig.encode(T, covariance=covariance)
    assert np.isnan(found[1]).all() and np.isnan(residual_mm[1]) and np.isnan(of_d[1]).all()
    assert np.isfinite(of_d[[0, 2]]).all()
    assert np.isfinite(found[[0, 2]]).all()
    with pytest.raises(ValueError, match="positive definite"):
        rig.encode(T, covariance=-np.eye(6))


def test_covariance_of_d_is_that_of_its_errors(rig):
    """Noise of the given covariance, and errors of the rig: squared errors over variances average to 1."""
    rng = np.random.default_rng(8)
    table = {name: {"base_mm": size} for name, size in zip(LANDMARKS, (0.3, 0.2, 0.25, 0.5, 0.4))}
    unsure = JawRig(rig.arrays, {**rig.meta, "uncertainty": table})
    d = rig.project(rng.uniform(*rig.d_range.T, (2000, 3)) * 0.8)
    root = rng.normal(size=(6, 6)) * 0.2 * np.array([[0.004]] * 3 + [[0.3]] * 3) + np.diag([0.004] * 3 + [0.3] * 3)
    covariance, T = root @ root.T, rig.pose(d)
    noise = se3_exp(rng.normal(size=(2000, 6)) @ root.T)
    own = se3_exp(np.einsum("nij,nj->ni", np.linalg.cholesky(unsure.pose_covariance(d)), rng.normal(size=(2000, 6))))
    for judge, poses in ((rig, noise @ T), (unsure, noise @ own @ T)):
        found, _, of_d = judge.encode(poses, covariance=covariance)
        lengths = np.einsum("ni,nij,nj->n", found - d, np.linalg.inv(of_d), found - d) / 3.0
        assert lengths.mean() == pytest.approx(1.0, abs=0.08)
    assert judge.encode(T[0], covariance=covariance).covariance.shape == (3, 3)
    assert (np.linalg.eigvalsh(of_d - rig.encode(poses, covariance=covariance).covariance) > -1e-9).all()


def test_own_error_of_a_rig_is_that_of_its_landmarks(rig):
    assert not rig.landmark_sigma_mm([10.0, 0.0, 0.0]).any() and not rig.pose_covariance(np.zeros(3)).any()
    assert not rig.parameter_covariance([10.0, 0.0, 0.0]).any()
    table = {name: {"base_mm": 0.3} for name in LANDMARKS}
    unsure = JawRig(rig.arrays, {**rig.meta, "uncertainty": table})
    d = np.array([10.0, 1.0, 0.5])
    points = transform_points(unsure.pose(d), unsure.landmarks)
    J = np.concatenate([-hat(points), np.tile(np.eye(3), (5, 1, 1))], axis=2)
    spread = np.einsum("pij,jk,pik->p", J, unsure.pose_covariance(d), J)
    assert np.sqrt(spread.mean()) == pytest.approx(0.3, rel=0.35)
    again = unsure.encode(unsure.pose(d), covariance=unsure.pose_covariance(d)).covariance
    np.testing.assert_allclose(unsure.parameter_covariance(d), 0.5 * again, rtol=1e-6)  # noise as large as the error
    del table["incisor"]
    assert not JawRig(rig.arrays, {**rig.meta, "uncertainty": table}).pose_covariance(np.zeros(3)).any()


def test_error_of_a_rig_grows_with_the_distance_from_captured_poses(rig):
    """Near captured poses, errors may be 0; they are never 0 away from them."""
    table = {name: {"base_mm": 0.0, "per_mm": 0.2} for name in LANDMARKS}
    unsure = JawRig(rig.arrays, {**rig.meta, "uncertainty": table})
    d = unsure.captured_d[:1] + np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0], [80.0, 0.0, 0.0]])
    sigma = unsure.landmark_sigma_mm(d)
    distance = unsure.captured_distance(d)[:, None]
    np.testing.assert_allclose(sigma, 0.2 * distance**2 / (distance + 3.0) * np.ones(5))
    assert not unsure.pose_covariance(d[0]).any() and not unsure.parameter_covariance(d[0]).any()
    variance = np.einsum("nii->n", unsure.parameter_covariance(d))
    assert variance[0] == 0.0 < variance[1] < variance[2]


def test_weighted_encode_with_bounds_stays_inside(rig):
    _, T = noisy_poses(rig, 60, 8)
    d, *_ = rig.encode(T, inside=True, covariance=np.diag([1e-5] * 3 + [0.1] * 3))
    assert (rig.margin(d) >= -1e-12).all()


def test_poses_with_nan_give_nan(rig):
    _, T = noisy_poses(rig, 4, 9)
    T[2, 1, 3] = np.nan
    for bounds in (False, True):
        d, residual_mm = rig.encode(T, inside=bounds)
        assert np.isnan(d[2]).all() and np.isnan(residual_mm[2])
        assert np.isfinite(d[[0, 1, 3]]).all()


def test_any_rigid_pose_gets_an_answer(rig):
    """Wild poses end somewhere finite, with a residual that says they are off the model."""
    rng = np.random.default_rng(10)
    T = se3_exp(rng.normal(size=(200, 6)) * ([1.0] * 3 + [80.0] * 3))
    d, residual_mm = rig.encode(T)
    assert np.isfinite(d).all() and np.isfinite(residual_mm).all()
    assert np.median(residual_mm) > 5.0


def test_a_handle_that_hardly_moves_is_solved_without_dividing_by_zero():
    """Equations without full rank: rows of zeros give no step, single or in batches."""
    singular = np.zeros((3, 3, 3))
    singular[1] = np.outer([1.0, 2.0, 3.0], [1.0, 2.0, 3.0])
    singular[2] = np.diag([2.0, 4.0, 8.0])
    b = np.tile([2.0, 4.0, 8.0], (3, 1))
    x = solve_symmetric(singular, b)
    np.testing.assert_allclose(x[0], 0.0)
    np.testing.assert_allclose(x[2], 1.0)
    assert np.isfinite(x).all()
    for A, right, expected in zip(singular, b, x):
        np.testing.assert_allclose(solve_symmetric(A[None], right[None])[0], expected)


def test_matrices_that_are_no_poses_are_not_encoded():
    rig = JawRig(example_arrays(), example_meta())
    T = rig.pose([[10.0, 1.0, 0.5]] * 5)
    T[1] = 2 * np.eye(4)
    T[2, :3, :3] *= 1.01
    T[3, :3, 0] *= -1
    T[4, :3, :3] += 1e-5  # written with few decimals
    for found in (rig.encode(T), rig.encode(T, inside=True), rig.encode(T, covariance=np.eye(6))):
        np.testing.assert_array_equal(np.isnan(found.d).all(1), [False, True, True, True, False])
        np.testing.assert_array_equal(np.isnan(found.residual_mm), [False, True, True, True, False])
    assert np.isnan(rig.encode(2 * np.eye(4)).d).all()
