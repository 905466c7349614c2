"""Hierarchical nonlinear PCA: an autoencoder whose bottleneck components are ordered by explained variance.

Scholz & Vigario, "Nonlinear PCA: a new hierarchical approach" (2002), with the defaults of Scholz's toolbox: layers
d-(2+2k)-k-(2+2k)-d with tanh hidden units, half the summed squared error of the reconstructions from the first 1, 2,
.. k components plus 0.01 times that from all but the first, weight decay 1e-3, data scaled to a largest standard
deviation of 0.1, weights initialised in U(-0.1, 0.1), and components reordered during training.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from scipy.optimize import minimize

from jawusd.base.arrays import Array

_SCALED_SD = 0.1
_WEIGHT_DECAY = 1e-3
_WITHOUT_FIRST = 0.01  # weight of the error of the reconstruction from components 2 to k
_START = 0.1
_STAGES = (60, 100, 150, 200, 300, 400, 1800)  # numbers of iterations between reorderings of components; 3010 in all
_MEMORY = 20
_GRADIENT_TOLERANCE, _COST_TOLERANCE = 1e-7, 1e-12
Values = TypeVar("Values", Array, torch.Tensor)


@dataclass(frozen=True)
class Nlpca:
    """A trained network."""

    # weights and biases, input to output: (D, h), (h,), (h, k), (k,), (k, h), (h,), (h, D), (D,)
    layers: tuple[Array, ...]
    scale: float  # factor that scales the centred data to the input of the network
    centre: Array  # offset subtracted from the data before scaling, shape (D,)
    cost: float  # final value of the training cost

    @property
    def components(self) -> int:
        """Number of components."""
        return self.layers[2].shape[1]

    def encode(self, data: Array) -> Array:
        """Encode data (N, D); return the components (N, k)."""
        W1, b1, W2, b2 = self.layers[:4]
        return np.tanh((data - self.centre) * self.scale @ W1 + b1) @ W2 + b2

    def decode(self, components: Array) -> Array:
        """Decode components (N, k), by Phi_gen of the paper; return the data (N, D)."""
        W3, b3, W4, b4 = self.layers[4:]
        return (np.tanh(components @ W3 + b3) @ W4 + b4) / self.scale + self.centre

    def decode_rate(self, components: Array, direction: Array) -> Array:
        """Return the derivative of `decode` along a direction (k,) of the components, shape (N, D)."""
        W3, b3, W4, _ = self.layers[4:]
        hidden = np.tanh(components @ W3 + b3)
        return ((1 - hidden**2) * (direction @ W3)) @ W4 / self.scale


def train_nlpca(data: Array, components: int, seed: int, *, centre: bool = False, stages: int = len(_STAGES)) -> Nlpca:
    """Train a network with k components on data (N, D) with L-BFGS; the result is deterministic for a given seed.

    Args:
        centre: whether to subtract the mean of the data first, which the toolbox does not do.
        stages: number of training stages; 4 of 7 reach a cost within a few percent in a tenth of the time.
    """
    mean = data.mean(0) if centre else np.zeros(data.shape[1])
    scale = _SCALED_SD / max(float((data - mean).std(0).max()), 1e-12)
    scaled = torch.from_numpy((data - mean) * scale)
    shapes = _shapes(data.shape[1], components)
    masks, factors = _hierarchy(components)

    def cost(flat: Array) -> tuple[float, Array]:
        weights = torch.from_numpy(flat).requires_grad_()
        value = _cost(_split(weights, shapes), weights, scaled, masks, factors)
        (gradient,) = torch.autograd.grad(value, weights)
        return float(value.detach()), gradient.numpy()

    rng = np.random.default_rng(seed)
    flat = rng.uniform(-_START, _START, sum(int(np.prod(shape)) for shape in shapes))
    with _one_thread():
        for iterations in _STAGES[:stages]:
            options: dict[str, float] = {"maxiter": iterations, "maxcor": _MEMORY, "maxfun": 10 * iterations}
            options |= {"gtol": _GRADIENT_TOLERANCE, "ftol": _COST_TOLERANCE}
            found = minimize(cost, flat, jac=True, method="L-BFGS-B", options=options)
            flat = _ordered(found.x, shapes, scaled.numpy())
            if found.nit < iterations and np.array_equal(flat, found.x):
                break
        value, _ = cost(flat)
    return Nlpca(tuple(part.copy() for part in _split(flat, shapes)), scale, mean, value)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Limit torch to one thread, which is faster for tiny networks and makes sums deterministic."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _shapes(width: int, components: int) -> list[tuple[int, ...]]:
    hidden = 2 + 2 * components
    return [
        (width, hidden), (hidden,), (hidden, components), (components,),
        (components, hidden), (hidden,), (hidden, width), (width,),
    ]  # fmt: skip


def _hierarchy(components: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the component mask of each reconstruction, shape (S, 1, k), and its weight in the cost, shape (S,)."""
    if components == 1:
        return torch.ones(1, 1, 1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    masks = np.vstack([np.tril(np.ones((components, components))), np.r_[0.0, np.ones(components - 1)]])
    return torch.from_numpy(masks[:, None, :]), torch.tensor([1.0] * components + [_WITHOUT_FIRST], dtype=torch.float64)


def _cost(
    layers: list[torch.Tensor], weights: torch.Tensor, data: torch.Tensor, masks: torch.Tensor, factors: torch.Tensor
) -> torch.Tensor:
    W1, b1, W2, b2, W3, b3, W4, b4 = layers
    components = torch.tanh(data @ W1 + b1) @ W2 + b2
    generated = torch.tanh((masks * components) @ W3 + b3) @ W4 + b4
    errors = ((generated - data) ** 2).sum((1, 2))
    return 0.5 * (factors * errors).sum() + 0.5 * _WEIGHT_DECAY * (weights**2).sum()


def _split(flat: Values, shapes: list[tuple[int, ...]]) -> list[Values]:
    parts, start = [], 0
    for shape in shapes:
        size = int(np.prod(shape))
        parts.append(flat[start : start + size].reshape(shape))
        start += size
    return parts


def _ordered(flat: Array, shapes: list[tuple[int, ...]], data: Array) -> Array:
    """Return the weights with the components reordered greedily by the remaining variance that each explains."""
    W1, b1, W2, b2, W3, b3, W4, b4 = _split(flat, shapes)
    components = np.tanh(data @ W1 + b1) @ W2 + b2
    order: list[int] = []
    rest = list(range(components.shape[1]))
    while rest:
        errors = []
        for index in rest:
            used = [*order, index]
            errors.append(((np.tanh(components[:, used] @ W3[used] + b3) @ W4 + b4 - data) ** 2).sum())
        order.append(rest.pop(int(np.argmin(errors))))
    return np.concatenate([part.ravel() for part in (W1, b1, W2[:, order], b2[order], W3[order], b3, W4, b4)])
