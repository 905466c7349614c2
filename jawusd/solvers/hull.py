"""The slice hull in torch, with derivatives, and the nearest points inside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from jawusd.base.arrays import Array
from jawusd.evaluator import nearest as limits
from jawusd.evaluator.arrays import flat_arrays
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.formula import BoundFormula, curve, curve_derivatives
from jawusd.evaluator.operations import triple
from jawusd.solvers.motion import OPERATIONS, Formula
from jawusd.solvers.solution import applied, capturing, finished, inverse

_STEPS_CAPTURED, _PULLS_CAPTURED = 12, 2
_START_DAMPING = 1e-3
_POLISHING, _POLISH_MM = 2, 0.01  # number of final Newton steps, and maximum accepted length of a step [mm]
_VALLEYS = 4
_ROWS = 512  # number of rows compared at once with all candidates


class Expansion(NamedTuple):
    """The signed distance (n,) [mm], its gradient (n, 3), and its Hessian (n, 3, 3) [1/mm] in two parts.

    The part due to the rounded edges is positive semidefinite; that due to the curvature along d1 may be indefinite.
    """

    distance: Tensor
    gradient: Tensor
    rounding: Tensor
    bending: Tensor


class Hull(Formula):
    """The slice hull of a rig, see `jawusd.evaluator.bounds`; raises EvaluatorError if it is empty."""

    directions: Tensor
    scan: Tensor

    def __init__(self, arrays: Mapping[str, Array]) -> None:
        formula = BoundFormula(flat_arrays(arrays))
        super().__init__(formula.tables, formula.numbers)
        self._formula = formula
        self.register_buffer("scan", torch.tensor(_by_slices(SliceHull(arrays).candidates())))

    def margin(self, d: Tensor) -> Tensor:
        """Return the margins (n,) [mm] of d (n, 3) [mm], positive inside."""
        d = torch.clamp(d, -1e9, 1e9)
        columns = triple(d.split(1, dim=1))
        return self._formula.margin(columns, self.tables(), OPERATIONS, numbers=self.numbers())[:, 0]

    def slope(self, d: Tensor) -> tuple[Tensor, Tensor]:
        """Return the signed distance (n,) [mm] at d (n, 3) [mm] and its gradient (n, 3)."""
        distance, weights, slopes, _ = self._sides(d)
        return distance, applied(slopes.transpose(1, 2), weights)

    def expansion(self, d: Tensor) -> Expansion:
        """Return the signed distance and its derivatives at d (n, 3) [mm]."""
        distance, weights, slopes, reach_11 = self._sides(d)
        gradient = applied(slopes.transpose(1, 2), weights)
        away = slopes - gradient[:, None]
        rounding = away.transpose(1, 2) @ (away * weights[..., None]) / self.singles[2]
        bend = -(weights[:, :-2] * reach_11).sum(dim=1)
        bending = torch.nn.functional.pad(bend[:, None, None], (0, 2, 0, 2))
        return Expansion(distance, gradient, rounding, bending)

    def _sides(self, d: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the distance (n,) [mm], weights (n, k), gradients (n, k, 3) of the half-spaces, and d^2 reach / dd1^2.

        The half-spaces are in the order of `jawusd.evaluator.bounds`: the sides, then both ends.
        """
        first, last, softness, offset = self.singles.unbind()
        (reach,), (reach_1,), (reach_11,) = curve_derivatives("support", d[:, :1], self.tables(), OPERATIONS)
        v = torch.cat([d[:, 1:] @ self.directions.T - reach, first - d[:, :1], d[:, :1] - last], dim=1) / softness
        end = torch.ones_like(d[:, :1])
        along = torch.cat([-reach_1, -end, end], dim=1)
        across = torch.nn.functional.pad(self.directions, (0, 0, 0, 2)).expand(d.shape[0], -1, -1)
        slopes = torch.cat([along[..., None], across], dim=2)
        distance = softness * torch.logsumexp(v, dim=1) - offset
        return distance, torch.softmax(v, dim=1), slopes, reach_11

    def upper_margin(self, d: Tensor) -> Tensor:
        """Return an upper bound (n,) [mm] on all margins in the section that contains d (n, 3).

        Moving from d in any direction approaches the edge of some half-plane.
        """
        offset = self.singles[3]
        (reach,) = curve("support", d[:, :1], self.tables(), OPERATIONS)
        return offset + (reach - d[:, 1:] @ self.directions.T).amax(dim=1)

    def nearest(self, d: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points (n, 3) [mm] with margin >= 0 nearest to d (n, 3), and their derivatives (n, 3, 3).

        On the bound, the derivative follows from the implicit function theorem on ``x - d + multiplier grad = 0,
        distance(x) = 0``.
        """
        identity = torch.eye(3, dtype=d.dtype, device=d.device).expand(d.shape[0], 3, 3)
        if capturing():
            return self._on_bound_or_inside(d, identity)
        x, by_d = d.clone(), identity.clone()
        out = self.margin(d) < 0
        if bool(out.any()):
            x[out], by_d[out] = self._on_bound_or_inside(d[out], identity[out])
        return x, by_d

    def _on_bound_or_inside(self, d: Tensor, identity: Tensor) -> tuple[Tensor, Tensor]:
        starts = self._starts(d)
        count = starts.shape[1]
        wanted = d[:, None].expand(-1, count, 3).flatten(0, 1)
        found = self._descended(wanted, starts.flatten(0, 1)).reshape(-1, count, 3)
        best = (found - d[:, None]).square().sum(dim=2).argmin(dim=1)
        x = self._polished(d, found.gather(1, best[:, None, None].expand(-1, 1, 3))[:, 0])
        A, _, at = self._conditions(d, x)
        inward = applied(inverse(A), at.gradient)
        across = inward[:, :, None] * inward[:, None] / (at.gradient * inward).sum(dim=1)[:, None, None]
        inside = self.margin(d) >= 0
        x = torch.where(inside[:, None], d, x)
        return x, torch.where(inside[:, None, None], identity, inverse(A) - across)

    def _starts(self, d: Tensor) -> Tensor:
        """Return candidates (n, v, 3) [mm] at local minima of the distance to d (n, 3), as in `JawRig.project`."""
        if not capturing() and len(d) > _ROWS:
            return torch.cat([self._starts(rows) for rows in d.split(_ROWS)])
        squared = self.scan.square().sum(dim=2).flatten()
        distance = (squared - 2.0 * d @ self.scan.flatten(0, 1).T).reshape(-1, *self.scan.shape[:2])
        least, place = distance.min(dim=2)
        before = torch.nn.functional.pad(least[:, :-1], (1, 0), value=torch.inf)
        after = torch.nn.functional.pad(least[:, 1:], (0, 1), value=torch.inf)
        depth = torch.where((least <= before) & (least <= after), least, torch.full_like(least, torch.inf))
        slices = torch.topk(depth, _VALLEYS, dim=1, largest=False).indices
        return self.scan[slices, place.gather(1, slices)]

    def _descended(self, wanted: Tensor, start: Tensor) -> Tensor:
        """Return the nearest valid points (n, 3) [mm] in the basins of valid starts.

        As in `jawusd.evaluator.solver`, every iterate is inside: the step of the quadratic model under the linearised
        bound is moved back onto the surface, and accepted only if the distance does not grow.
        """
        x, cost = start, (start - wanted).square().sum(dim=1)
        state = [wanted, x, cost, torch.full_like(cost, _START_DAMPING), torch.zeros_like(cost)]
        if capturing():
            for _ in range(_STEPS_CAPTURED):
                state, _ = self._stepped(*state)
            return state[1]
        found, rows = start.clone(), torch.arange(start.shape[0], device=start.device)
        for _ in range(limits.ITERATIONS):
            state, moving = self._stepped(*state)
            found[rows] = state[1]
            rows, state = rows[moving], [values[moving] for values in state]
            if not rows.numel():
                break
        return found

    def _stepped(
        self, wanted: Tensor, x: Tensor, cost: Tensor, damping: Tensor, multiplier: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Return the state of the searches after one step, and which of them (n,) were still moving."""
        tolerance_mm = limits.TOLERANCE_MM if wanted.dtype == torch.float64 else 1e-4
        identity = torch.eye(3, dtype=x.dtype, device=x.device)
        at = self.expansion(x)
        A = identity * (1.0 + damping)[:, None, None] + multiplier[:, None, None] * at.rounding
        to_bottom = inverse(A)
        step, inward = applied(to_bottom, wanted - x), applied(to_bottom, at.gradient)
        over = at.distance + (at.gradient * step).sum(dim=1)
        multiplier = over.clamp(min=0.0) / (at.gradient * inward).sum(dim=1).clamp(min=limits.MIN_SLOPE)
        step = step - multiplier[:, None] * inward
        length = step.square().sum(dim=1, keepdim=True).sqrt().clamp(min=1e-30)
        moving = (length[:, 0] > tolerance_mm) & (damping < limits.MAX_DAMPING)
        trial = self._pulled_inside(x + step * (limits.MAX_STEP_MM / length).clamp(max=1.0))
        nearer = (trial - wanted).square().sum(dim=1)
        taken = (nearer <= cost) & (self.margin(trial) >= 0)
        x, cost = torch.where(taken[:, None], trial, x), torch.where(taken, nearer, cost)
        damping = torch.where(taken, (damping * 0.1).clamp(min=limits.MIN_DAMPING), damping * 10.0)
        return [wanted, x, cost, damping, multiplier], moving

    def _polished(self, wanted: Tensor, x: Tensor) -> Tensor:
        """Return the nearest points (n, 3) [mm], refined to rounding by Newton on the optimality conditions."""
        for _ in range(_POLISHING):
            A, multiplier, at = self._conditions(wanted, x)
            free = applied(inverse(A), wanted - x - multiplier[:, None] * at.gradient)
            inward = applied(inverse(A), at.gradient)
            press = (at.distance + (at.gradient * free).sum(dim=1)) / (at.gradient * inward).sum(dim=1)
            change = free - press[:, None] * inward
            x = torch.where((change.abs() < _POLISH_MM).all(dim=1, keepdim=True), x + change, x)
        return self._pulled_inside(x)

    def _conditions(self, wanted: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Expansion]:
        """Return the Jacobian (n, 3, 3) of ``x - wanted + multiplier gradient``, the multiplier and the hull at x."""
        at = self.expansion(x)
        squared = at.gradient.square().sum(dim=1).clamp(min=limits.MIN_SLOPE)
        multiplier = ((wanted - x) * at.gradient).sum(dim=1) / squared
        identity = torch.eye(3, dtype=x.dtype, device=x.device)
        return identity + multiplier[:, None, None] * (at.rounding + at.bending), multiplier, at

    def _pulled_inside(self, x: Tensor) -> Tensor:
        # deep enough that rounding of the margin cannot put the point outside again
        depth_mm = limits.INSIDE_MM if x.dtype == torch.float64 else 1e-5
        for _ in range(_PULLS_CAPTURED if capturing() else limits.PULL_BACKS):
            distance, gradient = self.slope(x)
            out = distance + 0.5 * depth_mm
            if finished(out > 0):
                break
            squared = gradient.square().sum(dim=1).clamp(min=limits.MIN_SLOPE)
            amount = limits.PULL * distance.clamp(min=0.0) + depth_mm
            pull = torch.where(out > 0, amount, torch.zeros_like(out)) / squared
            x = x - pull[:, None] * gradient
        return x


def _by_slices(points: Array) -> Array:
    """Return points (p, 3), sorted by d1, as slices (s, q, 3) of equal d1, padded with their last point."""
    slices = np.split(points, np.flatnonzero(np.diff(points[:, 0])) + 1)
    longest = max(map(len, slices))
    return np.stack([each[np.minimum(np.arange(longest), len(each) - 1)] for each in slices])
