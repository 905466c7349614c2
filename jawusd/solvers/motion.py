"""The two model forms in torch: the formulas of `jawusd.evaluator.models`, differentiable and on any device.

Rows only: d has shape (n, 3) [mm]; motions M(d) are (n, 4, 4) in the anatomical frame [mm].
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from jawusd.evaluator.curves import HermiteCurve
from jawusd.evaluator.gauge import (
    ARCH_BOW_MM,
    DROP_BEND,
    DROP_SATURATION_MM2,
    FADE_SOFTNESS_MM,
    LIMIT_SOFTNESS_MM,
    Gauge,
)
from jawusd.evaluator.models import AdditiveModel, AnchoredModel

_SMALL_ANGLE_SQUARED = 1e-4
_TINY = 1e-30  # keeps the slope of a root at zero finite


class AnchoredMotion(nn.Module):
    """`AnchoredModel` in torch."""

    def __init__(self, model: AnchoredModel) -> None:
        super().__init__()
        self._gauge = model.gauge
        for name in ("incisor", "scales", "centres", "weights", "offset"):
            self.register_buffer(name, torch.tensor(getattr(model, name)))
        self.register_buffer("path", torch.tensor(model.gauge.path_coefficients))

    def forward(self, d: Tensor) -> Tensor:
        """Return M(d)."""
        u = self._displacement(d)
        gx, gz = self._path(-u[:, 1])
        q = torch.stack([-u[:, 1], u[:, 0] - gx, u[:, 2] - gz], dim=1) / self.scales
        squared = (q[:, None] - self.centres).square().sum(dim=2)
        cubes = squared * torch.sqrt(squared + _TINY)
        R = rotation(torch.cat([cubes, q], dim=1) @ self.weights - self.offset)
        return transform(R, u + self.incisor - R @ self.incisor)

    def _displacement(self, d: Tensor) -> Tensor:
        gauge: Gauge = self._gauge
        d1, d2, d3 = d.unbind(dim=1)
        gx, gz = self._path(d1)
        low, high = gauge.path_limits
        inside = low + _ramp(d1 - low, LIMIT_SOFTNESS_MM) - _ramp(d1 - high, LIMIT_SOFTNESS_MM)
        t = inside / gauge.path_scale_mm
        e = gauge.glide_softness_mm
        side = torch.sqrt(d2.square() + e * e) - e
        c = gauge.glide_arch.tolist()
        bow = (c[5] + c[6] * t) / ARCH_BOW_MM
        rho = side * ((c[2] * t + c[1]) * t + c[0]) + d2 * (c[4] * t + c[3] + d2 * bow)
        front = _ramp(d3, e)
        c = gauge.glide_drop.tolist()
        drop = c[0] * side + c[1] * front + c[2] * _bent(side) + c[3] * _bent(front)
        fade = torch.exp(-(_ramp(d1, FADE_SOFTNESS_MM) / gauge.glide_fade_mm).square())
        return torch.stack([gx + d2, -(d1 + drop * fade), gz + rho + d3], dim=1)

    def _path(self, d1: Tensor) -> tuple[Tensor, Tensor]:
        inside = d1.clamp(*self._gauge.path_limits)
        scale = self._gauge.path_scale_mm
        s = inside / scale
        out = []
        for a, b, c, d, e in self.path.unbind(dim=0):
            value = ((((e * s + d) * s + c) * s + b) * s + a) * s
            slope = ((((5 * e * s + 4 * d) * s + 3 * c) * s + 2 * b) * s + a) / scale
            out.append(value + slope * (d1 - inside))
        return out[0], out[1]


class AdditiveMotion(nn.Module):
    """`AdditiveModel` in torch."""

    def __init__(self, model: AdditiveModel) -> None:
        super().__init__()
        self.curves = nn.ModuleList(Curve(curve) for curve in model.curves)

    def forward(self, d: Tensor) -> Tensor:
        """Return M(d)."""
        twist = sum(curve(x) for curve, x in zip(self.curves, d.unbind(dim=1)))
        omega, v = twist[:, :3], twist[:, 3:]
        _, b, c = _angle_coefficients(omega)
        turned = torch.linalg.cross(omega, v)
        return transform(rotation(omega), v + b * turned + c * torch.linalg.cross(omega, turned))


class Curve(nn.Module):
    """`HermiteCurve` in torch."""

    def __init__(self, curve: HermiteCurve) -> None:
        super().__init__()
        for name in ("knots", "starts", "coefficients"):
            self.register_buffer(name, torch.tensor(getattr(curve, name)))

    def forward(self, x: Tensor) -> Tensor:
        """Return the points (n, k) at x (n,)."""
        interval = torch.searchsorted(self.knots, x.detach().contiguous(), right=True)
        c0, c1, c2, c3 = self.coefficients[interval].unbind(dim=1)
        s = (x - self.starts[interval])[:, None]
        return ((c3 * s + c2) * s + c1) * s + c0


def rotation(omega: Tensor) -> Tensor:
    """Return the rotation matrices (n, 3, 3) of rotation vectors (n, 3) [rad]; smooth at zero."""
    a, b, _ = _angle_coefficients(omega)
    x, y, z = omega.unbind(dim=1)
    zero = torch.zeros_like(x)
    W = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    return torch.eye(3, dtype=omega.dtype, device=omega.device) + a[..., None] * W + b[..., None] * (W @ W)


def transform(R: Tensor, t: Tensor) -> Tensor:
    """Return transforms (n, 4, 4) of rotations (n, 3, 3) and translations (n, 3)."""
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype, device=R.device).expand(len(R), 1, 4)
    return torch.cat([torch.cat([R, t[:, :, None]], dim=2), bottom], dim=1)


def _angle_coefficients(omega: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3, each (n, 1), with finite derivatives at zero."""
    squared = omega.square().sum(dim=1, keepdim=True)
    small = squared < _SMALL_ANGLE_SQUARED
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = torch.sqrt(safe)
    sine, half = torch.sin(angle), torch.sin(0.5 * angle)
    s = torch.where(small, squared, torch.zeros_like(squared))
    return (
        torch.where(small, 1 - s / 6 * (1 - s / 20 * (1 - s / 42)), sine / angle),
        torch.where(small, 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56)), 2 * half.square() / safe),
        torch.where(small, 1 / 6 - s / 120 * (1 - s / 42 * (1 - s / 72)), (angle - sine) / (safe * angle)),
    )


def _ramp(x: Tensor, softness_mm: float) -> Tensor:
    return 0.5 * (x + torch.sqrt(x.square() + softness_mm * softness_mm) - softness_mm)


def _bent(x: Tensor) -> Tensor:
    return DROP_BEND * x.square() / torch.sqrt(1 + x.square() / DROP_SATURATION_MM2)
