"""The default model: rotation as a smooth function of where the lower incisal point is.

On the three-dimensional set of reachable poses the displacement u of the incisal point is itself a coordinate system,
so omega = f(u), t = u + p - R(omega) p with f(0) = 0 describes any smooth three-parameter jaw. f is a smoothing
polyharmonic spline; it is refitted while the captured poses are projected onto it, so that noise in u does not bias f.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.evaluator.gauge import Gauge
from jawusd.evaluator.models import AnchoredModel
from jawusd.fitting.data import TrainingData
from jawusd.fitting.gauge_fit import GaugeFit, fit_gauge, path_gauge
from jawusd.fitting.path import fit_path
from jawusd.fitting.spline import SplineBasis, choose_smoothing, farthest_points, ridge_solve
from jawusd.fitting.trimming import within
from jawusd.geometry import so3_log

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

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


@dataclass(frozen=True)
class AnchoredFit:
    """Hold a fitted anchored model.

    Attributes:
        model: the decoder.
        gauge_fit: the gauge and its invertibility check.
        smoothing: what cross-validation chose.
        kept: training frames that were not trimmed, shape (N,).
    """

    model: AnchoredModel
    gauge_fit: GaugeFit
    smoothing: float
    kept: Mask
    kind = "anchored"

    def arrays(self) -> dict[str, Array]:
        """Return the model's own arrays."""
        gauge = self.model.gauge
        return {
            "path_coefficients": gauge.path_coefficients,
            "path_scale_mm": np.array(gauge.path_scale_mm),
            "path_limits": np.array(gauge.path_limits),
            "glide_arch": gauge.glide_arch,
            "glide_drop": gauge.glide_drop,
            "glide_softness_mm": np.array(gauge.glide_softness_mm),
            "glide_fade_mm": np.array(gauge.glide_fade_mm),
            "spline_scales": self.model.scales,
            "spline_centres": self.model.centres,
            "spline_weights": self.model.weights,
        }

    def notes(self) -> dict[str, float | None]:
        """Return what the header says about the fit."""
        return {
            "centres": len(self.model.centres),
            "smoothing": self.smoothing,
            "gauge_smallest_minor": self.gauge_fit.smallest_minor,
            "gauge_stiffness": self.gauge_fit.stiffness,
        }


def fit_anchored(data: TrainingData, shown: Mask, trim_mad: float) -> AnchoredFit:
    """Fit the anchored model.

    Args:
        data: the training data.
        shown: which of opening, laterotrusion, protrusion the data show, shape (3,); f does not depend on the others.
        trim_mad: frames farther from the model than the median by this many normalised median absolute deviations
            are left out of the fit.
    """
    u = data.displacement()
    path = fit_path(u, data.weights)
    plain = path_gauge(path)
    scales = np.where(shown, _SCALES_MM, _HIDDEN_SCALE_MM)
    kept = np.ones(len(data), dtype=bool)
    for _ in range(_ROUNDS):
        fitted = kept
        model, smoothing = _regress(data, u, fitted, plain, scales)
        d, nearest = data.metric.nearest(model, data.motion)
        u = plain.displacement(d)
        kept = within(data.metric.rms(nearest, data.motion), trim_mad, _TRIM_FLOOR_MM)
    gauge_fit = fit_gauge(u[fitted], data.weights[fitted], path, shown)
    model = AnchoredModel(gauge_fit.gauge, data.incisor, scales, model.centres, model.weights)
    return AnchoredFit(model, gauge_fit, smoothing, fitted)


def _regress(
    data: TrainingData, u: Array, kept: Mask, plain: Gauge, scales: Array
) -> tuple[AnchoredModel, float]:
    """Fit f to the rotations that suit the frames best while their incisal points stay at u.

    The smoothing is chosen anew each time: gross outliers, once trimmed, no longer ask for a stiffer f.
    """
    gx, gz, _, _ = plain.path(-u[:, 1])
    q = np.stack([-u[:, 1], u[:, 0] - gx, u[:, 2] - gz], axis=1) / scales
    rotation = data.metric.best_rotation(data.motion, data.incisor, u + data.incisor)
    # In units of mm: |L^T domega|^2 is the mean squared displacement of the mandible about the incisal point.
    L = np.linalg.cholesky(data.metric.about(data.incisor))
    values = so3_log(rotation[kept]) @ L
    count = min(CENTRES, max(4, int(kept.sum()) // _FRAMES_PER_CENTRE))
    basis = SplineBasis.on_centres(farthest_points(q[kept], count))
    columns, weights = basis.columns(q[kept]), data.weights[kept]
    tail = np.zeros_like(basis.energy)
    tail[-3:, -3:] = _TAIL_RIDGE * np.eye(3)
    folds = (np.arange(len(data)) // _CV_BLOCK % _CV_FOLDS)[kept]
    smoothing = choose_smoothing(columns, values, weights, basis.energy, tail, _SMOOTHING, folds, _CV_CAP_MM)
    weighted = columns * weights[:, None]
    fitted = ridge_solve(weighted.T @ columns, weighted.T @ values, smoothing * basis.energy + tail)
    spline = basis.weights(np.linalg.solve(L.T, fitted.T).T)
    return AnchoredModel(plain, data.incisor, scales, basis.centres, spline), smoothing
