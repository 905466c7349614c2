"""Clearances in torch against the numpy evaluator, and inside torch's own tools."""

import numpy as np
import pytest
import torch
from example_model import example_arrays, example_meta, joint_arrays, touching_arrays

from jawusd.base.errors import EvaluatorError
from jawusd.evaluator import JawRig
from jawusd.solvers import JawLayer

RIG = JawRig({**example_arrays(), **touching_arrays(), **joint_arrays()}, example_meta())
LAYER = JawLayer(RIG)


def parameters(shape=(400,), seed=0):
    """Parameters on all sides of both grids, too."""
    return np.random.default_rng(seed).uniform([-4.0, -12.0, -4.0], [45.0, 12.0, 9.0], (*shape, 3))


@pytest.mark.parametrize("of", ["teeth", "condyles"])
def test_values_and_slopes_are_the_evaluators(of):
    d = torch.tensor(parameters((20, 20))).requires_grad_()
    found = LAYER.clearance(d, of)
    expected = RIG.clearance(d.detach().numpy(), of=of)
    np.testing.assert_allclose(found.detach().numpy(), expected.clearance_mm, atol=1e-12)
    (slope,) = torch.autograd.grad(found.sum(), d)
    np.testing.assert_allclose(slope.numpy(), expected.gradient, atol=1e-12)
    single = JawLayer(RIG).float().clearance(d.float(), of)
    np.testing.assert_allclose(single.detach().numpy(), expected.clearance_mm, atol=1e-4)


def test_nan_gives_nan_and_a_batch_of_none_nothing():
    d = torch.tensor([[1.0, float("nan"), 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    assert torch.isnan(LAYER.clearance(d)).tolist() == [True, False]
    assert LAYER.clearance(torch.zeros(0, 3, dtype=torch.float64)).shape == (0,)


def test_transforms_compiling_and_export():
    x = torch.tensor(parameters((30,), 1))
    torch.testing.assert_close(torch.func.vmap(LAYER.clearance)(x), LAYER.clearance(x))
    jacobians = torch.func.vmap(torch.func.jacrev(LAYER.clearance))(x)
    np.testing.assert_allclose(jacobians.numpy(), RIG.clearance(x.numpy()).gradient, atol=1e-12)
    torch._dynamo.reset()
    compiled = torch.compile(LAYER.clearance, fullgraph=True, dynamic=True, backend="aot_eager")
    torch.testing.assert_close(compiled(x), LAYER.clearance(x))

    class Wrapped(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = LAYER

        def forward(self, d):
            return self.layer.clearance(d)

    program = torch.export.export(Wrapped(), (x,), dynamic_shapes=({0: torch.export.Dim("n")},))
    torch.testing.assert_close(program.module()(x[:7]), LAYER.clearance(x[:7]))


def test_buffers_decide_and_the_state_is_complete():
    values = touching_arrays()["contact_values"] + 30
    other = JawLayer(JawRig({**RIG.arrays, "contact_values": values}, example_meta()))
    x = torch.tensor(parameters((30,), 2))
    assert not torch.equal(other.clearance(x), LAYER.clearance(x))
    with pytest.raises(EvaluatorError, match="is of rig"):
        other.load_state_dict(LAYER.state_dict())
    teeth = {name.removeprefix("teeth."): v for name, v in LAYER.state_dict().items() if name.startswith("teeth.")}
    found = torch.func.functional_call(other.teeth, teeth, x)
    torch.testing.assert_close(found, LAYER.clearance(x), rtol=0, atol=0)


def test_rigs_without_clearances_say_so():
    layer = JawLayer(JawRig(example_arrays(), example_meta()))
    for of in ("teeth", "condyles"):
        with pytest.raises(EvaluatorError, match=of):
            layer.clearance(torch.zeros(3, dtype=torch.float64), of)
    with pytest.raises(TypeError, match="float32"):
        LAYER.clearance(torch.zeros(3))
