"""Models with derivatives, in the chart coordinates x (n, 3) [mm] of the search for the nearest pose.

As in `jawusd.evaluator.models`: for an anchored model, x is the displacement u of the incisal point; for others, x is d
itself. Derivatives are spatial, S (n, 6, 3) with ``M(x + e) = exp(S e) M(x)``; twists are (omega [rad], v [mm]).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor

from jawusd.base.arrays import Array
from jawusd.evaluator.formula import curve_derivatives, spline
from jawusd.evaluator.gauge import (
    INVERSE_ITERATIONS,
    INVERSE_STEP_MM,
    MAX_DOUBLINGS,
    MIN_INVERSE_SLOPE,
    PATIENCE,
    Elementary,
    displacement,
    gradient_by_u,
    opening_equation,
    spline_input,
)
from jawusd.evaluator.kinds import ADDITIVE, ANCHORED, AnchoredNumbers
from jawusd.evaluator.models import FORMS
from jawusd.evaluator.operations import triple
from jawusd.solvers.motion import OPERATIONS, MotionModule
from jawusd.solvers.solution import applied, attached, capturing, finished, inverse

_STEPS_CAPTURED = 7  # number of iterations of the inverse gauge in a captured graph; anatomical parameters need 5
_GAUGE_NUMBERS = 26  # number of scalars in `GaugeNumbers`
_SERIES_SQUARED = 0.09  # squared angle [rad^2] below which derivatives of the angle coefficients use series


def _glide(table: object, d2: Tensor, d3: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the values [mm] of a glide table at d2 (n,), d3 (n,) [mm], and their derivatives; zeros for None."""
    if not isinstance(table, MotionModule):
        return torch.zeros_like(d2), torch.zeros_like(d2), torch.zeros_like(d2)
    a, a_2 = _curve(table, "glide2", d2[:, None])
    b, b_3 = _curve(table, "glide3", d3[:, None])
    return (a * b).sum(dim=1), (a_2 * b).sum(dim=1), (a * b_3).sum(dim=1)


