"""Number types and second derivatives: mixed precision of the program around, Hessians, least squares."""

import copy

import numpy as np
import pytest
import torch
from example_model import example_arrays, example_meta
from scipy.optimize import least_squares, minimize

from jawusd.evaluator import JawRig
from jawusd.geometry.se3 import se3_exp
from jawusd.solvers import JawLayer, jaw_pose_from_axis_angle

# both in torch's own forward mode: the first until 2.13, the second from 2.14 on
pytestmark = [
    pytest.mark.filterwarnings(f"ignore:.*torch.jit.script.*:{kind}Warning") for kind in ("Deprecation", "Future")
]
RIGS = {kind: JawRig(example_arrays(kind), example_meta(kind)) for kind in ("anchored", "additive")}
LAYERS = {kind: JawLayer(rig) for kind, rig in RIGS.items()}
cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
SCALES = torch.tensor([0.01] * 3 + [1.0] * 3, dtype=torch.float64)


@pytest.fixture(params=sorted(RIGS))
def pair(request):
    return RIGS[request.param], LAYERS[request.param]


def moved(T):
    """Return poses near T (4, 4) as a function of six numbers of about one."""
    T = torch.tensor(T)

    def pose(x):
        w, v = (SCALES * x).split(3)
        zero = torch.zeros_like(x[0])
        rows = [[zero, -w[2], w[1], v[0]], [w[2], zero, -w[0], v[1]], [-w[1], w[0], zero, v[2]], [zero] * 4]
        return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows])) @ T

    return pose


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=cuda)])
def test_mixed_precision_of_the_program_changes_no_pose(pair, device):
    rig, layer = pair
    single = copy.deepcopy(layer).float().to(device)
    d = torch.tensor(np.random.default_rng(0).uniform(*rig.d_range.T, (50, 3)), dtype=torch.float32, device=device)
    T, expected = single(d), single.loss(single(d))
    before = torch.get_float32_matmul_precision()
    try:
        for precision in ("highest", "medium"):
            torch.set_float32_matmul_precision(precision)
            for dtype in (torch.bfloat16, torch.float16):
                with torch.autocast(device, dtype=dtype):
                    torch.testing.assert_close(single(d), T, rtol=0, atol=0)
                    torch.testing.assert_close(single.loss(T), expected, rtol=0, atol=0)
                    moving = single.encode(T)[0]
            assert moving.dtype == torch.float32 and torch.get_float32_matmul_precision() == precision
    finally:
        torch.set_float32_matmul_precision(before)
    np.testing.assert_allclose(T.cpu(), rig.pose(d.cpu().double().numpy()), atol=1e-2)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_coarse_number_types_are_refused(pair, dtype):
    rig, layer = pair
    with pytest.raises(TypeError, match="must be float32 or float64"):
        layer(torch.zeros(3, dtype=dtype))
    coarse = torch.nn.Sequential(copy.deepcopy(layer)).to(dtype)
    with pytest.raises(TypeError, match=r"too coarse for poses.*layer.float\(\)"):
        coarse(torch.zeros(3, dtype=dtype))
    rest = torch.tensor(rig.T_rest, dtype=dtype)
    with pytest.raises(TypeError, match="axis_angle is"):
        jaw_pose_from_axis_angle(
            torch.zeros(3, dtype=dtype), None, joint=torch.zeros(3, dtype=dtype), T_skull_model=rest, T_rest=rest
        )


@pytest.mark.parametrize("d", [[12.0, 1.0, 0.5], [20.0, 12.0, 2.0], [30.0, -3.0, 11.0]])
def test_hessians_of_loss_and_encode_agree_with_differences(pair, d):
    """Off the model and on both sides of the bound."""
    rig, layer = pair
    pose = moved(se3_exp(np.array([0.02, -0.015, 0.01, 1.5, 1.0, -2.0])) @ rig.pose(d))
    x, h = torch.zeros(6, dtype=torch.float64), 1e-3
    for function in (lambda x: layer.loss(pose(x)), lambda x: layer.encode(pose(x))[0].sum()):
        found = torch.func.hessian(function)(x)
        slope = torch.func.grad(function)
        steps = h * torch.eye(6, dtype=torch.float64)
        numeric = torch.stack([(slope(step) - slope(-step)) / (2 * h) for step in steps])
        torch.testing.assert_close(found, numeric, rtol=1e-4, atol=1e-4 * float(numeric.abs().max()))
        torch.testing.assert_close(found, found.T, rtol=0, atol=1e-6 * float(numeric.abs().max()))


