"""The group axioms, the Jacobians and scipy as oracle, near zero, in the middle and near pi."""

import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from jawusd import geometry as g

ANGLES = [0.0, 1e-12, 1e-9, 1e-5, 3e-3, 0.01, 0.2999, 0.3001, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-11]
SHAPES = [(), (1,), (3, 1, 2)]


def twists(angle, shape, seed=0):
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(*shape, 6)) * [1, 1, 1, 20, 20, 20]
    axis = out[..., :3] / np.linalg.norm(out[..., :3], axis=-1, keepdims=True)
    out[..., :3] = axis * angle
    return out


def wedge(xi):
    X = np.zeros((4, 4))
    X[:3, :3], X[:3, 3] = g.hat(xi[:3]), xi[3:]
    return X


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("shape", SHAPES)
def test_log_inverts_exp_at_every_angle_and_shape(angle, shape):
    xi = twists(angle, shape)
    T = g.se3_exp(xi)
    assert T.shape == (*shape, 4, 4)
    np.testing.assert_allclose(g.se3_exp(g.se3_log(T)), T, atol=1e-11)
    # Within 1e-9 of pi the sign of the axis is lost in the matrix itself.
    if angle < np.pi - 1e-9:
        np.testing.assert_allclose(g.se3_log(T), xi, atol=2e-8 if angle > 3.1 else 1e-12, rtol=1e-10)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle):
    for seed in range(5):
        xi = twists(angle, (), seed)
        np.testing.assert_allclose(g.se3_exp(xi), expm(wedge(xi)), atol=1e-12)


def test_log_is_the_matrix_logarithm_and_scipys_rotation_vector():
    rng = np.random.default_rng(1)
    for _ in range(50):
        R = g.random_rotation(rng)
        np.testing.assert_allclose(g.so3_log(R), Rotation.from_matrix(R).as_rotvec(), atol=1e-12)
        T = g.make_transform(R, rng.normal(size=3) * 30)
        xi = g.se3_log(T)
        np.testing.assert_allclose(wedge(xi), np.real(logm(T)), atol=1e-9)


def test_log_at_pi_returns_an_axis_that_gives_the_same_rotation():
    rng = np.random.default_rng(2)
    for _ in range(100):
        axis = rng.normal(size=3)
        R = Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis)).as_matrix()
        w = g.so3_log(R)
        assert np.linalg.norm(w) == pytest.approx(np.pi, abs=1e-9)
        np.testing.assert_allclose(g.so3_exp(w), R, atol=1e-9)


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 0.2999, 0.3001, 1.0, 2.5, 3.1])
def test_left_jacobian_is_the_derivative_of_exp(angle):
    xi, h = twists(angle, ()), 1e-6
    numeric = np.stack(
        [g.se3_log(g.se3_exp(xi + h * e) @ g.se3_inverse(g.se3_exp(xi - h * e))) / (2 * h) for e in np.eye(6)],
        axis=1,
    )
    np.testing.assert_allclose(g.se3_left_jacobian(xi), numeric, atol=2e-7)
    np.testing.assert_allclose(g.se3_left_jacobian(xi) @ g.se3_left_jacobian_inverse(xi), np.eye(6), atol=1e-11)
    # with the right Jacobian Jr(xi) = Jl(-xi): exp(xi) Jr = Ad(exp xi) Jr = Jl
    np.testing.assert_allclose(
        g.se3_adjoint(g.se3_exp(xi)) @ g.se3_left_jacobian(-xi), g.se3_left_jacobian(xi), atol=1e-10
    )
    np.testing.assert_allclose(g.so3_left_jacobian(-xi[:3]), g.so3_left_jacobian(xi[:3]).T, atol=1e-12)


def test_coupling_series_meets_the_closed_form():
    """The branch at 0.3 rad must not be visible, or optimisers stall there."""
    xi = twists(0.3, ())
    scale = np.array([1 - 1e-9] * 3 + [1.0] * 3)
    np.testing.assert_allclose(g.se3_left_jacobian(xi * scale), g.se3_left_jacobian(xi * (2 - scale)), atol=2e-8)


