"""A jaw rig as a torch module: poses, margins, encoding, and a prior on jaw poses that other solvers can add."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from jawusd.evaluator import JawRig
from jawusd.evaluator.distances import landmark_vectors
from jawusd.geometry.se3 import se3_inverse
from jawusd.solvers.motion import MarginModule, MotionModule

_LEAST_CURVATURE = 1e-9  # relative; keeps encodings differentiable where a parameter hardly moves the landmarks


class JawLayer(nn.Module):
    """Evaluate a rig on torch tensors, with gradients, in float32 or float64, on any device.

    ``layer(d)`` is `JawRig.pose`. Nothing is trained: the rig's arrays are buffers, so ``.to(...)`` moves them.

    Args:
        rig: The rig. Encoding searches with it on the CPU.
    """

    from_anatomical: Tensor
    closed: Tensor
    vectors: Tensor

    def __init__(self, rig: JawRig) -> None:
        super().__init__()
        self.rig = rig
        self.motion = MotionModule(rig.kind, rig.arrays)
        self.bound = MarginModule(rig.arrays)
        A = rig.T_anatomical_skull
        closed = A @ rig.T_rest
        self.register_buffer("from_anatomical", torch.tensor(se3_inverse(A)))
        self.register_buffer("closed", torch.tensor(closed))
        vectors = landmark_vectors(rig.landmarks)
        self.register_buffer("vectors", torch.tensor(vectors))

    def forward(self, d: Tensor) -> Tensor:
        """Return the poses T_skull_mandible, shape (..., 4, 4), for jaw parameters d (..., 3) [mm]."""
        rows = _rows(d, (3,))
        return self._poses(rows).reshape(*d.shape[:-1], 4, 4)

    def margin(self, d: Tensor) -> Tensor:
        """Return the signed distance (...) of d (..., 3) to the bound [mm], positive inside."""
        return self.bound(_rows(d, (3,))).reshape(d.shape[:-1])

    def penalty(self, d: Tensor) -> Tensor:
        """Return the squared distance (...) by which d (..., 3) lies outside the bound [mm^2]; zero inside."""
        return torch.relu(-self.margin(d)).square()

    def encode(self, T_skull_mandible: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nearest jaw parameters and the landmark distance to them, as `JawRig.encode` does.

        The derivatives by the pose are those of the nearest point itself: the implicit function theorem on
        ``grad_d |pose(d) - T|^2 = 0``, second derivatives of the model included.

        Args:
            T_skull_mandible: Poses, shape (..., 4, 4).

        Returns:
            d [mm], shape (..., 3), and residual_mm, shape (...). The distance has a kink where it is zero; its
            gradient there is taken as zero.
        """
        d, squared = self._encode(T_skull_mandible)
        on_model = squared == 0
        distance = torch.sqrt(torch.where(on_model, torch.ones_like(squared), squared))
        return d, torch.where(on_model, torch.zeros_like(squared), distance)

    def _encode(self, T_skull_mandible: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nearest d [mm], shape (..., 3), and the squared residual [mm^2], smooth at zero too."""
        T = _rows(T_skull_mandible, (4, 4))
        found, _ = self.rig.encode(T.detach().cpu().double().numpy())
        at = torch.tensor(found, dtype=T.dtype, device=T.device)
        target = (T @ self.vectors)[:, :3].reshape(-1, 12)
        d = at
        if T.requires_grad and torch.is_grad_enabled():
            # a Newton step from the minimum: nowhere to go, but its derivative by the target is the minimum's own
            slope, H = self._slope_and_curvature(at, target)
            d = at - torch.linalg.solve(H, slope - slope.detach())
        squared = (self._images(d) - target).square().sum(dim=1)
        batch = T_skull_mandible.shape[:-2]
        return d.reshape(*batch, 3), squared.reshape(batch)

    def loss(self, T_skull_mandible: Tensor) -> Tensor:
        """Return a prior on jaw poses (..., 4, 4) [mm^2]: squared residual plus `penalty` of the nearest parameters.

        It is zero for every pose of this person's jaw and grows with the distance to the model and to the bound: a
        replacement for the usual pull towards the closed mouth. Shape (...), smooth everywhere.
        """
        d, squared = self._encode(T_skull_mandible)
        return squared + self.penalty(d)

    def _poses(self, d: Tensor) -> Tensor:
        return self.from_anatomical @ self.motion(d) @ self.closed

    def _images(self, d: Tensor) -> Tensor:
        """Return the images (n, 12) of the four vectors that represent the landmarks, see `evaluator.encoding`."""
        return (self._poses(d) @ self.vectors)[:, :3].reshape(-1, 12)

    def _slope_and_curvature(self, d: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return gradient (n, 3) and Hessian (n, 3, 3) by d of half the squared distance of images and target (n, 12).

        The gradient is differentiable by the target; the Hessian is a constant.
        """
        with torch.enable_grad():
            x = d.detach().requires_grad_()
            image = self._images(x)
            (slope,) = torch.autograd.grad(image, x, image.detach() - target, create_graph=True)
            half = 0.5 * (image - target.detach()).square().sum()
            (gradient,) = torch.autograd.grad(half, x, create_graph=True)
            columns = [torch.autograd.grad(gradient[:, i].sum(), x, retain_graph=True)[0] for i in range(3)]
        H = torch.stack(columns, dim=2)
        floor = _LEAST_CURVATURE * H.diagonal(dim1=1, dim2=2).abs().mean(dim=1)
        return slope, H + floor[:, None, None] * torch.eye(3, dtype=d.dtype, device=d.device)


def _rows(values: Tensor, tail: tuple[int, ...]) -> Tensor:
    if values.shape[values.ndim - len(tail) :] != tail:
        raise ValueError(f"the shape must end in {tail}, got {tuple(values.shape)}")
    return values.reshape(-1, *tail)
