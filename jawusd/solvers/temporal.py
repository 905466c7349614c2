"""A prior on how a jaw moves from frame to frame: speeds and accelerations as a take of the person showed them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from jawusd.evaluator.speeds import Speeds


class TemporalPrior(nn.Module):
    """The squared Mahalanobis lengths of velocity and acceleration of d, zero for a jaw at rest.

    Both are taken as normal with mean zero; the inverses of their covariances are buffers, float64.

    Args:
        speeds: How fast the jaw moves: `JawRig.speeds`, or `Speeds.of_take`.
    """

    velocity: Tensor
    acceleration: Tensor

    def __init__(self, speeds: Speeds) -> None:
        super().__init__()
        for name, covariance in (("velocity", speeds.velocity), ("acceleration", speeds.acceleration)):
            self.register_buffer(name, torch.linalg.inv(torch.tensor(covariance)))

    def forward(self, d: Tensor, fps: float) -> Tensor:
        """Return the prior (...), of about 3 for motion like the take's, for d (..., F, 3) [mm] at a rate [1/s].

        Half the mean squared Mahalanobis length of the velocities, plus that of the accelerations.

        Raises:
            ValueError: fewer than three frames.
            TypeError: another type of number than the prior's.
        """
        if d.ndim < 2 or d.shape[-1] != 3 or d.shape[-2] < 3:
            raise ValueError(f"the shape of d must end in (F, 3) with three frames or more, got {tuple(d.shape)}")
        if d.dtype != self.velocity.dtype:
            raise TypeError(f"d is {d.dtype}, the prior computes in {self.velocity.dtype}. Convert one of them.")
        velocity = (d[..., 1:, :] - d[..., :-1, :]) * fps
        acceleration = (velocity[..., 1:, :] - velocity[..., :-1, :]) * fps
        lengths = [
            ((change @ precision) * change).sum(dim=-1).mean(dim=-1)
            for change, precision in ((velocity, self.velocity), (acceleration, self.acceleration))
        ]
        return 0.5 * (lengths[0] + lengths[1])
