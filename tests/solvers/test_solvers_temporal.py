"""The prior on motion against numpy's covariances and scipy's normal distribution."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from jawusd.solvers import TemporalPrior

FPS = 50.0


def take(count=4000, seed=0):
    """Chewing-like motion, smooth, of three correlated parameters [mm]."""
    rng = np.random.default_rng(seed)
    times = np.arange(count) / FPS
    waves = rng.uniform(0.3, 3.0, (12, 1)) * times + rng.uniform(0, 1, (12, 1))
    return (np.sin(2 * np.pi * waves).T @ rng.normal(size=(12, 3))) * [6.0, 2.0, 1.0]


def test_the_prior_is_the_exponent_of_normal_distributions():
    d, other = take(), take(20, seed=1)
    prior = TemporalPrior(torch.tensor(d), FPS)
    expected = 0.0
    for order in (1, 2):
        seen, moved = (np.diff(x, order, axis=0) * FPS**order for x in (d, other))
        normal = multivariate_normal(np.zeros(3), seen.T @ seen / len(seen))
        expected += np.mean(normal.logpdf(np.zeros(3)) - normal.logpdf(moved))
    assert float(prior(torch.tensor(other), FPS)) == pytest.approx(expected, rel=1e-4)
    assert float(prior(torch.tensor(d), FPS)) == pytest.approx(3.0, rel=1e-4)


def test_the_rate_of_frames_does_not_matter_and_lost_frames_are_left_out():
    d = take()
    gaps = d.copy()
    gaps[100:120] = np.nan
    whole, holed = TemporalPrior(torch.tensor(d), FPS), TemporalPrior(torch.tensor(gaps), FPS)
    torch.testing.assert_close(holed.velocity, whole.velocity, rtol=0.05, atol=1e-6)
    twice = torch.tensor(d[::2].copy())
    assert float(whole(twice, FPS / 2)) == pytest.approx(float(whole(torch.tensor(d), FPS)), rel=0.1)


def test_gradients_batches_and_faults():
    prior = TemporalPrior(torch.tensor(take()), FPS)
    d = torch.tensor(take(24, seed=2).reshape(3, 8, 3)).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: prior(d, FPS), d)
    torch.testing.assert_close(torch.func.vmap(lambda d: prior(d, FPS))(d), prior(d, FPS))
    assert prior(d, FPS).shape == (3,)
    assert float(prior(torch.ones(9, 3, dtype=torch.float64), FPS)) == 0.0
    with pytest.raises(TypeError, match="float32"):
        prior(d.float(), FPS)
    with pytest.raises(ValueError, match="three frames"):
        prior(d[:, :2], FPS)
    with pytest.raises(ValueError, match="in a row"):
        TemporalPrior(torch.zeros(5, 3), FPS)
