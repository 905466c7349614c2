"""Quality of an alignment: score, residuals, coverage of the masks, and covariance."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import hat, mandible_metric, se3_adjoint, se3_inverse, transform_points
from jawusd.meshes.raster import count_and_not, count_bits, pack_bits
from jawusd.tracking.config import Mapper, TrackingConfig
from jawusd.tracking.contour.equations import NormalEquations, ResidualTerm, Solution, translation
from jawusd.tracking.contour.scan import ARCHES, Scan
from jawusd.tracking.contour.views import View

_GUM_BY_TOOTH_PX = 0.3  # standard deviation of the part of the gum-line error that differs from tooth to tooth [px]
# Variance E[w d^2] / E[w] of a standard normal residual d with Tukey weight w (gate of 4.685 standard deviations),
# computed by quadrature.
_TUKEY_VARIANCE = 0.828


def score_px(solution: Solution) -> Array:
    """Return the matched contour length, weighted by closeness, per arch and view [px], shape (2, C)."""
    return solution.outline.score_px


def matched_px(solution: Solution) -> Array:
    """Return the matched contour length per arch [px], shape (2,)."""
    return np.asarray(solution.outline.matched_px.sum(1))


def fitting_share(solution: Solution) -> Array:
    """Return the matched fraction of the visible contour, weighted by closeness, per arch [-], shape (2,)."""
    return np.asarray(score_px(solution).sum(1) / np.maximum(solution.visible_px.sum(1), 1.0), np.float64)


def residual_px(solution: Solution) -> Array:
    """Return the standard deviation of the matched residuals per arch [px], shape (2,); NaN without matches."""
    with np.errstate(invalid="ignore", divide="ignore"):
        sums = solution.outline
        return np.sqrt(sums.square.sum(1) / sums.weight.sum(1) / _TUKEY_VARIANCE)


def view_residual_px(solution: Solution) -> Array:
    """Return the standard deviation of the residuals per arch and view [px], shape (2, C); NaN without matches."""
    sums = solution.outline
    out = np.full(sums.weight.shape, np.nan)
    np.divide(sums.square, sums.weight * _TUKEY_VARIANCE, out=out, where=sums.weight > 0)
    return np.sqrt(out)


def uncovered_px(
    scans: Sequence[Scan], poses: Array, views: Sequence[View], in_threads: Mapper = map
) -> tuple[Array, Array]:
    """Return numbers of mask pixels outside projected crowns (E_SP in eq. 8 of the paper), and of all, (2, C) each."""
    uncovered, total = np.zeros((2, len(views))), np.zeros((2, len(views)))

    def count(task: tuple[int, int]) -> None:
        r, c = task
        view = views[c]
        mask = pack_bits(view.masks[r] > 127)
        crowns = scans[r].silhouette(view.matrix @ view.T_delay[r] @ poses[r], view.masks.shape[1:])
        uncovered[r, c], total[r, c] = count_and_not(mask, crowns), count_bits(mask)

    list(in_threads(count, [(r, c) for r in range(len(scans)) for c in range(len(views)) if views[c].present[r]]))
    return uncovered, total


def penalised_score_px(solution: Solution, uncovered: Array, uncovered_price: float) -> Array:
    """Return the matched contour less the penalty for uncovered mask, per arch and view [px], shape (2, C).

    `uncovered` (2, C) are numbers of pixels, and `uncovered_price` the penalty of one, in px of contour [1/px].
    """
    return score_px(solution) - uncovered_price * uncovered


def coverage_error(uncovered: Array, total: Array) -> Array:
    """Return the uncovered fraction of every mask from the results of `uncovered_px`; NaN without a mask."""
    return np.where(total > 0, uncovered / np.maximum(total, 1), np.nan)


def arch_fit(scans: Sequence[Scan], solution: Solution, views: Sequence[View], uncovered_price: float) -> Array:
    """Return the matched fraction of each arch's visible contour, less the penalty for uncovered mask, shape (2,) [-].

    The result is the median over the views, so that one wrong mask of three is ignored; -inf if nothing is visible.
    `uncovered_price` is as in `penalised_score_px`.
    """
    uncovered, _ = uncovered_px(scans, solution.poses, views)
    shares = penalised_score_px(solution, uncovered, uncovered_price) / np.maximum(solution.visible_px, 1.0)
    out = np.full(2, -np.inf)
    for r in ARCHES:
        seen = shares[r, solution.visible_px[r] > 0]
        if len(seen):
            out[r] = np.median(seen)
    return out


def twist_covariance(solution: Solution, arch: int, sigma_px: float, correlation_px: float) -> Array:
    """Return the covariance of an arch's left twist about the world origin, sigma^2 l H^-1, shape (6, 6).

    The diagonal is infinite if the masks leave a motion unconstrained. `sigma_px` is the standard deviation of the
    outline error; with its correlation length l, n pixels of contour contain n / l independent measurements.
    """
    H = solution.outline.precision[arch].sum(0)
    if not np.isfinite(sigma_px) or np.linalg.matrix_rank(H, hermitian=True) < 6:
        return np.diag(np.full(6, np.inf))
    A = se3_adjoint(translation(solution.centres[arch]))
    inverse = np.linalg.inv(H)
    gum = _GUM_BY_TOOTH_PX**2 * inverse @ solution.gum_scatters[arch] @ inverse
    return A @ (sigma_px**2 * correlation_px * inverse + gum) @ A.T


def joint_covariance(solution: Solution, prior: ResidualTerm, sigma_px: Array, correlation_px: float) -> Array | None:
    """Return the covariance of both arches' left twists about the world origin given masks and prior, shape (12, 12).

    Return None if masks and prior, a log-likelihood, leave a motion unconstrained. `sigma_px`, shape (2,), and
    `correlation_px` are as for `twist_covariance`.
    """
    equations = NormalEquations()
    prior.accumulate(replace(solution, centres=np.zeros((2, 3))), equations)
    for r in ARCHES:
        to_centre = se3_adjoint(translation(-solution.centres[r]))
        H = solution.outline.precision[r].sum(0) / (sigma_px[r] ** 2 * correlation_px)
        equations.add(r, to_centre.T @ H @ to_centre, np.zeros(6))
    precision = equations.matrix
    if not np.isfinite(precision).all():
        return None
    scale = 1.0 / np.sqrt(np.maximum(np.diag(precision), 1e-300))
    scaled = scale[:, None] * precision * scale
    if np.linalg.matrix_rank(scaled, hermitian=True) < 12:
        return None
    return scale[:, None] * np.linalg.inv(scaled) * scale


def correlation_px(solution: Solution, config: TrackingConfig) -> Array:
    """Return the correlation length of outline errors along the contour, estimated from one frame [px], shape (2,).

    The length is tr(H^-1 S) / (6 sigma^2) times `tile_factor`, with precision H and tile scatter S; NaN if the matches
    leave a motion unconstrained.
    """
    out = np.full(2, np.nan)
    sigma = residual_px(solution)
    for r in ARCHES:
        H = solution.outline.precision[r].sum(0)
        if sigma[r] > 0 and np.linalg.matrix_rank(H, hermitian=True) == 6:
            measured = np.trace(np.linalg.solve(H, solution.scatters[r])) / (6 * sigma[r] ** 2)
            out[r] = config.tile_factor * measured
    return out


def outline_errors(solved: Iterable[tuple[Solution, Mask]], config: TrackingConfig) -> tuple[Array, float]:
    """Return variance times correlation length of outline errors per arch [px^3], shape (2,), and that length [px].

    Both are medians over frames, given as alignments and whether each arch was found, shape (2,).
    """
    figures = [np.where(found, [residual_px(own), correlation_px(own, config)], np.nan) for own, found in solved]
    residual, lengths = np.reshape(figures, (-1, 2, 2)).swapaxes(0, 1)
    known = lengths[np.isfinite(lengths)]
    length = float(np.median(known)) if len(known) else config.correlation_px
    if config.known_correlation_px is not None:
        length = config.known_correlation_px
    out = np.full(2, config.typical_noise_px3)
    for r in np.flatnonzero(np.isfinite(residual).any(0)):
        out[r] = np.nanmedian(residual[:, r]) ** 2 * length
    return out, length


def crown_sigma_mm(scan: Scan, solution: Solution, arch: int, config: TrackingConfig) -> float:
    """Return the rms position uncertainty of crown vertices [mm]; infinite if the masks do not constrain it."""
    sigma = float(residual_px(solution)[arch])
    covariance = twist_covariance(solution, arch, sigma, config.correlation_px)
    if not np.isfinite(covariance).all():
        return np.inf
    points = transform_points(solution.poses[arch], scan.probes)
    return float(np.sqrt(np.trace(mandible_metric(points) @ covariance)))


def relative_covariance(T_world_upper: Array, covariance_upper: Array, covariance_lower: Array) -> Array:
    """Return the covariance of the left twist of T_upper_lower about the skull origin, shape (..., 6, 6).

    With T = T_upper_lower, T_true = T_u^-1 exp(x_l - x_u) T_u T to first order, so the twist is Ad(T_u^-1)(x_l - x_u);
    the arches' errors are independent because no mask edge is matched by both.
    """
    A = se3_adjoint(se3_inverse(T_world_upper))
    return A @ (covariance_upper + covariance_lower) @ np.swapaxes(A, -1, -2)


def landmark_sigmas(T_upper_lower: Array, covariance: Array, landmarks: Array) -> Array:
    """Return the standard deviation of landmarks (L, 3) in the skull frame [mm], shape (..., L).

    `T_upper_lower` has shape (..., 4, 4); `covariance` (..., 6, 6) is the result of `relative_covariance`.
    """
    points = transform_points(T_upper_lower, landmarks)
    J = np.concatenate([-hat(points), np.broadcast_to(np.eye(3), (*points.shape, 3))], axis=-1)
    return np.sqrt(np.einsum("...lij,...jk,...lik->...l", J, covariance, J))


def widening(T_upper_lower: Array, covariance: Array, landmark: Array, least_mm: Array | float) -> Array:
    """Return factors >= 1 on covariances (...) that raise the standard deviation of a landmark (3,) to `least_mm`.

    `T_upper_lower` and `covariance` are as in `landmark_sigmas`; `least_mm` is 0 where nothing should change. Unknown
    covariances give 1.
    """
    sigma = landmark_sigmas(T_upper_lower, covariance, landmark[None])[..., 0]
    return np.asarray(np.fmax(np.square(least_mm / sigma), 1.0))
