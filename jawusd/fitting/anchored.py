"""The default model: rotation as a smooth function of the position of the lower incisal point.

On the three-dimensional set of reachable poses, the displacement u of the incisal point p serves as coordinates, so
omega = f(u), t = u + p - R(omega) p with f(0) = 0 describes any smooth motion with three parameters. f is a smoothing
polyharmonic spline. Fitting f alternates with projecting the captured poses onto it, so that noise in u does not bias
f. Where no poses were captured, the spline follows predictions from the condylar paths, which have a low weight.

Condylar paths: a condyle slides on its eminence, so its height is a function of its forward slide at any opening; its
sideways movement is a function of the difference of the two slides (Bennett) and the opening. These three equations,
learned from the captured poses, determine the rotation at every position of the incisal point. Near captured poses,
they are less accurate than the spline, but they extrapolate to combinations that few takes contain, such as a wide
opening with the jaw to one side, because other exercises cover the same parts of the eminence.

The kinematic centre, which is the point of the condyle that deviates least from a single path (Yatabe et al. 1995, J
Dent Res 74:2006), is estimated near the condyle landmark; the landmark therefore need not be exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator.gauge import Gauge
from jawusd.evaluator.models import AnchoredModel
from jawusd.fitting.data import MODEL_SIGMA_MM, FittedForm, TrainingData, displacement
from jawusd.fitting.gauge_fit import fit_gauge, fit_path, sheared
from jawusd.fitting.spline import SplineBasis, choose_smoothing, farthest_points, folds_of, ridge_solve, within
from jawusd.geometry import make_transform, so3_exp, so3_log

_SLIDE_SCALE_MM, _OPENING_SCALE_MM = 10.0, 40.0  # lengths that normalise the arguments of the polynomials
_DEGREE = 4
_RIDGE = 1e-3
_RANGE_PERCENTILES = (0.5, 99.5)  # slide percentiles outside which the eminence is extrapolated linearly
_LANDMARK_SIGMA_MM = 10.0  # prior standard deviation of the kinematic centre about the landmark [mm]
_PATH_SIGMA_MM = 0.3  # standard deviation of the distance of the kinematic centre from its path [mm]
_FRAMES_ALIKE = 25  # number of consecutive frames (one second) that count as one independent observation
_NEWTON_STEPS, _LARGEST_STEP_RAD, _SETTLED_MM = 15, 0.1, 1e-6
_FARTHER_MM = 4.0  # maximum extrapolation beyond the captured slides [mm]

CENTRES = 80
_ROUNDS = 4
_SCALES_MM = np.array([10.0, 7.0, 5.0])  # length scales of the fitted function f along opening, sideways and forward
# Length scale for parameters that the data do not excite, so large that the fitted function f does not depend on them.
_HIDDEN_SCALE_MM = 1e9
_SMOOTHING = 10.0 ** np.arange(-6.0, 4.0)
_TAIL_RIDGE = 1e-6  # penalty that keeps the linear coefficients finite along a direction without motion
_FRAMES_PER_CENTRE = 4
_TRIM_FLOOR_MM = 0.5
# Numbers of grid points (opening, sideways, forward) at which poses are predicted from the condylar paths.
_GUIDED_GRID = (9, 7, 7)
# Total weight of the predictions from condylar paths relative to that of the frames, for paths without misfit.
_GUIDED_SHARE = 0.08


@dataclass(frozen=True)
class CondylarGuidance:
    """Learned paths of the left and right condyle, in the anatomical frame."""

    incisor: Array  # lower incisal point at rest [mm], shape (3,)
    centres: Array  # kinematic centres at rest [mm], shape (2, 3)
    slopes: Array  # polynomial coefficients of the height as a function of the slide, shape (2, 4) [mm]
    slide_range: Array  # range of the captured slides [mm], per condyle, shape (2, 2)
    shift: Array  # coefficients of the sideways movement of the condyles' midpoint [mm], shape (5,)
    misfit_mm: float  # rms residual of the three equations over the captured poses

    @classmethod
    def of_motion(cls, motion: Array, weights: Array, incisor: Array, condyles: Array) -> CondylarGuidance:
        """Learn the paths from motions (N, 4, 4) with weights (N,), from condyle landmarks (2, 3) at rest [mm]."""
        centres = np.stack([_kinematic_centre(motion, weights, condyle) for condyle in condyles])
        moved = np.stack([displacement(motion, centre) for centre in centres], axis=1)
        ranges = np.percentile(moved[:, :, 2], _RANGE_PERCENTILES, axis=0).T
        slopes = np.stack([_height_over_slide(moved[:, side], weights) for side in (0, 1)])
        opening = -displacement(motion, incisor)[:, 1]
        columns = _shift_columns(moved[:, 0, 2] - moved[:, 1, 2], opening)[0]
        shift = _ridge_fit(columns, moved[:, :, 0].mean(1), weights)
        guidance = cls(incisor, centres, slopes, ranges, shift, 0.0)
        residual = guidance._residual(motion[:, :3, :3], displacement(motion, incisor))[0]
        misfit = np.sqrt(np.average((residual**2).mean(1), weights=weights))
        return replace(guidance, misfit_mm=float(misfit))

    def rotation(self, u: Array, start: Array) -> tuple[Array, Mask]:
        """Return rotation vectors (N, 3) [rad] that satisfy the condylar equations at displacements u (N, 3) [mm].

        `start` (N, 3) are rotation vectors to start from. Also returns which converged near captured slides, (N,).
        """
        R = so3_exp(start)
        for _ in range(_NEWTON_STEPS):
            residual, slope, _ = self._residual(R, u)
            step = np.linalg.solve(slope, -residual[..., None])[..., 0]
            length = np.linalg.norm(step, axis=1, keepdims=True)
            R = so3_exp(step * np.minimum(1.0, _LARGEST_STEP_RAD / np.maximum(length, 1e-12))) @ R
        residual, _, slides = self._residual(R, u)
        low, high = self.slide_range[:, 0] - _FARTHER_MM, self.slide_range[:, 1] + _FARTHER_MM
        found = (np.abs(residual).max(1) < _SETTLED_MM) & np.all((slides > low) & (slides < high), axis=1)
        return so3_log(R), found

    def _residual(self, R: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return residuals (N, 3) [mm], their derivatives (N, 3, 3) with respect to rotation, and the slides (N, 2).

        The poses are rotations R (N, 3, 3) at incisal displacements u (N, 3) [mm]; derivatives are spatial.
        """
        arms = np.einsum("nij,kj->nki", R, self.centres - self.incisor)
        moved = arms + (u + self.incisor)[:, None] - self.centres
        # A spatial rotation w moves a condyle by w x arm, and therefore its coordinate i by (arm x e_i) . w.
        by_w = np.cross(arms[:, :, None, :], np.eye(3))
        slides = moved[:, :, 2]
        height, slope = self._eminence(slides)
        columns, by_difference = _shift_columns(slides[:, 0] - slides[:, 1], -u[:, 1])
        middle = moved[:, :, 0].mean(1) - columns @ self.shift
        residual = np.column_stack([moved[:, :, 1] - height, middle])
        heights_by_w = by_w[:, :, 1] - slope[:, :, None] * by_w[:, :, 2]
        middle_by_w = by_w[:, :, 0].mean(1) - (by_difference @ self.shift)[:, None] * (by_w[:, 0, 2] - by_w[:, 1, 2])
        return residual, np.concatenate([heights_by_w, middle_by_w[:, None]], axis=1), slides

    def _eminence(self, slides: Array) -> tuple[Array, Array]:
        """Return height and slope of the eminences at slides (N, 2), extrapolated linearly beyond captured slides."""
        inside = np.clip(slides, self.slide_range[:, 0], self.slide_range[:, 1])
        powers = np.arange(1, _DEGREE + 1)
        s = (inside / _SLIDE_SCALE_MM)[..., None]
        slope = (self.slopes * powers * s ** (powers - 1)).sum(-1) / _SLIDE_SCALE_MM
        return (self.slopes * s**powers).sum(-1) + slope * (slides - inside), slope


