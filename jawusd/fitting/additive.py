"""Models that are a sum of three curves in se(3), each parametrised by millimetres at the lower incisal point.

The additive model is log M = Phi1(d1) + Phi2(d2) + Phi3(d3), fitted jointly to the captured poses. The twist is taken
about the incisal point p, (omega, s = omega x p + v). In each curve, one component of s is the parameter t itself (-s_y
in Phi1, s_x in Phi2, s_z in Phi3), which makes the sum unique. All other components are smoothing splines; their joint
least-squares fit alternates with the projection of the poses onto the sum.

The linear baseline, a PCA of the twists under the mandible metric, is the same sum with straight lines as curves.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import BSpline

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FittingError
from jawusd.evaluator.curves import HermiteCurve
from jawusd.evaluator.models import AdditiveModel
from jawusd.fitting.data import PARAMETERS, FittedForm, TrainingData
from jawusd.fitting.gauge_fit import fit_gauge, fit_path
from jawusd.fitting.metric import velocity_of
from jawusd.fitting.spline import choose_smoothing, folds_of, ridge_solve, within
from jawusd.geometry import se3_exp, se3_left_jacobian, se3_log

#: Map from a parameter t (n,) to twists (n, 6) and their derivatives with respect to t (n, 6); zero twist at t = 0.
Curve = Callable[[Array], tuple[Array, Array]]

KNOTS = 97
#: Directions along which the incisal displacement is measured as opening, laterotrusion and protrusion.
MEASURED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

# Fraction of the mandible's rms speed below which the incisal point counts as standing still or reversing.
_SLOWEST = 0.2
_SHORTEST_MM = 0.01  # minimum motion of the incisal point along a curve [mm]; less motion indicates a collapsed network

_PIECES = (8, 6, 6)  # number of polynomial pieces of each of the three curves
_ROUNDS = 8
_SMOOTHING = 10.0 ** np.arange(-4.0, 5.0)
_TAIL_RIDGE = 1e-4  # penalty that keeps coefficients finite in intervals without frames
_HIDDEN_RIDGE = 1e9  # penalty that keeps coefficients at zero for parameters that the data do not excite
_TRIM_FLOOR_MM = 0.8  # maximum residual that counts as model error and not as a tracking failure [mm]
_LARGEST_CONDITION = 1e3


def in_millimetres(
    curve: Curve, limits: tuple[float, float], root: Array, incisor: Array, axis: int
) -> tuple[HermiteCurve, Mask]:
    """Reparametrise a curve by d, the displacement of the incisal point along the curve's own axis [mm].

    Where the incisal point stands still or reverses, d increases by a fifth of the mandible's rms displacement instead,
    so that every point on the curve has a parameter. The curve over d, zero at d = 0, is returned with a mask of the
    knots at which the incisal point advances steadily.

    Args:
        limits: range of t in the data, containing 0.
        root: L with |L^T xi| = rms displacement of the mandible under a small twist xi [mm], shape (6, 6).
        incisor: incisal point at rest [mm], shape (3,).
        axis: 0 opening, 1 laterotrusion, 2 protrusion.

    Raises:
        FittingError: the curve does not move at all.
    """
    t = np.unique(np.append(np.linspace(*limits, KNOTS), 0.0))
    twist, rate = curve(t)
    advance, speed = _incisal_advance(twist, rate, incisor, MEASURED[axis])
    zero = int(np.searchsorted(t, 0.0))
    sense = 1.0 if advance[-1] >= advance[0] else -1.0
    slowest = _SLOWEST * np.linalg.norm(rate @ root, axis=1)
    steady = sense * speed > slowest
    pace = np.where(steady, sense * speed, np.maximum(slowest, 1e-9))
    walked = 0.5 * (pace[1:] + pace[:-1]) * np.diff(t)
    step = np.where(steady[1:] & steady[:-1], sense * np.diff(advance), walked)
    d = np.concatenate([[0.0], np.cumsum(step)])
    d = sense * (d - d[zero])
    if np.ptp(d) < _SHORTEST_MM:
        raise FittingError(
            f"the learned {PARAMETERS[axis]} curve moves the incisal point by {np.ptp(d):.2g} mm over its range; at "
            f"least {_SHORTEST_MM:g} mm are needed.",
            hint="The networks collapsed in training. Try another seed, more starts, or the model 'anchored'.",
        )
    order = np.argsort(d)
    slopes = sense * rate / pace[:, None]
    return HermiteCurve(d[order], twist[order], slopes[order]), steady[order]


def straight(direction: Array, knots: Array) -> HermiteCurve:
    """Return the straight line d -> d * direction between two knots (2,) [mm]; the direction is a twist per mm (6,)."""
    return HermiteCurve(knots, knots[:, None] * direction, np.stack([direction, direction]))


def translation(axis: int) -> Array:
    """Return the twist per mm (6,) of a pure translation along the axis of a parameter."""
    return np.concatenate([np.zeros(3), MEASURED[axis]])


def _incisal_advance(twist: Array, rate: Array, incisor: Array, direction: Array) -> tuple[Array, Array]:
    """Return the incisal displacement (n,) along a direction [mm], and its derivative with respect to t."""
    M = se3_exp(twist)
    point = M[:, :3, :3] @ incisor + M[:, :3, 3]
    spatial = np.einsum("nij,nj->ni", se3_left_jacobian(twist), rate)
    velocity = np.cross(spatial[:, :3], point) + spatial[:, 3:]
    return (point - incisor) @ direction, velocity @ direction


class _Basis:
    """B-spline regression columns of one parameter, with bending energy; zero at zero and extrapolated linearly."""

    def __init__(self, values: Array, pieces: int) -> None:
        low, high = min(float(values.min()), -1.0), max(float(values.max()), 1.0)
        self.limits = (low, high)
        knots = np.concatenate([[low] * 3, np.linspace(low, high, pieces + 1), [high] * 3])
        self._splines = BSpline(knots, np.eye(pieces + 3), 3)
        sites = np.linspace(low, high, 20 * pieces)
        bend = self._splines(sites, nu=2) * (high - low) ** 1.5  # makes the energy independent of the range of t
        self.energy = bend.T @ bend * (sites[1] - sites[0])

    def columns(self, t: Array) -> Array:
        """Return the columns at t (n,), shape (n, pieces + 3)."""
        inside = np.clip(t, *self.limits)
        return self._splines(inside) + self.slopes(t) * (t - inside)[:, None] - self._splines(np.zeros(1))

    def slopes(self, t: Array) -> Array:
        """Return the derivatives of the columns at t (n,)."""
        return self._splines(np.clip(t, *self.limits), nu=1)


def fit_additive(data: TrainingData, shown: Mask, trim_mad: float) -> FittedForm:
    """Fit the sum of three curves; those of parameters not shown (3,) by the data are pure translations."""
    u = data.displacement()
    t = fit_gauge(u, data.weights, fit_path(u, data.weights), shown).gauge.inverse(u)
    kept = np.all(np.isfinite(t), axis=1)
    for _ in range(_ROUNDS):
        fitted = kept
        model, smoothing = _regress(data, t, fitted, shown)
        d, nearest = data.metric.nearest(model, data.motion)
        t = np.stack([_own(curve, d[:, i], data.incisor, i) for i, curve in enumerate(model.curves)], axis=1)
        kept = within(data.metric.rms(nearest, data.motion), trim_mad, _TRIM_FLOOR_MM)
    return FittedForm(model, fitted, {"smoothing": smoothing})


def _own(curve: HermiteCurve, d: Array, incisor: Array, axis: int) -> Array:
    """Return the parameter t of a curve, which is one of its twist components, at d (n,)."""
    twist = curve.value(d)
    return (np.cross(twist[:, :3], incisor) + twist[:, 3:]) @ MEASURED[axis]


def _regress(data: TrainingData, t: Array, kept: Mask, shown: Mask) -> tuple[AdditiveModel, float]:
    """Fit the curves while the parameters of the frames are fixed at t (N, 3)."""
    twists = se3_log(data.motion[kept])
    t, weights = t[kept], data.weights[kept]
    bases = [_Basis(t[:, i], _PIECES[i]) for i in range(3)]
    columns = [basis.columns(t[:, i]) for i, basis in enumerate(bases)]
    root = data.metric.twist_root()
    # The residuals are in mm: rotations are scaled by the displacement of the mandible, translations are unchanged.
    L = np.linalg.cholesky(data.metric.about(data.incisor))
    turning = twists[:, :3] @ L
    gliding = (np.cross(twists[:, :3], data.incisor) + twists[:, 3:]) @ MEASURED.T - t
    folds = folds_of(len(data))[kept]
    every, energy, tail = _assembled(columns, bases, shown, (0, 1, 2))
    smoothing = choose_smoothing(every, turning, weights, energy, tail, _SMOOTHING, folds)
    turn = _solve(every, turning, weights, smoothing * energy + tail, columns)
    turn = [np.linalg.solve(L.T, part.T).T for part in turn]
    glide = [np.zeros((columns[i].shape[1], 3)) for i in range(3)]
    for axis in range(3):
        others = tuple(i for i in range(3) if i != axis)
        matrix, energy, tail = _assembled(columns, bases, shown, others)
        parts = _solve(matrix, gliding[:, [axis]], weights, smoothing * energy + tail, [columns[i] for i in others])
        for i, part in zip(others, parts, strict=True):
            glide[i] += part * MEASURED[axis]
    curves = []
    for i, basis in enumerate(bases):
        curve = _curve(basis, turn[i], glide[i], data.incisor, i)
        curves.append(in_millimetres(curve, basis.limits, root, data.incisor, i)[0])
    d_range = np.array([[curve.knots[0], curve.knots[-1]] for curve in curves])
    return AdditiveModel((curves[0], curves[1], curves[2]), data.incisor, d_range), smoothing


def _assembled(
    columns: list[Array], bases: list[_Basis], shown: Mask, which: tuple[int, ...]
) -> tuple[Array, Array, Array]:
    """Return the stacked columns of given parameters, their bending energy, and the constant part of the penalty."""
    sizes = [columns[i].shape[1] for i in which]
    energy = np.zeros((sum(sizes), sum(sizes)))
    tail = np.zeros_like(energy)
    start = 0
    for i, size in zip(which, sizes, strict=True):
        block = slice(start, start + size)
        energy[block, block] = bases[i].energy
        tail[block, block] = np.eye(size) * (_TAIL_RIDGE if shown[i] else _HIDDEN_RIDGE)
        start += size
    return np.concatenate([columns[i] for i in which], axis=1), energy, tail


def _solve(matrix: Array, values: Array, weights: Array, penalty: Array, columns: list[Array]) -> list[Array]:
    """Return the coefficients of each parameter's columns."""
    weighted = matrix * weights[:, None]
    solution = ridge_solve(weighted.T @ matrix, weighted.T @ values, penalty)
    return np.split(solution, np.cumsum([part.shape[1] for part in columns])[:-1])


