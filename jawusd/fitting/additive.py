"""The best sum of three curves: log M = Phi1(d1) + Phi2(d2) + Phi3(d3), fitted jointly to the captured poses.

The twist is taken about the incisal point p, (omega, s = omega x p + v), and one component of s of each curve is its
parameter t itself (-s_y of Phi1, s_x of Phi2, s_z of Phi3), which makes the sum unique. All other components are
smoothing splines, solved for together by least squares while the poses are projected onto the sum.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator.curves import HermiteCurve
from jawusd.evaluator.models import AdditiveModel
from jawusd.fitting.curves import MEASURED, Curve, in_millimetres
from jawusd.fitting.data import TrainingData
from jawusd.fitting.form import FittedForm
from jawusd.fitting.gauge_fit import fit_gauge, fit_path
from jawusd.fitting.spline import choose_smoothing, ridge_solve, within
from jawusd.geometry import se3_log

_PIECES = (8, 6, 6)  # polynomial pieces of the three curves
_ROUNDS = 8
_SMOOTHING = 10.0 ** np.arange(-4.0, 5.0)
_TAIL_RIDGE = 1e-4  # keeps the coefficients finite where there are no frames
_HIDDEN_RIDGE = 1e9  # and at zero in directions the data do not show
_TRIM_FLOOR_MM = 0.8  # a sum of curves misses whole exercises by more than tracking noise
_CV_BLOCK, _CV_FOLDS, _CV_CAP_MM = 25, 5, 1.0


class _Basis:
    """B-spline columns of one parameter, zero at zero, continued straight, and their bending energy."""

    def __init__(self, values: Array, pieces: int) -> None:
        low, high = min(float(values.min()), -1.0), max(float(values.max()), 1.0)
        self.limits = (low, high)
        knots = np.concatenate([[low] * 3, np.linspace(low, high, pieces + 1), [high] * 3])
        self._splines = BSpline(knots, np.eye(pieces + 3), 3)
        sites = np.linspace(low, high, 20 * pieces)
        bend = self._splines(sites, nu=2) * (high - low) ** 1.5  # so that the energy does not depend on the range
        self.energy = bend.T @ bend * (sites[1] - sites[0])

    def columns(self, t: Array) -> Array:
        """Return the columns at t (n,), shape (n, pieces + 3)."""
        inside = np.clip(t, *self.limits)
        return self._splines(inside) + self.slopes(t) * (t - inside)[:, None] - self._splines(np.zeros(1))

    def slopes(self, t: Array) -> Array:
        """Return the derivatives of the columns at t (n,)."""
        return self._splines(np.clip(t, *self.limits), nu=1)


def fit_additive(data: TrainingData, shown: Mask, trim_mad: float) -> FittedForm:
    """Fit the sum of three curves.

    Args:
        shown: which parameters the data show, shape (3,); the curves of the others are translations without rotation.
        trim_mad: see `FittingConfig`.
    """
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
    """Return the component of a curve that is its parameter t, at d (n,)."""
    twist = curve.value(d)
    return (np.cross(twist[:, :3], incisor) + twist[:, 3:]) @ MEASURED[axis]


def _regress(data: TrainingData, t: Array, kept: Mask, shown: Mask) -> tuple[AdditiveModel, float]:
    """Fit the curves while the parameters of the frames stay at t (N, 3)."""
    twists = se3_log(data.motion[kept])
    t, weights = t[kept], data.weights[kept]
    bases = [_Basis(t[:, i], _PIECES[i]) for i in range(3)]
    columns = [basis.columns(t[:, i]) for i, basis in enumerate(bases)]
    root = data.metric.twist_root()
    # In mm: rotations by their effect on the mandible, translations as they are.
    L = np.linalg.cholesky(data.metric.about(data.incisor))
    turning = twists[:, :3] @ L
    gliding = (np.cross(twists[:, :3], data.incisor) + twists[:, 3:]) @ MEASURED.T - t
    folds = (np.arange(len(data)) // _CV_BLOCK % _CV_FOLDS)[kept]
    every, energy, tail = _assembled(columns, bases, shown, (0, 1, 2))
    smoothing = choose_smoothing(every, turning, weights, energy, tail, _SMOOTHING, folds, _CV_CAP_MM)
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
    """Return the columns of some parameters side by side, their bending energy and the fixed part of the penalty."""
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
    """Return the function t -> twist, rate of one curve from the coefficients of omega and s."""

    def curve(t: Array) -> tuple[Array, Array]:
        def twist(columns: Array, own: Array) -> Array:
            omega = columns @ turn
            s = columns @ glide + own[:, None] * MEASURED[axis]
            return np.concatenate([omega, s - np.cross(omega, incisor)], axis=1)

        return twist(basis.columns(t), t), twist(basis.slopes(t), np.ones_like(t))

    return curve
