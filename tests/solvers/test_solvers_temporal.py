"""The prior on motion against scipy's normal distribution."""

import numpy as np
import pytest
import torch
from example_model import example_arrays, example_meta, moving_arrays
from scipy.stats import multivariate_normal

from jawusd.evaluator import JawRig
from jawusd.solvers import JawLayer, TemporalPrior

FPS = 50.0
RIG = JawRig({**example_arrays(), **moving_arrays()}, example_meta())


def motion(count=20, seed=1):
    return np.cumsum(np.random.default_rng(seed).normal(size=(count, 3)) * [0.6, 0.3, 0.2], axis=0)


def test_the_prior_is_the_exponent_of_normal_distributions():
    d = motion()
    expected = 0.0
    for order, covariance in ((1, RIG.speeds.velocity), (2, RIG.speeds.acceleration)):
        normal = multivariate_normal(np.zeros(3), covariance)
        expected += np.mean(normal.logpdf(np.zeros(3)) - normal.logpdf(np.diff(d, order, axis=0) * FPS**order))
    assert float(TemporalPrior(RIG.speeds)(torch.tensor(d), FPS)) == pytest.approx(expected, rel=1e-9)


def test_a_layer_has_the_prior_of_its_rig():
    layer, d = JawLayer(RIG), torch.tensor(motion())
    torch.testing.assert_close(layer.temporal(d, FPS), TemporalPrior(RIG.speeds)(d, FPS))
    single = JawLayer(RIG).to(torch.float32)
    assert float(single.temporal(d.float(), FPS)) == pytest.approx(float(layer.temporal(d, FPS)), rel=1e-4)
    assert "temporal.acceleration" in layer.state_dict()
    layer.load_state_dict(JawLayer(RIG).state_dict())
    assert JawLayer(JawRig(example_arrays(), example_meta())).temporal is None


def test_the_rate_of_frames_does_not_matter():
    prior, times = TemporalPrior(RIG.speeds), np.arange(400) / FPS
    d = torch.tensor(np.stack([10 * np.sin(5 * times), 2 * np.cos(3 * times), np.sin(4 * times)], axis=1))
    assert float(prior(d[::2].clone(), FPS / 2)) == pytest.approx(float(prior(d, FPS)), rel=0.02)


def test_gradients_batches_and_faults():
    prior = TemporalPrior(RIG.speeds)
    d = torch.tensor(motion(24, seed=2).reshape(3, 8, 3)).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: prior(d, FPS), d)
    torch.testing.assert_close(torch.func.vmap(lambda d: prior(d, FPS))(d), prior(d, FPS))
    assert prior(d, FPS).shape == (3,)
    assert float(prior(torch.ones(9, 3, dtype=torch.float64), FPS)) == 0.0
    with pytest.raises(TypeError, match="float32"):
        prior(d.float(), FPS)
    with pytest.raises(ValueError, match="three frames"):
        prior(d[:, :2], FPS)