def _curve(basis: _Basis, turn: Array, glide: Array, incisor: Array, axis: int) -> Curve:
    """Return one curve, t -> (twist, derivative), from the coefficients of omega and s."""

    def curve(t: Array) -> tuple[Array, Array]:
        def twist(columns: Array, own: Array) -> Array:
            omega = columns @ turn
            s = columns @ glide + own[:, None] * MEASURED[axis]
            return np.concatenate([omega, s - np.cross(omega, incisor)], axis=1)

        return twist(basis.columns(t), t), twist(basis.slopes(t), np.ones_like(t))

    return curve


def fit_pca(data: TrainingData, shown: Mask) -> FittedForm:
    """Fit a linear subspace of se(3) through the closed bite to all frames.

    The subspace is spanned by the first principal components of log M, one per parameter shown (3,) by the data; other
    parameters are pure translations. The basis follows from the incisal velocity: to first order, d2 and d3 move the
    incisal point purely sideways and forward, and d1 along the mean opening direction of the take.

    Raises:
        FittingError: the components do not move the incisal point in independent directions.
    """
    L = data.metric.twist_root()
    twists = se3_log(data.motion)
    weights = data.weights / data.weights.sum()
    _, singular, Vt = np.linalg.svd((twists @ L) * np.sqrt(weights)[:, None], full_matrices=False)
    basis = np.linalg.solve(L.T, Vt[: int(shown.sum())].T)
    directions = _semantic_directions(basis, twists, weights, data.incisor, shown)
    reach = np.linalg.lstsq(directions, twists.T, rcond=None)[0]
    limits = np.stack([np.minimum(reach.min(1), -1.0), np.maximum(reach.max(1), 1.0)], axis=1)
    d1, d2, d3 = (straight(directions[:, i], limits[i]) for i in range(3))
    model = AdditiveModel((d1, d2, d3), data.incisor, limits)
    return FittedForm(model, np.ones(len(data), dtype=bool), {"singular_values_mm": singular.tolist()})


def _semantic_directions(basis: Array, twists: Array, weights: Array, incisor: Array, shown: Mask) -> Array:
    """Return the twists per mm of d1, d2, d3 as columns, shape (6, 3)."""
    measure = MEASURED[shown] @ velocity_of(incisor)
    to_mm = measure @ basis
    if np.linalg.cond(to_mm) > _LARGEST_CONDITION:
        raise FittingError(
            "the principal components do not move the incisal point in independent directions.",
            hint="Check the units and the anatomical frame of the poses, or use the model 'anchored'.",
        )
    directions = np.stack([translation(axis) for axis in range(3)], axis=1)
    directions[:, shown] = basis @ np.linalg.inv(to_mm)
    if shown[0]:
        # Direction of d1, along the habitual path: the mean motion per millimetre of opening over the take.
        d = to_mm @ np.linalg.lstsq(basis, twists.T, rcond=None)[0]
        habit = (d * weights) @ d[0] / ((weights * d[0]) @ d[0])
        directions[:, 0] = directions[:, shown] @ habit
    return directions
