"""The torch layer against the numpy evaluator, and its gradients against finite differences."""

import numpy as np
import pytest
import torch
from example_model import example_arrays, example_meta, touching_arrays
from scipy.spatial.transform import Rotation

from jawusd.evaluator import JawRig
from jawusd.geometry.se3 import se3_exp
from jawusd.solvers import JawLayer, jaw_pose_from_axis_angle

RIGS = {kind: JawRig(example_arrays(kind), example_meta(kind)) for kind in ("anchored", "additive")}
RIGS["touching"] = JawRig({**example_arrays(), **touching_arrays()}, example_meta())
LAYERS = {kind: JawLayer(rig) for kind, rig in RIGS.items()}


@pytest.fixture(params=sorted(RIGS))
def pair(request):
    return RIGS[request.param], LAYERS[request.param]


def random_d(rig, shape, seed=0, spread=1.0):
    low, high = rig.d_range.T
    return np.random.default_rng(seed).uniform(low, high, (*shape, 3)) * spread


def noisy_poses(rig, count, seed=0):
    noise = np.random.default_rng(seed).normal(size=(count, 6)) * ([0.004] * 3 + [0.3] * 3)
    return torch.tensor(se3_exp(noise) @ rig.pose(random_d(rig, (count,), seed)))


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2), (0,)])
def test_poses_and_margins_are_the_evaluators(pair, shape):
    rig, layer = pair
    d = random_d(rig, shape, spread=1.3)
    np.testing.assert_allclose(layer(torch.tensor(d)).numpy(), rig.pose(d), atol=1e-10)
    np.testing.assert_allclose(layer.margin(torch.tensor(d)).numpy(), rig.margin(d), atol=1e-10)


def test_parameters_beyond_all_limits_and_at_rest_agree(pair):
    rig, layer = pair
    d = np.array([[0.0, 0.0, 0.0], [90.0, 20.0, -9.0], [-12.0, -20.0, 15.0], [1e-9, 0.0, 0.0]])
    np.testing.assert_allclose(layer(torch.tensor(d)).numpy(), rig.pose(d), atol=1e-9)
    np.testing.assert_allclose(layer.margin(torch.tensor(d)).numpy(), rig.margin(d), atol=1e-9)


def test_float32_agrees_to_a_hundredth_of_a_millimetre(pair):
    rig, _ = pair
    layer = JawLayer(rig).to(torch.float32)
    d = random_d(rig, (50,))
    T = layer(torch.tensor(d, dtype=torch.float32))
    assert T.dtype == torch.float32
    np.testing.assert_allclose(T.numpy(), rig.pose(d), atol=1e-2)
    found, residual_mm = layer.encode(T)
    assert found.dtype == residual_mm.dtype == torch.float32
    np.testing.assert_allclose(found.numpy(), d, atol=0.05)


def test_encode_is_the_evaluators(pair):
    rig, layer = pair
    T = noisy_poses(rig, 30)
    d, residual_mm = layer.encode(T)
    expected, expected_mm = rig.encode(T.numpy())
    np.testing.assert_allclose(d.numpy(), expected, atol=1e-12)
    np.testing.assert_allclose(residual_mm.numpy(), expected_mm, atol=1e-10)
    assert layer.encode(T.reshape(5, 6, 4, 4))[0].shape == (5, 6, 3)


def test_gradcheck_of_poses_and_margins(pair):
    rig, layer = pair
    d = torch.tensor(np.concatenate([random_d(rig, (6,)), np.zeros((1, 3))]), requires_grad=True)
    assert torch.autograd.gradcheck(layer, d, eps=1e-5, atol=1e-6)
    assert torch.autograd.gradcheck(layer.margin, d, eps=1e-6, atol=1e-6)
    assert torch.autograd.gradcheck(layer.penalty, (d * 1.5).detach().requires_grad_(), eps=1e-6, atol=1e-5)
    assert torch.autograd.gradgradcheck(layer.margin, d[:3].detach().requires_grad_(), eps=1e-6, atol=1e-4)


@pytest.mark.slow
def test_gradcheck_of_encoding_and_loss_far_off_the_model(pair):
    """Poses several millimetres off the model, where leaving out second derivatives would show."""
    rig, layer = pair
    rng = np.random.default_rng(3)
    base = torch.tensor(se3_exp(rng.normal(size=(1, 6)) * ([0.03] * 3 + [2.0] * 3)) @ rig.pose(random_d(rig, (1,))))
    assert (layer.encode(base)[1] > 1.0).any()
    shift = torch.zeros(1, 3, 4, dtype=torch.float64, requires_grad=True)

    def moved(shift):
        return torch.cat([base[:, :3] + shift, base[:, 3:]], dim=1)

    assert torch.autograd.gradcheck(lambda s: layer.encode(moved(s))[0], shift, eps=1e-4, atol=1e-4, rtol=1e-4)
    assert torch.autograd.gradcheck(lambda s: layer.encode(moved(s))[1], shift, eps=1e-4, atol=1e-4, rtol=1e-4)
    assert torch.autograd.gradcheck(lambda s: layer.loss(moved(s)), shift, eps=1e-4, atol=1e-3, rtol=1e-4)