def _kinematic_centre(motion: Array, weights: Array, condyle: Array) -> Array:
    """Return the point [mm] near a condyle landmark whose height is best explained by its forward slide, shape (3,).

    The search varies only the vertical and anterior coordinates, since all points on the condylar axis move alike.
    """
    root = np.sqrt(weights / _FRAMES_ALIKE)

    def residual(offset: Array) -> Array:
        moved = displacement(motion, condyle + [0.0, *offset])
        coefficients = _height_over_slide(moved, weights)
        left = (moved[:, 1] - _powers(moved[:, 2]) @ coefficients) * root
        return np.concatenate([left / _PATH_SIGMA_MM, offset / _LANDMARK_SIGMA_MM])

    return condyle + [0.0, *least_squares(residual, np.zeros(2), method="lm", diff_step=1e-4, x_scale=1.0).x]


def _height_over_slide(moved: Array, weights: Array) -> Array:
    return _ridge_fit(_powers(moved[:, 2]), moved[:, 1], weights)


def _powers(slide: Array) -> Array:
    return (slide / _SLIDE_SCALE_MM)[:, None] ** np.arange(1, _DEGREE + 1)


def _shift_columns(difference: Array, opening: Array) -> tuple[Array, Array]:
    """Return regressors (N, 5) of the sideways movement, and derivatives with respect to the slide difference."""
    d, o = difference / _SLIDE_SCALE_MM, opening / _OPENING_SCALE_MM
    zero, one = np.zeros_like(d), np.ones_like(d)
    columns = np.stack([d, d * np.abs(d), d * o, o, o * o], axis=1)
    return columns, np.stack([one, 2 * np.abs(d), o, zero, zero], axis=1) / _SLIDE_SCALE_MM


