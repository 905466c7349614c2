"""The clearances of a rig in torch: trilinear between sampled values, as `jawusd.evaluator.contact` has them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from jawusd.evaluator.contact import ContactField

_CORNERS = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]


class Clearances(nn.Module):
    """A field over d, all of it in buffers.

    Args:
        field: The field of a rig.
    """

    first: Tensor
    step: Tensor
    last: Tensor
    values: Tensor

    def __init__(self, field: ContactField) -> None:
        super().__init__()
        last = np.array(field.values.shape, dtype=np.float64) - 1.0
        for name, value in (("first", field.first_mm), ("step", field.step_mm), ("last", last)):
            self.register_buffer(name, torch.tensor(value))
        self.register_buffer("values", torch.tensor(field.values.ravel()))

    def forward(self, d: Tensor) -> Tensor:
        """Return the clearances (n,) [mm] at d (n, 3) [mm]; NaN for NaN."""
        place = torch.minimum(torch.clamp((d - self.first) / self.step, min=0.0), self.last)
        cell = torch.minimum(torch.nan_to_num(place.detach()).floor(), self.last - 1.0)
        share = place - cell
        counts, low = self.last.long() + 1, cell.long()
        found = torch.zeros_like(d[:, 0])
        for i, j, k in _CORNERS:
            row = ((low[:, 0] + i) * counts[1] + low[:, 1] + j) * counts[2] + low[:, 2] + k
            a, b, c = (share[:, axis] if far else 1.0 - share[:, axis] for axis, far in enumerate((i, j, k)))
            found = found + self.values[row] * a * b * c
        return found
