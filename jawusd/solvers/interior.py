"""A smooth bijection from unconstrained vectors onto the valid volume."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import EvaluatorError
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.curves import HermiteCurve, flat_ended
from jawusd.evaluator.formula import curve_derivatives, curve_tables
from jawusd.solvers.hull import Hull
from jawusd.solvers.motion import OPERATIONS, Formula
from jawusd.solvers.solution import capturing, finished

_STEPS, _STEPS_CAPTURED = 60, 12
_SOFTNESS_MM = 1.0  # rounding of the sections whose centres are sought; keeps the centre line straight
_CHECKED = 400  # number of openings at which the centre line is checked
_NEWTON_STEPS, _SMALLEST_SHARE, _STIFFNESS = 200, 1e-9, 1e-12
_END_TOLERANCE_MM = 1e-13


class Interior(Formula):
    """A map from vectors z (n, 3) onto the interior of a hull.

    ``d1`` is a sigmoid of z1 onto the valid openings. With m the margin and c(d1) a centre line inside the volume,
    ``(d2, d3) = c + (z2, z3) m(d1, d2, d3)``: sections are convex and m is concave in them, so along every ray from c
    the ratio ``|(d2, d3) - c| / m`` increases from 0 to infinity, and there is exactly one solution for each z.

    Raises:
        EvaluatorError: no line from the smallest to the largest opening lies inside.
    """

    def __init__(self, arrays: Mapping[str, Array]) -> None:
        bound = SliceHull(arrays)
        knots, middles = bound.supports.knots, _middles(bound)
        line = flat_ended(knots, middles)
        tables = curve_tables("middle", knots.tolist(), middles.tolist(), line.slopes.tolist())
        super().__init__(tables, _ends(bound, line))

    def mapped(self, hull: Hull, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return d (n, 3) [mm] of z (n, 3), and its derivative (n, 3, 3)."""
        low, high = self.singles.unbind()
        root = torch.sqrt(1.0 + z[:, :1].square())
        on_line, slope = self._on_line(0.5 * (low + high) + 0.5 * (high - low) * z[:, :1] / root)
        side = torch.cat([torch.zeros_like(root), z[:, 1:]], dim=1)
        # Newton from above: mu - m(c + z mu) is convex in mu, so it descends to the root without overshooting
        mu = hull.upper_margin(on_line)[:, None]
        tolerance_mm = 500 * torch.finfo(z.dtype).eps
        for _ in range(_STEPS_CAPTURED if capturing() else _STEPS):
            at = hull.expansion(on_line + side * mu)
            change = (mu[:, 0] + at.distance) / (1.0 + (at.gradient * side).sum(dim=1))
            mu = mu - change[:, None]
            if finished(change.abs() > tolerance_mm):
                break
        d = on_line + side * mu
        at = hull.expansion(d)
        inward = -at.gradient
        # implicit function theorem on x = c(d1) + z m(d1, x)
        by_d1 = slope + side * inward[:, :1]
        sideways = mu[..., None] * torch.eye(3, dtype=z.dtype, device=z.device)[:, 1:]
        direct = torch.cat([by_d1[:, :, None] * (0.5 * (high - low) / root**3)[..., None], sideways], dim=2)
        across = torch.cat([torch.zeros_like(root), inward[:, 1:]], dim=1)
        lead = (across[:, None] @ direct) / (1.0 - (across * side).sum(dim=1))[:, None, None]
        return d, direct + side[:, :, None] * lead

    def unconstrained(self, hull: Hull, d: Tensor) -> Tensor:
        """Return the z (n, 3) of d (n, 3) [mm] inside the hull; NaN outside."""
        low, high = self.singles.unbind()
        share = (2.0 * d[:, :1] - low - high) / (high - low)
        z1 = share / torch.sqrt(1.0 - share.square())
        margin = hull.margin(d)[:, None]
        z = torch.cat([z1, (d - self._on_line(d[:, :1])[0])[:, 1:] / margin], dim=1)
        return torch.where(margin > 0, z, torch.nan)

    def _on_line(self, d1: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points (n, 3) [mm] of the centre line at d1 (n, 1), and their derivatives."""
        (at,), (slope,), _ = curve_derivatives("middle", d1, self.tables(), OPERATIONS)
        return torch.cat([d1, at], dim=1), torch.cat([torch.ones_like(d1), slope], dim=1)


def _middles(bound: SliceHull) -> Array:
    """Return a point (2,) [mm] inside the section at each of k knots; at the first and last knot, the deepest one.

    Beyond these two knots, sections shrink towards the deepest point, by the rounding of the ends alone.
    """
    reach = bound.supports.values
    found = np.zeros((len(reach), 2))
    for i, h in enumerate(reach):
        own = max(_SOFTNESS_MM, bound.softness_mm)
        while True:
            found[i] = _deepest(bound.directions, h, own, found[i])
            if i not in (0, len(reach) - 1) or own == bound.softness_mm:
                break
            own = max(0.5 * own, bound.softness_mm)
    return found


def _deepest(normals: Array, reach: Array, softness_mm: float, y: Array) -> Array:
    """Return the minimiser of the soft maximum of ``normals @ y - reach``, by damped Newton from y (2,) [mm]."""

    def value(y: Array) -> tuple[float, Array]:
        v = (normals @ y - reach) / softness_mm
        weights = np.exp(v - v.max())
        return float(softness_mm * (v.max() + np.log(weights.sum()))), weights / weights.sum()

    least, weights = value(y)
    for _ in range(_NEWTON_STEPS):
        gradient = weights @ normals
        away = normals - gradient
        H = away.T @ (away * weights[:, None]) / softness_mm + _STIFFNESS * np.eye(2)
        step = -np.linalg.solve(H, gradient)
        share = min(1.0, 1.0 / max(float(np.linalg.norm(step)), 1e-300))
        while share > _SMALLEST_SHARE:
            trial, found = value(y + share * step)
            if trial < least:
                break
            share *= 0.5
        else:
            break
        y, least, weights = y + share * step, trial, found
    return y


def _ends(bound: SliceHull, line: HermiteCurve) -> tuple[float, float]:
    """Return the openings [mm] between which the centre line lies inside the bound."""

    def inside(d1: Array) -> Mask:
        return bound.signed_distance(np.column_stack([d1, line.value(d1)])) < 0

    beyond = abs(bound.offset_mm) + bound.softness_mm
    d1 = np.linspace(line.knots[0] - beyond, line.knots[-1] + beyond, _CHECKED)
    valid = np.flatnonzero(inside(d1))
    if not len(valid) or np.diff(valid).max(initial=1) > 1:
        raise EvaluatorError(
            "the bound of this rig is not connected from the smallest to the largest opening.",
            hint="Fit the model again with a wider margin.",
        )
    ends = []
    for within, outside in ((d1[valid[0]], d1[valid[0] - 1]), (d1[valid[-1]], d1[valid[-1] + 1])):
        while abs(within - outside) > _END_TOLERANCE_MM:
            middle = 0.5 * (within + outside)
            within, outside = (middle, outside) if inside(np.array([middle]))[0] else (within, middle)
        ends.append(float(within))
    return ends[0], ends[1]