def _ridge_fit(columns: Array, values: Array, weights: Array) -> Array:
    weighted = columns * weights[:, None]
    penalty = _RIDGE * weights.sum() * np.eye(columns.shape[1])
    return np.linalg.solve(weighted.T @ columns + penalty, weighted.T @ values)


def fit_anchored(data: TrainingData, shown: Mask, trim_mad: float) -> FittedForm:
    """Fit the anchored model; f depends only on the parameters shown (3,), which the data excite."""
    u = data.displacement()
    path = fit_path(u, data.weights)
    scales = np.where(shown, _SCALES_MM, _HIDDEN_SCALE_MM)
    kept = np.ones(len(data), dtype=bool)
    for _ in range(_ROUNDS):
        fitted = kept
        model, smoothing = _regress(data, u, fitted, path, scales, guided=bool(shown.all()))
        d, nearest = data.metric.nearest(model, data.motion)
        u = path.displacement(d)
        kept = within(data.metric.rms(nearest, data.motion), trim_mad, _TRIM_FLOOR_MM)
    found = fit_gauge(u[fitted], data.weights[fitted], path, shown)
    model = AnchoredModel(found.gauge, data.incisor, scales, model.centres, model.weights)
    notes: dict[str, object] = {
        "centres": len(model.centres),
        "smoothing": smoothing,
        "gauge_smallest_minor": found.smallest_minor,
        "gauge_stiffness": found.stiffness,
    }
    return FittedForm(model, fitted, notes)


def _regress(
    data: TrainingData, u: Array, kept: Mask, path: Gauge, scales: Array, guided: bool
) -> tuple[AnchoredModel, float]:
    """Fit the map f from u to the rotation that best explains each frame's pose with the incisal point fixed at u.

    The smoothing factor is chosen again in every call, since f may be less stiff once outliers are trimmed.
    """
    rotation = data.metric.best_rotation(data.motion, data.incisor, u + data.incisor)[kept]
    omega, q, weights = so3_log(rotation), sheared(u[kept], path) / scales, data.weights[kept]
    folds = folds_of(len(data))[kept]
    if guided:
        motion = make_transform(rotation, u[kept] + data.incisor - rotation @ data.incisor)
        more = _guided_rows(data, motion, weights, path, scales)
        omega, q, weights = (np.concatenate(pair) for pair in zip((omega, q, weights), more, strict=True))
        folds = np.append(folds, np.full(len(q) - len(folds), -1))
    # The values are in mm: |L^T domega|^2 is the mean squared displacement of the mandible about the incisal point.
    L = np.linalg.cholesky(data.metric.about(data.incisor))
    values = omega @ L
    count = min(CENTRES, max(4, int(kept.sum()) // _FRAMES_PER_CENTRE))
    basis = SplineBasis.on_centres(farthest_points(q, count))
    columns = basis.columns(q)
    tail = np.zeros_like(basis.energy)
    tail[-3:, -3:] = _TAIL_RIDGE * np.eye(3)
    smoothing = choose_smoothing(columns, values, weights, basis.energy, tail, _SMOOTHING, folds)
    weighted = columns * weights[:, None]
    fitted = ridge_solve(weighted.T @ columns, weighted.T @ values, smoothing * basis.energy + tail)
    spline = basis.weights(np.linalg.solve(L.T, fitted.T).T)
    return AnchoredModel(path, data.incisor, scales, basis.centres, spline), smoothing


def _guided_rows(
    data: TrainingData, motion: Array, weights: Array, path: Gauge, scales: Array
) -> tuple[Array, Array, Array]:
    """Return rotation vectors (G, 3), spline arguments (G, 3) and weights (G,) predicted from the condylar paths.

    The predictions fill the box around the captured poses, with a low total weight.
    """
    guidance = CondylarGuidance.of_motion(motion, weights, data.incisor, data.landmarks[-2:])
    q = sheared(displacement(motion, data.incisor), path) / scales
    axes = [np.linspace(low, high, n) for low, high, n in zip(q.min(0), q.max(0), _GUIDED_GRID, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    nearest = cKDTree(q).query(grid)[1]
    # The path alone is a gauge without arch and glide surface, whose d is the sheared displacement.
    omega, found = guidance.rotation(path.displacement(grid * scales), so3_log(motion[nearest, :3, :3]))
    trust = MODEL_SIGMA_MM**2 / (MODEL_SIGMA_MM**2 + guidance.misfit_mm**2)
    weight = _GUIDED_SHARE * trust * weights.sum() / max(int(found.sum()), 1)
    return omega[found], grid[found], np.full(int(found.sum()), weight)