def test_residuals_are_the_loss_and_solve_least_squares(pair):
    rig, layer = pair
    T = se3_exp(np.array([0.03, 0.02, -0.02, 2.0, -1.0, 1.5])) @ rig.pose([18.0, 9.0, 1.0])
    r = layer.residuals(torch.tensor(T))
    assert r.shape == (13,)
    torch.testing.assert_close(r.square().sum(), layer.loss(torch.tensor(T)))
    torch.testing.assert_close(layer.residuals(torch.tensor(T), sigma_mm=0.5), 2 * r)
    pose = moved(T)
    data = torch.tensor([1.0, -2.0, 0.5, 0.3, 0.2, -0.4], dtype=torch.float64)

    def residuals(x):
        return torch.cat([layer.residuals(pose(x)), 0.5 * (x - data)])

    slopes = torch.func.jacfwd(residuals)
    found = least_squares(
        lambda x: residuals(torch.tensor(x)).numpy(), np.zeros(6), lambda x: slopes(torch.tensor(x)).numpy()
    )
    assert found.success

    def loss(x):
        return layer.loss(pose(x)) + 0.25 * (x - data).square().sum()

    newton = torch.zeros(6, dtype=torch.float64)
    for _ in range(12):
        H, g = torch.func.hessian(loss)(newton), torch.func.grad(loss)(newton)
        values, axes = torch.linalg.eigh(H)
        newton = newton - axes @ ((axes.T @ g) / values.abs().clamp(min=1e-3))
    slope = torch.func.grad(loss)
    plain = minimize(
        lambda x: loss(torch.tensor(x)).item(),
        newton.numpy() + 0.1,
        jac=lambda x: slope(torch.tensor(x)).numpy(),
        options={"gtol": 1e-9},
    )
    points = torch.tensor(np.c_[rig.landmarks, np.ones(len(rig.landmarks))].T)
    for other in (found.x, plain.x):
        away = ((pose(newton) - pose(torch.tensor(other))) @ points)[:3].norm(dim=0)
        assert away.max() < 1e-3


@pytest.mark.parametrize("corner", [False, True])
def test_single_precision_suffices_far_from_the_bound(pair, corner):
    """Cubes of distances nearly cancel there; summed as they are, poses were 0.2 mm off, or 200 mm for real jaws."""
    rig, layer = pair
    rng = np.random.default_rng(2)
    d = rng.choice([-200.0, 200.0], (500, 3)) if corner else rng.uniform(-200.0, 200.0, (500, 3)).round(1)
    d = torch.tensor(d, dtype=torch.float32)
    single, double = copy.deepcopy(layer).float()(d).double(), layer(d.double())
    landmarks = torch.tensor(np.column_stack([rig.landmarks, np.ones(len(rig.landmarks))]).T)
    assert ((single - double) @ landmarks)[:, :3].norm(dim=1).max() < 0.02
    np.testing.assert_allclose(double, rig.pose(d.double().numpy()), rtol=0, atol=1e-6)


def test_splines_whose_weights_do_not_balance_are_summed_as_they_are():
    rig = RIGS["anchored"]
    weights = rig.arrays["spline_weights"].copy()
    weights[0] += 1e-4
    other = JawRig({**rig.arrays, "spline_weights": weights}, rig.meta)
    d = np.random.default_rng(4).uniform(*rig.d_range.T, (100, 3))
    assert np.abs(other.pose(d) - rig.pose(d)).max() > 1e-3
    np.testing.assert_allclose(JawLayer(other)(torch.tensor(d)), other.pose(d), rtol=0, atol=1e-9)