def _curve(module: MotionModule, name: str, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return the points and derivatives (n, k) of a module's curve at x (n, 1)."""
    (point,), (slope,), _ = curve_derivatives(name, x, module.tables(), OPERATIONS)
    return point, slope


TENSORS: Elementary[Tensor] = Elementary(torch.sqrt, torch.exp, OPERATIONS.clip, _glide)


class AnchoredMotion(MotionModule):
    """An anchored model; x is the displacement u of the incisal point."""

    centres: Tensor
    weights: Tensor

    def __init__(self, arrays: Mapping[str, Array]) -> None:
        super().__init__(ANCHORED, arrays)
        self._gliding = "glide_d2" in arrays

    def start(self, u: Tensor) -> Tensor:
        """Return u: the chart coordinates of this model are the displacements."""
        return u

    def derivative(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return rotation, translation [mm] and spatial derivative at u (n, 3) [mm]."""
        gauge, _, scales, *_, spread = self._anchored_numbers()
        # in the order of `AnchoredNumbers`
        incisor, _, tail, offset = self.singles[_GAUGE_NUMBERS : _GAUGE_NUMBERS + 18].split([3, 3, 9, 3])
        tail = tail.reshape(3, 3)
        sheared, slopes = spline_input(gauge, scales, triple(x.unbind(dim=1)), TENSORS)
        q = torch.stack(sheared, dim=1)
        away = q[:, None] - self.centres
        r = away.norm(dim=2)
        rows = [tail[i].unbind() for i in range(3)]
        inputs = triple(q.split(1, dim=1))
        omega = torch.cat(spline(inputs, self.centres, self.weights, rows, spread, OPERATIONS), dim=1) - offset
        by_q = 3.0 * self.weights.T @ (away * r[:, :, None]) + tail.T
        columns = slopes[0][:, None], slopes[1][:, None]
        by_u = torch.stack(gradient_by_u(triple(by_q.unbind(dim=2)), scales, columns), dim=2)
        R, J = _rotations(omega)
        moved = x + incisor
        turning = J @ by_u
        # the incisal point itself moves by dx: w x (x + p) + v = dx
        sliding = torch.linalg.cross(moved[:, :, None], turning, dim=1) + torch.eye(3, dtype=x.dtype, device=x.device)
        t = moved - R @ incisor
        return R, t, torch.cat([turning, sliding], dim=1)

    def decoded(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return d (n, 3) [mm] of u (n, 3) [mm], and dd/du (n, 3, 3); NaN where the search does not converge."""
        gauge = self._anchored_numbers().gauge
        d = self._inverse(x)
        _, (x_1, y_1, y_2, y_3, z_1, z_2) = displacement(gauge, d[:, 0], d[:, 1], d[:, 2], TENSORS)
        one, zero = torch.ones_like(x_1), torch.zeros_like(x_1)
        rows = ((x_1, one, zero), (y_1, y_2, y_3), (z_1, z_2, one))
        return d, inverse(torch.stack([torch.stack(row, dim=1) for row in rows], dim=1))

    def attached(self, d: Tensor, by_x: Tensor, x: Tensor) -> Tensor:
        """Return d and its derivatives with respect to u; one Newton step supplies the second derivatives."""
        d = attached(d, by_x, x)
        u, _ = displacement(self._anchored_numbers().gauge, d[:, 0], d[:, 1], d[:, 2], TENSORS)
        error = torch.stack(u, dim=1) - x
        return d - applied(by_x, error - error.detach())

    def _anchored_numbers(self) -> AnchoredNumbers:
        found = cast("AnchoredNumbers", self.numbers())
        return found._replace(gauge=found.gauge._replace(glide=self)) if self._gliding else found

    def _inverse(self, u: Tensor) -> Tensor:
        """Return the d (n, 3) [mm] of u (n, 3) [mm], as `jawusd.evaluator.gauge.Gauge.inverse` does."""
        gauge = self._anchored_numbers().gauge
        tolerance = 500 * torch.finfo(u.dtype).eps
        d1 = -u[:, 1]
        low, high = torch.full_like(d1, -torch.inf), torch.full_like(d1, torch.inf)
        wanted = triple(u.unbind(dim=1))
        for iteration in range(_STEPS_CAPTURED if capturing() else INVERSE_ITERATIONS):
            _, _, remainder, slope = opening_equation(gauge, wanted, d1, TENSORS)
            step = -remainder / torch.where(slope > MIN_INVERSE_SLOPE, slope, torch.ones_like(slope))
            step = step.clamp(-INVERSE_STEP_MM, INVERSE_STEP_MM)
            moving = step.abs() > tolerance * (1.0 + d1.abs())
            if finished(moving):
                break
            low, high = torch.where(remainder < 0, d1, low), torch.where(remainder > 0, d1, high)
            d1 = torch.where(moving, _next_opening(d1, step, low, high, iteration), d1)
        else:
            d1 = torch.where(moving, torch.nan, d1) if not capturing() else d1
        d2, d3, _, _ = opening_equation(gauge, wanted, d1, TENSORS)
        return torch.stack([d1, d2, d3], dim=1)


class DirectMotion(MotionModule):
    """A model of any kind; x is d. A subclass may provide the derivative in closed form, which halves the time."""

    starts: Tensor
    displacements: Tensor

    def __init__(self, kind: str, arrays: Mapping[str, Array]) -> None:
        super().__init__(kind, arrays)
        starts = FORMS[kind](arrays).starts
        self.register_buffer("starts", torch.tensor(starts.d))
        self.register_buffer("displacements", torch.tensor(starts.displacements))

    def start(self, u: Tensor) -> Tensor:
        """Return the grid point whose displacement is nearest to u (n, 3) [mm]."""
        grid = self.displacements
        return self.starts[(grid.square().sum(dim=1) - 2.0 * u @ grid.T).argmin(dim=1)]

    def derivative(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return rotation, translation [mm] and spatial derivative at d (n, 3) [mm]."""
        axes = torch.eye(3, dtype=x.dtype, device=x.device)
        M, by_d = zip(*(torch.func.jvp(self.forward, (x,), (axis.expand_as(x),)) for axis in axes))
        R, t, change = M[0][:, :3, :3], M[0][:, :3, 3], torch.stack(by_d, dim=3)
        # a change of d adds the rotation s, with dR R^T = [s], and shifts the origin by dt - s x t
        spin = torch.einsum("nijk,nlj->nilk", change[:, :3, :3], R)
        s = torch.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], dim=1)
        return R, t, torch.cat([s, change[:, :3, 3] - _cross(s, t[:, :, None])], dim=1)

    def decoded(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the chart coordinates x, which are d, and the identity as their derivative."""
        return x, torch.eye(3, dtype=x.dtype, device=x.device).expand(x.shape[0], 3, 3)

    def attached(self, d: Tensor, by_x: Tensor, x: Tensor) -> Tensor:
        """Return the chart coordinates x, which are d."""
        return x


class AdditiveMotion(DirectMotion):
    """An additive model; x is d."""

    def derivative(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return rotation, translation [mm] and spatial derivative at d (n, 3) [mm]."""
        values, slopes = zip(*(_curve(self, f"curve{i + 1}", x[:, i : i + 1]) for i in range(3)))
        return _twist_derivative(sum(values), torch.stack(slopes, dim=2))


#: A model as the search for its nearest pose uses it.
Chart = AnchoredMotion | DirectMotion


def chart_of(kind: str, arrays: Mapping[str, Array]) -> Chart:
    """Return the chart of a model of the given kind."""
    if kind == ANCHORED:
        return AnchoredMotion(arrays)
    return AdditiveMotion(kind, arrays) if kind == ADDITIVE else DirectMotion(kind, arrays)


def _next_opening(x: Tensor, step: Tensor, low: Tensor, high: Tensor, iteration: int) -> Tensor:
    """Return the next iterate of d1, as in `jawusd.evaluator.gauge`."""
    bounded = torch.isfinite(low) & torch.isfinite(high)
    late = max(iteration - PATIENCE, 0)
    stride = (step * 2.0 ** min(late, MAX_DOUBLINGS)).clamp(-INVERSE_STEP_MM, INVERSE_STEP_MM)
    newton = x + torch.where(bounded, step, stride)
    middle = torch.where(bounded, 0.5 * (low + high), newton)
    halve = (newton <= low) | (newton >= high) | (bounded if late % 2 == 1 else torch.zeros_like(bounded))
    return torch.where(bounded & halve, middle, newton)


def _skew(w: Tensor) -> Tensor:
    x, y, z = w.unbind(dim=1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=1).reshape(-1, 3, 3)


def _rotations(omega: Tensor) -> tuple[Tensor, Tensor]:
    """Return rotations and left Jacobians (n, 3, 3) of rotation vectors (n, 3) [rad]."""
    a, b, c = (x[:, :, None] for x in OPERATIONS.angle_coefficients(omega.square().sum(dim=1, keepdim=True)))
    W = _skew(omega)
    WW = W @ W
    identity = torch.eye(3, dtype=omega.dtype, device=omega.device)
    return identity + a * W + b * WW, identity + b * W + c * WW


def _twist_derivative(twist: Tensor, by_x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return R, t and the spatial derivative of exp(twist) for twists (n, 6) with derivatives (n, 6, 3).

    The translation is t = v + b w x v + c w x (w x v). A change of the twist adds the rotation s = J dw and shifts the
    origin by dt - s x t.
    """
    omega, v = twist[:, :3, None], twist[:, 3:, None]
    R, J = _rotations(twist[:, :3])
    squared = omega.square().sum(dim=1, keepdim=True)
    a, b, c = OPERATIONS.angle_coefficients(squared)
    b_1, c_1 = _coefficient_slopes(squared, a, b, c)
    e, s = by_x[:, :3], J @ by_x[:, :3]
    x = _cross(omega, v)
    y = _cross(omega, x)
    t = v + b * x + c * y
    bend = b * _cross(e, v) + c * (_cross(omega, _cross(e, v)) + _cross(e, x))
    along = 2.0 * (omega * e).sum(dim=1, keepdim=True)
    sliding = J @ by_x[:, 3:] + bend + along * (b_1 * x + c_1 * y) - _cross(s, t)
    return R, t[:, :, 0], torch.cat([s, sliding], dim=1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(a, b, dim=1)


def _coefficient_slopes(x: Tensor, a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Return db/dx and dc/dx at squared angles x [rad^2]; see `jawusd.fast.rigid.coefficient_slopes`."""
    small = x < _SERIES_SQUARED
    far = torch.where(small, torch.ones_like(x), x)
    series_b = -1 / 24 + x * (1 / 360 + x * (-1 / 13440 + x * (1 / 907200 - x / 95800320)))
    series_c = -1 / 120 + x * (1 / 2520 + x * (-1 / 120960 + x * (1 / 9979200 - x * 5 / 6227020800)))
    slope_b = (0.5 * a - b) / far
    slope_c = (-0.5 * (torch.cos(torch.sqrt(far)) - a) / far - c) / far
    return torch.where(small, series_b, slope_b), torch.where(small, series_c, slope_c)