def test_the_residual_has_a_finite_gradient_on_the_model(pair):
    rig, layer = pair
    T = torch.tensor(rig.pose(np.concatenate([np.zeros((1, 3)), random_d(rig, (20,))])), requires_grad=True)
    d, residual_mm = layer.encode(T)
    assert residual_mm.max() < 1e-9
    residual_mm.sum().backward()
    assert torch.isfinite(T.grad).all()
    lost = torch.full((1, 4, 4), torch.nan, dtype=torch.float64)
    assert torch.isnan(layer.encode(lost)[1]).all()


def test_gradients_at_rest_and_at_spline_centres_are_finite():
    rig, layer = RIGS["anchored"], LAYERS["anchored"]
    model = rig.model
    q = model.centres[:10] * model.scales
    gx, gz, _, _ = model.gauge.path(q[:, 0])
    d = model.chart_parameters(np.stack([q[:, 1] + gx, -q[:, 0], q[:, 2] + gz], axis=1))
    d = torch.tensor(np.concatenate([d, np.zeros((1, 3))]), requires_grad=True)
    layer(d).sum().backward()
    assert torch.isfinite(d.grad).all()


def test_loss_is_zero_on_valid_poses_and_grows_off_them(pair):
    rig, layer = pair
    valid = torch.tensor(rig.pose(rig.project(random_d(rig, (40,)) * 0.8)))
    assert layer.loss(valid).max() < 1e-9
    outside = torch.tensor(rig.pose(np.array([[20.0, 15.0, 0.0]])))
    assert layer.loss(outside).item() == pytest.approx(float(rig.margin([20.0, 15.0, 0.0])) ** 2, rel=1e-6)
    pushed = valid.clone()
    pushed[:, :3, 3] += 3.0
    assert (layer.loss(pushed) > 0.05).all()


def test_descending_the_loss_makes_a_pose_valid(pair):
    rig, layer = pair
    twist = torch.tensor([0.05, 0.08, 0.02, 2.0, 1.0, 3.0], dtype=torch.float64)
    T = (torch.tensor(se3_exp(twist.numpy())) @ layer(torch.tensor([15.0, 3.0, 1.0], dtype=torch.float64))).clone()
    t = T[:3, 3].clone().requires_grad_()
    optimiser = torch.optim.LBFGS([t], max_iter=12, line_search_fn="strong_wolfe")

    def pose():
        return torch.cat([torch.cat([T[:3, :3], t[:, None]], dim=1), T[3:]], dim=0)

    def closure():
        optimiser.zero_grad()
        value = layer.loss(pose())
        value.backward()
        return value

    before = layer.loss(pose()).item()
    optimiser.step(closure)
    assert layer.loss(pose()).item() < 0.5 * before


def test_face_model_poses_follow_their_convention():
    """Vertices of the jaw move by R (v - j) + j + t in the model's frame, checked with scipy's rotations."""
    rng = np.random.default_rng(4)
    S = se3_exp(rng.normal(size=6) * [0.3, 0.3, 0.3, 40, 40, 40])
    T_rest = RIGS["anchored"].arrays["T_rest"]
    joint = np.array([0.001, -0.02, -0.01])
    turn, shift = rng.normal(size=(5, 3)) * 0.2, rng.normal(size=(5, 3)) * 0.003
    T = jaw_pose_from_axis_angle(
        torch.tensor(turn),
        torch.tensor(shift),
        joint=torch.tensor(joint),
        T_skull_model=torch.tensor(S),
        T_rest=torch.tensor(T_rest.copy()),
    ).numpy()
    in_mandible = np.array([3.0, -20.0, 10.0, 1.0])
    closed_m = (np.linalg.inv(S) @ T_rest @ in_mandible)[:3] / 1000.0
    for i in range(5):
        moved_m = Rotation.from_rotvec(turn[i]).apply(closed_m - joint) + joint + shift[i]
        np.testing.assert_allclose(T[i] @ in_mandible, S @ [*(1000 * moved_m), 1.0], atol=1e-9)
    closed = jaw_pose_from_axis_angle(
        torch.zeros(3, dtype=torch.float64),
        None,
        joint=torch.tensor(joint),
        T_skull_model=torch.tensor(S),
        T_rest=torch.tensor(T_rest.copy()),
    )
    np.testing.assert_allclose(closed.numpy(), T_rest, atol=1e-12)


def test_wrong_shapes_are_refused(pair):
    _, layer = pair
    with pytest.raises(ValueError, match="end in"):
        layer(torch.zeros(3, 2))
    with pytest.raises(ValueError, match="end in"):
        layer.loss(torch.zeros(3, 3))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_agrees(pair):
    rig, _ = pair
    layer = JawLayer(rig).to("cuda")
    d = random_d(rig, (20,))
    np.testing.assert_allclose(layer(torch.tensor(d, device="cuda")).cpu().numpy(), rig.pose(d), atol=1e-10)
