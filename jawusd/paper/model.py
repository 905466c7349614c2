"""The model of Yang et al. (2019): hierarchical NLPCA with five components, reduced to a sum of three curves.

Phi_gen is the decoder of a network trained on the twists. Phi1 is Phi_gen restricted to the first component. For two
groups of components, the points that Phi_gen generates (D23, D45) are each reduced to one dimension by another network,
Phi2 and Phi3; and

    Phi(d) = Phi1(d1) + Phi2(d2) + Phi3(d3)                                                       (paper eq. 5)

Taken literally, the sum contains Phi_gen(0) three times; here, it is contained once. What a component represents varies
between trainings, so components are grouped by the motion of the incisal point unless the paper's fixed groups are
requested. Twists are in mandible-metric coordinates, which makes the result independent of units and origin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FittingError
from jawusd.evaluator.curves import HermiteCurve
from jawusd.evaluator.models import AdditiveModel
from jawusd.fitting import fit
from jawusd.fitting.additive import MEASURED, Curve, in_millimetres
from jawusd.fitting.data import FittedForm, TrainingData
from jawusd.fitting.fit import FormFitter, pose_errors
from jawusd.formats.model import error_table
from jawusd.geometry import se3_exp, se3_log

if TYPE_CHECKING:
    from jawusd.paper.nlpca import Nlpca  # imported only for type checkers, since it imports torch

Groups = tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]

COMPONENTS = 5
_LITERAL_GROUPS: Groups = ((0,), (1, 2), (3, 4))
_SWEEP_PERCENT = (2.0, 98.0)
_REST_STEPS, _REST_HALVINGS = 50, 10
_ALL_STAGES, _SEARCH_STAGES = 7, 4  # number of training stages of the one-dimensional networks


@dataclass(frozen=True)
class _Part:
    """One summand of the model: the components of a group, reduced to one dimension if there are several."""

    group: tuple[int, ...]
    reduced: Nlpca | None

    def encode(self, net: Nlpca, components: Array) -> Array:
        """Return the parameter t (N,) of components (N, k)."""
        if self.reduced is None:
            return components[:, self.group[0]]
        return self.reduced.encode(net.decode(_only(components, self.group)))[:, 0]

    def value(self, net: Nlpca, t: Array) -> tuple[Array, Array]:
        """Return metric coordinates (N, 6) and their derivative with respect to t (N,)."""
        if self.reduced is not None:
            return self.reduced.decode(t[:, None]), self.reduced.decode_rate(t[:, None], np.ones(1))
        direction = np.zeros(net.components)
        direction[self.group[0]] = 1.0
        return net.decode(t[:, None] * direction), net.decode_rate(t[:, None] * direction, direction)


@dataclass(frozen=True)
class _Sum:
    """The sum of three parts in metric coordinates; it contains Phi_gen(0) once."""

    net: Nlpca
    parts: tuple[_Part, _Part, _Part]
    seed: int

    def encode(self, points: Array) -> Array:
        """Return the parameters (N, 3) of metric coordinates (N, 6), encoded by the networks as published."""
        components = self.net.encode(points)
        return np.stack([part.encode(self.net, components) for part in self.parts], axis=1)

    def value(self, t: Array) -> Array:
        """Return metric coordinates (N, 6) for parameters (N, 3)."""
        once = self.net.decode(np.zeros((1, self.net.components)))
        first, second, third = (part.value(self.net, t[:, i])[0] for i, part in enumerate(self.parts))
        return first + second + third - 2 * once

    def rest(self, starts: Array) -> Array:
        """Return the parameters (3,) nearest to the closed bite, by damped Gauss-Newton from the best start (N, 3)."""
        t = starts[[np.argmin(np.linalg.norm(self.value(starts), axis=1))]]
        for _ in range(_REST_STEPS):
            J = np.stack([part.value(self.net, t[:, i])[1][0] for i, part in enumerate(self.parts)], axis=1)
            step = np.linalg.lstsq(J, -self.value(t)[0], rcond=None)[0]
            shorter = t + step * 0.5 ** np.arange(_REST_HALVINGS)[:, None]
            tried = np.concatenate([t, shorter])
            t = tried[[np.argmin(np.linalg.norm(self.value(tried), axis=1))]]
        return t[0]


@dataclass(frozen=True, eq=False)
class PaperFit(FittedForm):
    """A fitted model of the paper, with its networks; its fit trims no frames."""

    network_sum: _Sum
    root: Array  # matrix L (6, 6) that defines the metric coordinates log(M) @ L

    def reconstruct_as_published(self, motion: Array) -> Array:
        """Return motions (N, 4, 4) after encoding and decoding by the networks, without projection and rest offset."""
        return _rebuilt(self.network_sum, motion, self.root)


def fit_paper(
    data: TrainingData, shown: Mask, literal: bool, starts: int, seed: int, nets: dict[int, Nlpca] | None = None
) -> PaperFit:
    """Fit the paper's model.

    Args:
        shown: parameters that the data excite, shape (3,).
        literal: whether to keep the paper's groups (1), (2, 3), (4, 5), whichever motion the components describe.
        starts: number of random initialisations; the sum with the smallest training error is kept.
        nets: cache of trained networks with five components, by seed, updated in place.

    Raises:
        FittingError: the data do not excite a parameter, or no component moves the incisal point in its direction.
    """
    from jawusd.paper.nlpca import train_nlpca  # imported late, since importing torch takes two seconds

    if not shown.all():
        raise FittingError(
            "the paper's model needs opening, lateral and protrusive movements in the data.",
            hint="Use the model 'anchored', which fits what the data show.",
        )
    root = data.metric.twist_root()
    points = se3_log(data.motion) @ root
    nets = {} if nets is None else nets
    for start in range(starts):
        if seed + start not in nets:
            nets[seed + start] = train_nlpca(points, COMPONENTS, seed + start)
    sums = [_network_sum(data, points, root, literal, seed + start, nets[seed + start]) for start in range(starts)]

    def error(found: _Sum) -> float:
        return float(data.metric.largest(_rebuilt(found, data.motion, root), data.motion).mean())

    best = min(sums, key=error)
    if not literal:
        best = _with_leftovers(best, points, error)
    model, notes = _curves(best, points, root, data)
    notes |= {"groups": [list(part.group) for part in best.parts], "seed": best.seed, "components": COMPONENTS}
    notes["train_errors_as_published"] = error_table(pose_errors(data, _rebuilt(best, data.motion, root)))
    return PaperFit(model, np.ones(len(data), dtype=bool), notes, best, root)


#: Fitters by method, including the paper's.
FORMS: Mapping[str, FormFitter] = {
    **fit.FORMS,
    "paper": lambda data, shown, config: fit_paper(data, shown, config.literal, config.starts, config.seed),
}


def _network_sum(data: TrainingData, points: Array, root: Array, literal: bool, seed: int, net: Nlpca) -> _Sum:
    groups = _LITERAL_GROUPS if literal else _groups_by_incisal_motion(net, points, root, data.incisor)
    components = net.encode(points)
    first, second, third = (_part(net, components, group, seed, _ALL_STAGES) for group in groups)
    return _Sum(net, (first, second, third), seed)


def _part(net: Nlpca, components: Array, group: tuple[int, ...], seed: int, stages: int) -> _Part:
    from jawusd.paper.nlpca import train_nlpca

    if len(group) == 1:
        return _Part(group, None)
    return _Part(group, train_nlpca(net.decode(_only(components, group)), 1, seed, centre=True, stages=stages))


def _groups_by_incisal_motion(net: Nlpca, points: Array, root: Array, incisor: Array) -> Groups:
    """Return the components that, swept alone, open, shift and protrude the jaw most; they are chosen in this order."""
    components = net.encode(points)
    reach = np.zeros((net.components, 3))
    for index in range(net.components):
        ends = np.zeros((2, net.components))
        ends[:, index] = np.percentile(components[:, index], _SWEEP_PERCENT)
        M = _motions(net.decode(ends), root)
        at = M[:, :3, :3] @ incisor + M[:, :3, 3]
        reach[index] = np.abs(MEASURED @ (at[1] - at[0]))
    chosen: list[int] = []
    for axis in range(3):
        free = [index for index in range(net.components) if index not in chosen]
        chosen.append(max(free, key=lambda index: reach[index, axis]))
    return (chosen[0],), (chosen[1],), (chosen[2],)


def _with_leftovers(base: _Sum, points: Array, error: Callable[[_Sum], float]) -> _Sum:
    """Return the best model over all assignments of each remaining component to one of the three groups or to none."""
    used = {part.group[0] for part in base.parts}
    left = [index for index in range(base.net.components) if index not in used]
    components = base.net.encode(points)
    parts: dict[tuple[int, ...], _Part] = {}
    candidates = [base]
    for places in product((0, 1, 2), repeat=len(left)):
        extra = [tuple(i for i, place in zip(left, places, strict=True) if place == axis) for axis in range(3)]
        groups = [base.parts[axis].group + (extra[axis] if axis else ()) for axis in range(3)]
        for group in groups:
            if group not in parts:
                parts[group] = _part(base.net, components, group, base.seed, _SEARCH_STAGES)
        first, second, third = (parts[group] for group in groups)
        candidates.append(_Sum(base.net, (first, second, third), base.seed))
    return min(candidates, key=error)


def _curves(found: _Sum, points: Array, root: Array, data: TrainingData) -> tuple[AdditiveModel, dict[str, object]]:
    """Shift an additive model's rest pose to the closed bite and reparametrise its curves in mm; also return notes."""
    encoded = found.encode(points)
    rest = found.rest(encoded)
    reached = encoded - rest
    curves: list[HermiteCurve] = []
    steady = []
    for axis, part in enumerate(found.parts):
        limits = min(float(reached[:, axis].min()), -1e-3), max(float(reached[:, axis].max()), 1e-3)
        curve, forward = in_millimetres(_shifted(part, found.net, rest[axis], root), limits, root, data.incisor, axis)
        curves.append(curve)
        steady.append(float(forward.mean()))
    d_range = np.array([[curve.knots[0], curve.knots[-1]] for curve in curves])
    model = AdditiveModel((curves[0], curves[1], curves[2]), data.incisor, d_range)
    return model, {"rest_offset_mm": float(np.linalg.norm(found.value(rest[None]))), "steady_share": steady}


def _shifted(part: _Part, net: Nlpca, rest: float, root: Array) -> Curve:
    """Return the part as a curve of twists that is zero at t = 0, the closed bite."""

    def curve(t: Array) -> tuple[Array, Array]:
        value, rate = part.value(net, t + rest)
        value = value - part.value(net, np.array([rest]))[0]
        return _twists(value, root), _twists(rate, root)

    return curve


def _rebuilt(found: _Sum, motion: Array, root: Array) -> Array:
    """Return motions (N, 4, 4) after encoding and decoding by a sum of parts."""
    return _motions(found.value(found.encode(se3_log(motion) @ root)), root)


def _motions(points: Array, root: Array) -> Array:
    return se3_exp(_twists(points, root))


def _twists(points: Array, root: Array) -> Array:
    return np.asarray(np.linalg.solve(root.T, points.T).T, dtype=np.float64)


def _only(components: Array, group: tuple[int, ...]) -> Array:
    """Return a copy of the components in which those outside a group are zero."""
    kept = np.zeros_like(components)
    kept[:, group] = components[:, group]
    return kept