@pytest.mark.parametrize("shape", SHAPES)
def test_adjoint_moves_a_twist_through_a_motion(shape):
    T, xi = g.se3_exp(twists(1.1, shape, 3)), twists(0.7, shape, 4)
    moved = np.einsum("...ij,...j->...i", g.se3_adjoint(T), xi)
    np.testing.assert_allclose(T @ g.se3_exp(xi) @ g.se3_inverse(T), g.se3_exp(moved), atol=1e-10)


def test_relative_pose_takes_the_head_out():
    """Paper eqs. 1-3: moving the head does not change the jaw pose."""
    rng = np.random.default_rng(5)
    T_skull_mandible = g.se3_exp(twists(0.5, (7,), 6))
    T_world_upper = g.make_transform(g.random_rotation(rng, (7,)), rng.normal(size=(7, 3)) * 100)
    found = g.relative_pose(T_world_upper, T_world_upper @ T_skull_mandible)
    np.testing.assert_allclose(found, T_skull_mandible, atol=1e-12)
    R = np.swapaxes(T_world_upper[:, :3, :3], 1, 2) @ (T_world_upper @ T_skull_mandible)[:, :3, :3]
    np.testing.assert_allclose(found[:, :3, :3], R, atol=1e-13)


def test_points_go_one_per_pose_or_all_to_every_pose():
    T = g.se3_exp(twists(0.4, (5,), 7))
    p = np.random.default_rng(8).normal(size=(5, 3))
    one = g.transform_point(T, p)
    cloud = g.transform_points(T, p)
    assert one.shape == (5, 3) and cloud.shape == (5, 5, 3)
    np.testing.assert_allclose(one[2], T[2, :3, :3] @ p[2] + T[2, :3, 3])
    np.testing.assert_allclose(cloud[4, 1], T[4, :3, :3] @ p[1] + T[4, :3, 3])
    sets = g.transform_points(T[:2], np.stack([p, -p]))
    np.testing.assert_allclose(sets[1], g.transform_points(T[1], -p))
    with pytest.raises(ValueError, match="shape"):
        g.transform_points(T, p[0])


def test_orthonormalise_repairs_and_rigidity_defect_sees_damage():
    T = g.se3_exp(twists(0.9, (4,), 9))
    assert g.rigidity_defect(T).max() < 1e-14
    broken = T.copy()
    broken[:, :3, :3] *= 1.001
    assert (g.rigidity_defect(broken) > 1e-3).all()
    np.testing.assert_allclose(g.orthonormalise(broken), T, atol=1e-12)
    mirrored = T @ np.diag([-1.0, 1, 1, 1])
    assert (g.rigidity_defect(mirrored) >= 2).all()
    assert g.rigidity_defect(g.orthonormalise(mirrored)).max() < 1e-12


def test_quaternions_agree_with_scipy():
    R = g.random_rotation(np.random.default_rng(10), (50,))
    wxyz = g.wxyz_from_matrix(R)
    expected = Rotation.from_matrix(R).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(wxyz, expected, atol=1e-14)
    np.testing.assert_allclose([g.wxyz_from_matrix(one) for one in R], expected, atol=1e-14)
    np.testing.assert_allclose(g.matrix_from_wxyz(-3 * wxyz), R, atol=1e-14)


@pytest.mark.parametrize("call", [lambda: g.se3_exp(np.zeros(5)), lambda: g.se3_log(np.eye(3))])
def test_wrong_shapes_are_refused(call):
    with pytest.raises(ValueError, match="shape"):
        call()


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-3, 1.0, 3.0])
def test_one_vector_turns_as_one_of_many(scale):
    w = scale * np.random.default_rng(5).normal(size=(20, 3))
    for function in (g.so3_exp, g.so3_left_jacobian):
        np.testing.assert_allclose([function(one) for one in w], function(w), rtol=0, atol=1e-14)
        with np.errstate(invalid="ignore"):
            assert np.isnan(function([np.inf, 0.0, 0.0])).all()
