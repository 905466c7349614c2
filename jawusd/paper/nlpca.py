"""A network of nonlinear PCA: what it makes of data, and data of components. `nlpca_training` finds its weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array


@dataclass(frozen=True)
class Nlpca:
    """A trained network."""

    # weights and biases, input to output: (D, h), (h,), (h, k), (k,), (k, h), (h,), (h, D), (D,)
    layers: tuple[Array, ...]
    scale: float  # factor on the data before the network
    centre: Array  # subtracted from the data first, shape (D,)
    cost: float

    @property
    def components(self) -> int:
        """The number of components."""
        return self.layers[2].shape[1]

    def encode(self, data: Array) -> Array:
        """Return the components (N, k) of data (N, D)."""
        W1, b1, W2, b2 = self.layers[:4]
        return np.tanh((data - self.centre) * self.scale @ W1 + b1) @ W2 + b2

    def decode(self, components: Array) -> Array:
        """Return the data (N, D) generated from components (N, k): Phi_gen of the paper."""
        W3, b3, W4, b4 = self.layers[4:]
        return (np.tanh(components @ W3 + b3) @ W4 + b4) / self.scale + self.centre

    def decode_rate(self, components: Array, direction: Array) -> Array:
        """Return the derivative of `decode` along a direction (k,) of the components, shape (N, D)."""
        W3, b3, W4, _ = self.layers[4:]
        hidden = np.tanh(components @ W3 + b3)
        return ((1 - hidden**2) * (direction @ W3)) @ W4 / self.scale
