"""The default model: rotation as a smooth function of where the lower incisal point is.

On the three-dimensional set of reachable poses the displacement u of the incisal point is itself a coordinate system,
so omega = f(u), t = u + p - R(omega) p with f(0) = 0 describes any smooth three-parameter jaw. f is a smoothing
polyharmonic spline; it is refitted while the captured poses are projected onto it, so that noise in u does not bias f.
Where no poses were captured, predictions from the condyles' paths guide the spline weakly (see `condylar`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator.gauge import Gauge
from jawusd.evaluator.models import AnchoredModel
from jawusd.fitting.condylar import CondylarGuidance
from jawusd.fitting.data import MODEL_SIGMA_MM, TrainingData
from jawusd.fitting.form import FittedForm
from jawusd.fitting.gauge_fit import fit_gauge, fit_path
from jawusd.fitting.spline import SplineBasis, choose_smoothing, farthest_points, ridge_solve, within
from jawusd.geometry import make_transform, so3_log

CENTRES = 80
_ROUNDS = 4
_SCALES_MM = np.array([10.0, 7.0, 5.0])  # lengths over which f changes along opening, sideways and forward
_HIDDEN_SCALE_MM = 1e9  # f does not depend on a direction the data do not show
_SMOOTHING = 10.0 ** np.arange(-6.0, 4.0)
_CV_BLOCK, _CV_FOLDS = 25, 5  # frames (about a second of video) that are left out together
_CV_CAP_MM = 1.0
_TAIL_RIDGE = 1e-6  # keeps the slope finite along a direction without motion
_FRAMES_PER_CENTRE = 4
_TRIM_FLOOR_MM = 0.5
_GUIDED_GRID = (9, 7, 7)  # points along opening, sideways and forward with predictions from the condyles' paths
_GUIDED_SHARE = 0.08  # weight of all of them together, relative to the frames, if the paths fitted perfectly


def fit_anchored(data: TrainingData, shown: Mask, trim_mad: float) -> FittedForm:
    """Fit the anchored model.

    Args:
        shown: which of opening, laterotrusion, protrusion the data show, shape (3,); f does not depend on the others.
        trim_mad: see `FittingConfig`.
    """
    u = data.displacement()
    path = fit_path(u, data.weights)
    chart = _Chart(path, np.where(shown, _SCALES_MM, _HIDDEN_SCALE_MM))
    kept = np.ones(len(data), dtype=bool)
    for _ in range(_ROUNDS):
        fitted = kept
        model, smoothing = _regress(data, u, fitted, chart, guided=bool(shown.all()))
        d, nearest = data.metric.nearest(model, data.motion)
        u = chart.path.displacement(d)
        kept = within(data.metric.rms(nearest, data.motion), trim_mad, _TRIM_FLOOR_MM)
    found = fit_gauge(u[fitted], data.weights[fitted], path, shown)
    model = AnchoredModel(found.gauge, data.incisor, chart.scales, model.centres, model.weights)
    notes: dict[str, object] = {
        "centres": len(model.centres),
        "smoothing": smoothing,
        "gauge_smallest_minor": found.smallest_minor,
        "gauge_stiffness": found.stiffness,
    }
    return FittedForm(model, fitted, notes)


@dataclass(frozen=True)
class _Chart:
    """Map incisal displacements u (N, 3) [mm] to the arguments q (N, 3) of the spline: sheared by the path, scaled."""

    path: Gauge
    scales: Array

    def of(self, u: Array) -> Array:
        gx, gz, _, _ = self.path.path(-u[:, 1])
        return np.stack([-u[:, 1], u[:, 0] - gx, u[:, 2] - gz], axis=1) / self.scales

    def displacement(self, q: Array) -> Array:
        opening, side, front = (q * self.scales).T
        gx, gz, _, _ = self.path.path(opening)
        return np.stack([side + gx, -opening, front + gz], axis=1)


def _regress(data: TrainingData, u: Array, kept: Mask, chart: _Chart, guided: bool) -> tuple[AnchoredModel, float]:
    """Fit f to the best rotations of the frames while their incisal points stay at u.

    The smoothing is chosen again in every round, since trimmed outliers no longer require a stiffer f.
    """
    rotation = data.metric.best_rotation(data.motion, data.incisor, u + data.incisor)[kept]
    omega, q, weights = so3_log(rotation), chart.of(u[kept]), data.weights[kept]
    folds = (np.arange(len(data)) // _CV_BLOCK % _CV_FOLDS)[kept]
    if guided:
        motion = make_transform(rotation, u[kept] + data.incisor - rotation @ data.incisor)
        more = _guided_rows(data, motion, weights, chart)
        omega, q, weights = (np.concatenate(pair) for pair in zip((omega, q, weights), more, strict=True))
        folds = np.append(folds, np.full(len(q) - len(folds), -1))
    # In units of mm: |L^T domega|^2 is the mean squared displacement of the mandible about the incisal point.
    L = np.linalg.cholesky(data.metric.about(data.incisor))
    values = omega @ L
    count = min(CENTRES, max(4, int(kept.sum()) // _FRAMES_PER_CENTRE))
    basis = SplineBasis.on_centres(farthest_points(q, count))
    columns = basis.columns(q)
    tail = np.zeros_like(basis.energy)
    tail[-3:, -3:] = _TAIL_RIDGE * np.eye(3)
    smoothing = choose_smoothing(columns, values, weights, basis.energy, tail, _SMOOTHING, folds, _CV_CAP_MM)
    weighted = columns * weights[:, None]
    fitted = ridge_solve(weighted.T @ columns, weighted.T @ values, smoothing * basis.energy + tail)
    spline = basis.weights(np.linalg.solve(L.T, fitted.T).T)
    return AnchoredModel(chart.path, data.incisor, chart.scales, basis.centres, spline), smoothing


def _guided_rows(data: TrainingData, motion: Array, weights: Array, chart: _Chart) -> tuple[Array, Array, Array]:
    """Return rotation vectors (G, 3), spline arguments (G, 3) and weights (G,) predicted from the condyles' paths.

    They fill the box around the captured poses and have a few percent of their total weight, so that they matter only
    where there are no poses.
    """
    guidance = CondylarGuidance.of_motion(motion, weights, data.incisor, data.landmarks[-2:])
    q = chart.of(motion[:, :3, :3] @ data.incisor + motion[:, :3, 3] - data.incisor)
    axes = [np.linspace(low, high, n) for low, high, n in zip(q.min(0), q.max(0), _GUIDED_GRID, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    nearest = cKDTree(q).query(grid)[1]
    omega, found = guidance.rotation(chart.displacement(grid), so3_log(motion[nearest, :3, :3]))
    trust = MODEL_SIGMA_MM**2 / (MODEL_SIGMA_MM**2 + guidance.misfit_mm**2)
    weight = _GUIDED_SHARE * trust * weights.sum() / max(int(found.sum()), 1)
    return omega[found], grid[found], np.full(int(found.sum()), weight)
