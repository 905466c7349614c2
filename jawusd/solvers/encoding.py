"""Find the nearest model poses of batches on any device, by damped Gauss-Newton as in `jawusd.evaluator.solver`."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from jawusd.evaluator.nearest import ITERATIONS, MAX_DAMPING, MIN_DAMPING, MIN_STIFFNESS, START_DAMPING
from jawusd.solvers.charts import Chart
from jawusd.solvers.solution import applied, attached, capturing, finished, inverse, solved

# x (n, 3), targets (n, 3, m) -> residuals (n, 3 m) and their derivatives with respect to x (n, 3 m, 3)
Residual = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]

_STEPS_CAPTURED = 6
# number of Newton steps after Gauss-Newton, which converges slowly for poses far from the model
_NEWTON_STEPS, _NEWTON_STEPS_CAPTURED = 4, 2
# addition to the Hessian, relative to its diagonal; keeps encodings differentiable where a parameter hardly moves the
# landmarks
_MIN_CURVATURE = 1e-9


def encoded(chart: Chart, vectors: Tensor, target: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Return d (n, 3) [mm] whose motion brings vectors closest to their targets, and the residuals (n, 3 m) [mm].

    First and second derivatives with respect to the targets are exact, to the accuracy of the search. With its result
    x0, and the inverse Hessian H and Jacobian J there as constants, ``x1 = x0 + H J^T (target - target0)`` is correct
    to first order; one step ``x2 = x1 - H grad(x1, target)`` makes it correct to second order. Second derivatives of
    the sum of squared residuals are exact, too, but not those of single residuals.

    Args:
        vectors: Homogeneous vectors (4, m), anatomical frame [mm].
        target: Target positions [mm], shape (n, 3, m).
        u: Displacements (n, 3) [mm] of the incisal point, where the search starts.
    """
    residual = _residual_of(chart, vectors)
    width = target.shape[1:]

    def search(rows: Tensor) -> tuple[Tensor, ...]:
        return _nearest(chart, residual, rows[:, 3:].unflatten(1, width), rows[:, :3])

    flat = target.flatten(1)
    x, H_inverse, by_target, d, by_x = solved(search, torch.cat([u, flat], dim=1))
    x = attached(x, by_target, flat)
    r, J = residual(x, target)
    gradient = applied(J.transpose(1, 2), r)
    x = x - applied(H_inverse, gradient - gradient.detach())
    return chart.attached(d, by_x, x), r


def _residual_of(chart: Chart, vectors: Tensor) -> Residual:
    def residual(x: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        R, t, S = chart.derivative(x)
        image = R @ vectors[:3] + t[:, :, None] * vectors[3]
        # a vector (b, h) moves by w x image + v h under the spatial velocity (w, v)
        turned = torch.linalg.cross(S[:, :3, None], image[..., None], dim=1)
        J = turned + S[:, 3:, None] * vectors[3][:, None]
        return (image - target).flatten(1), J.flatten(1, 2)

    return residual


def _nearest(chart: Chart, residual: Residual, target: Tensor, u: Tensor) -> tuple[Tensor, ...]:
    """Return x (n, 3), the inverse Hessian (n, 3, 3), dx / dtarget (n, 3, 3 m), d (n, 3) [mm] and dd / dx (n, 3, 3)."""
    x, r, J = _descended(residual, chart.start(u), target)
    H = _curvature(residual, x, target)
    g = applied(J.transpose(1, 2), r)
    for _ in range(_NEWTON_STEPS_CAPTURED if capturing() else _NEWTON_STEPS):
        step = applied(inverse(H), g)
        if finished(step.abs().amax(dim=1) > 1e-3 * _tolerance_mm(x)):
            break
        r_trial, J_trial = residual(x - step, target)
        g_trial = applied(J_trial.transpose(1, 2), r_trial)
        # near the minimum, changes of the residual are below rounding: compare gradients instead
        better = g_trial.square().sum(dim=1) <= g.square().sum(dim=1)
        x, r = torch.where(better[:, None], x - step, x), torch.where(better[:, None], r_trial, r)
        J, g = torch.where(better[:, None, None], J_trial, J), torch.where(better[:, None], g_trial, g)
        H = _curvature(residual, x, target)
    H_inverse = inverse(H)
    return x, H_inverse, H_inverse @ J.transpose(1, 2), *chart.decoded(x)


def _tolerance_mm(x: Tensor) -> float:
    return 1e-6 if x.dtype == torch.float64 else 1e-4


def _descended(residual: Residual, x: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the minimum x (n, 3) [mm], and the residual and its derivative there."""
    tolerance_mm = _tolerance_mm(x)
    r, J = residual(x, target)
    cost = r.square().sum(dim=1)
    damping = torch.full_like(cost, START_DAMPING)
    identity = torch.eye(3, dtype=x.dtype, device=x.device)
    for _ in range(_STEPS_CAPTURED if capturing() else ITERATIONS):
        slopes = J.transpose(1, 2)
        A = slopes @ J
        amount = damping * A.diagonal(dim1=1, dim2=2).mean(dim=1) + MIN_STIFFNESS
        step = applied(inverse(A + amount[:, None, None] * identity), applied(slopes, r))
        trial = x - step
        r_trial, J_trial = residual(trial, target)
        cost_trial = r_trial.square().sum(dim=1)
        moving = (step.abs().amax(dim=1) > tolerance_mm) & (damping < MAX_DAMPING)
        # the last step doubles the number of correct digits: accept it even if it improves by less than the rounding
        # error
        taken = (cost_trial <= cost) | ~moving
        damping = torch.where(taken, (damping * 0.1).clamp(min=MIN_DAMPING), damping * 10.0)
        x, r = torch.where(taken[:, None], trial, x), torch.where(taken[:, None], r_trial, r)
        J, cost = torch.where(taken[:, None, None], J_trial, J), torch.where(taken, cost_trial, cost)
        if finished(moving):
            break
    return x, r, J


def _curvature(residual: Residual, x: Tensor, target: Tensor) -> Tensor:
    """Return the Hessian (n, 3, 3) of half the squared residual, by central differences of its exact gradient in x."""
    h = 1e-4 if x.dtype == torch.float64 else 2e-2
    shifts = h * torch.eye(3, dtype=x.dtype, device=x.device)
    around = torch.cat([x[:, None] + shifts, x[:, None] - shifts], dim=1)
    r, J = residual(around.flatten(0, 1), target[:, None].expand(-1, 6, -1, -1).flatten(0, 1))
    g = applied(J.transpose(1, 2), r).reshape(-1, 2, 3, 3)
    H = (g[:, 0] - g[:, 1]) / (2.0 * h)
    H = 0.5 * (H + H.transpose(1, 2))
    floor = _MIN_CURVATURE * H.diagonal(dim1=1, dim2=2).abs().mean(dim=1)
    return H + floor[:, None, None] * torch.eye(3, dtype=x.dtype, device=x.device)
