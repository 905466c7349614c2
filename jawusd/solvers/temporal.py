"""A prior on how a jaw moves from frame to frame: speeds and accelerations as a take of the person showed them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_FEWEST_FRAMES = 30
_LEAST_SPREAD = 1e-6  # relative; keeps the covariances of takes that move along one line invertible


class TemporalPrior(nn.Module):
    """The squared Mahalanobis lengths of velocity and acceleration of d, zero for a jaw at rest.

    Both are taken as normal with mean zero and the covariances of a take, whose inverses are buffers.

    Args:
        d: Jaw parameters [mm] of consecutive frames of a take, shape (F, 3), such as `solve` or `encode` give. Where a
            frame is lost (NaN), what it takes part in is left out.
        fps: Frames per second of the take.

    Raises:
        ValueError: another shape, a rate that is not positive, or too few frames in a row.
    """

    velocity: Tensor
    acceleration: Tensor

    def __init__(self, d: Tensor, fps: float) -> None:
        super().__init__()
        if d.ndim != 2 or d.shape[1] != 3 or not fps > 0:
            raise ValueError(f"a take has d of shape (F, 3) and a positive rate, got {tuple(d.shape)} and {fps}")
        for name, change in zip(("velocity", "acceleration"), _changes(d.detach().double(), fps)):
            seen = change[torch.isfinite(change).all(dim=1)]
            if len(seen) < _FEWEST_FRAMES:
                raise ValueError(f"the take has {len(seen)} frames in a row, at least {_FEWEST_FRAMES} are needed")
            covariance = seen.T @ seen / len(seen)
            least = _LEAST_SPREAD * covariance.diagonal().mean() + 1e-12
            precision = torch.linalg.inv(covariance + least * torch.eye(3, dtype=covariance.dtype))
            self.register_buffer(name, precision.to(d.dtype))

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
        lengths = [
            ((change @ precision) * change).sum(dim=-1).mean(dim=-1)
            for change, precision in zip(_changes(d, fps), (self.velocity, self.acceleration))
        ]
        return 0.5 * (lengths[0] + lengths[1])


def _changes(d: Tensor, fps: float) -> tuple[Tensor, Tensor]:
    """Return velocities (..., F - 1, 3) [mm/s] and accelerations (..., F - 2, 3) [mm/s^2]."""
    velocity = (d[..., 1:, :] - d[..., :-1, :]) * fps
    return velocity, (velocity[..., 1:, :] - velocity[..., :-1, :]) * fps
