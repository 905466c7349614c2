"""The jaw in a shot from points on the skin, learned in the frames of the same shot in which the teeth are visible.

The pose of the head comes from points that follow the head, which are visible even if the teeth are not.

Each coordinate of a point follows a quadratic polynomial of d. What this leaves is described by a few components, for
expressions, and by a variance of each coordinate. In the other frames, d is the most probable value given the points
that are found (generalised least squares).

Lips that close move the skin around them in ways that no frame with visible teeth shows. Every point therefore has an
additional variance: the mean square of what the model leaves of its motion in the frames with hidden teeth, estimated
in turn with d of these frames.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FittingError
from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import SkinJaw
from jawusd.fitting import face
from jawusd.geometry import rigid_fit, se3_inverse, transform_points

_LEAST_SHARE = 0.4  # minimum fraction of the frames in which a point is found
_FIXED_MM = 0.6  # maximum typical distance of a point that follows the head from its mean position
_LEAST_FIXED, _LEAST_MOVING = 8, 12  # minimum numbers of points that follow the head, and of other points
_LEAST_SPREAD_MM = 6.0  # minimum extent of the points that follow the head along their second principal axis
_HEAD_ROUNDS, _HEAD_OUTLIER = 4, 2.5  # rounds of reweighting points, and robust sigma beyond which they count less

_COMPONENTS = 12  # number of components of the motion that does not depend on d
_FLOOR_MM = 0.05  # standard deviation of the points that is added to that in the training frames
_LEAST_FOUND = 0.5  # fraction of the points found in a training frame
_RIDGE, _FILLING = 0.01, 20  # weight on the terms of d; rounds that fill missing points by the components
_ROUNDS, _ADAPTED = 5, 200  # rounds of estimating d and the additional variances, and most frames used for it
_STEPS, _FARTHEST = 10, 6.0  # Gauss-Newton steps; largest distance from the mean d, in standard deviations
# Opening beyond that of all training frames, in standard deviations, up to which d counts as known. See
# docs/explanation/constants.md.
_BEYOND = 1.0
_HEAD_ERROR = (2.0, 0.03)  # shift [mm] and turn [rad] by which the pose of the head may be wrong, per axis
_PRIOR = 3.0  # standard deviation of d before any point is seen, relative to that in the training frames
# Factor on the covariance: errors of neighbouring points are alike. See docs/explanation/constants.md.
_WIDER = 3.0
_MEDIAN_SQUARE = 0.455  # median of the square of a standard normal variable


def in_head(points: Array, T_world_head: Array, seen: Mask) -> Array:
    """Return points on the skin, in the world, as points (F, M, 3) [mm] in the skull frame; NaN if too few are found.

    Args:
        points: points on the skin in the world [mm], NaN where they are not found, shape (F, N, 3).
        T_world_head: poses of the head, correct where the teeth are visible, shape (F, 4, 4).
        seen: frames in which the teeth are visible, shape (F,).

    Raises:
        FittingError: too few points are found, or too few of them follow the head.
    """
    local = transform_points(se3_inverse(T_world_head[seen]), points[seen])
    present = np.isfinite(points[:, :, 0])
    often = (present.mean(axis=0) >= _LEAST_SHARE) & (present[seen].mean(axis=0) >= _LEAST_SHARE)
    points, local = points[:, often], local[:, often]
    rest = np.nanmedian(local, axis=0)
    off = np.nanquantile(np.linalg.norm(local - rest, axis=2), 0.75, axis=0)
    fixed = off <= _FIXED_MM
    _check_points(rest, fixed)
    T = np.stack([_head_pose(rest[fixed], frame[fixed]) for frame in points])
    T[seen] = T_world_head[seen]
    return transform_points(se3_inverse(T), points)


def _check_points(rest: Array, fixed: Mask) -> None:
    count, moving = int(fixed.sum()), int((~fixed).sum())
    spread = 0.0
    if count >= 3:
        centred = rest[fixed] - rest[fixed].mean(axis=0)
        spread = 2 * float(np.linalg.svd(centred, compute_uv=False)[1]) / np.sqrt(count)
    if moving < _LEAST_MOVING:
        raise FittingError(
            f"{moving} points on the skin of chin and lower face can be followed through the shot; at least "
            f"{_LEAST_MOVING} are needed.",
            hint="The skin needs texture that the cameras resolve: freckles, stubble, or painted dots of 1 to 2 mm. "
            "Film closer, in focus and without glare.",
        )
    if count < _LEAST_FIXED or spread < _LEAST_SPREAD_MM:
        raise FittingError(
            f"{count} points on the skin follow the head, over {spread:.0f} mm; at least {_LEAST_FIXED} over "
            f"{_LEAST_SPREAD_MM:g} mm are needed to determine the head pose where the teeth are hidden.",
            hint="Film nose and cheeks too, or paint dots on them.",
        )


def _head_pose(rest: Array, found: Array) -> Array:
    """Return the robust pose (4, 4) that moves points (N, 3) to the points found (N, 3), NaN if too few are found."""
    known = np.isfinite(found[:, 0])
    T = np.full((4, 4), np.nan)
    if known.sum() < _LEAST_FIXED / 2:
        return T
    weights = np.ones(int(known.sum()))
    for _ in range(_HEAD_ROUNDS):
        T = rigid_fit(rest[known], found[known], weights)
        off = np.linalg.norm(transform_points(T, rest[known]) - found[known], axis=1)
        weights = 1.0 / (1.0 + (off / (_HEAD_OUTLIER * max(float(np.median(off)), 1e-6))) ** 2)
    return T


class ShotJaw(NamedTuple):
    """The jaw in all frames of a shot."""

    #: d with covariance; NaN where too few points are found, or where they show a jaw far wider open than in the
    #: training frames. Familiar wherever it is known
    jaw: SkinJaw
    frames: int  # number of frames with visible teeth, from which it was learned
    errors_mm: dict[str, float]  # mean held-out errors at the incisal point, see `fitting.skin.fit_skin`


def jaw_of_points(rig: JawRig, X: Array, d: Array, seen: Mask, sigma_mm: float) -> ShotJaw:
    """Return the jaw in all frames of a shot.

    Args:
        rig: the subject's rig.
        X: points on the skin relative to the head [mm], NaN where they are not found, shape (F, N, 3).
        d: jaw parameters [mm], shape (F, 3).
        seen: frames in which d was measured, shape (F,).
        sigma_mm: standard deviation of d in these frames.

    Raises:
        FittingError: there are too few frames or too little motion, or the held-out error exceeds 65 % of that of a
            baseline; a chin rigid with the bone is none, since without skin, hidden frames are interpolated.
    """
    usable = seen & (np.isfinite(X[..., 0]).mean(axis=1) >= _LEAST_FOUND)
    rows = face.training_rows(usable)
    face.check_motion(np.nan_to_num(X[rows].reshape(len(rows), -1)), d[rows], np.array(sigma_mm))
    held_out = np.empty((len(rows), 3))
    blocks = face.blocks_of(len(rows))
    for block in blocks:
        others = np.delete(rows, block)
        held_out[block] = PointModel(X[others], d[others]).jaw(X[rows[block]])[0]
    model = PointModel(X[rows], d[rows])
    errors = face.held_out_errors(rig, held_out, d[rows], blocks, model.filled)
    face.check_errors({name: value for name, value in errors.items() if name != "chin"})
    hidden = X[~seen & (np.isfinite(X[..., 0]).sum(axis=1) >= _LEAST_MOVING)]
    found, covariance, _ = model.jaw(X, model.departures(hidden))
    # errors of the polynomials, which are alike in all points: robust variances of the held-out errors
    covariance = covariance + np.diag(np.median(np.square(held_out - d[rows]), axis=0) / _MEDIAN_SQUARE)
    known = model.covers(found)
    found[~known], covariance[~known] = np.nan, np.nan
    return ShotJaw(SkinJaw(found, covariance, known), int(usable.sum()), errors)


class PointModel:
    """How points on the skin move with d and expressions.

    Attributes:
        filled: the points of the training frames (M, N, 3) [mm], with estimates where they are missing.
    """

    def __init__(self, X: Array, d: Array) -> None:
        """Learn from points (M, N, 3) [mm], NaN where they are missing, and d (M, 3) [mm] of training frames."""
        self._centre, self._size = d.mean(axis=0), d.std(axis=0)
        self._widest = float((d[:, 0].max() - self._centre[0]) / self._size[0])
        self._mean = np.nanmean(X, axis=0)
        moved = (X - self._mean).reshape(len(X), -1)
        known = np.isfinite(moved)
        terms = _terms((d - self._centre) / self._size)
        normal = np.einsum("fp,fij->pij", known.astype(float), terms[:, :, None] * terms[:, None])
        normal += _RIDGE * np.diag([0.0] + [1.0] * (terms.shape[1] - 1))
        self._slope = np.linalg.solve(normal, (np.nan_to_num(moved).T @ terms)[..., None])[..., 0].T
        left = np.where(known, moved - terms @ self._slope, 0.0)
        for _ in range(1 if known.all() else _FILLING):
            U, s, Vt = np.linalg.svd(left, full_matrices=False)
            low = (U[:, :_COMPONENTS] * s[:_COMPONENTS]) @ Vt[:_COMPONENTS]
            left = np.where(known, left, low)
        self.filled = (left + terms @ self._slope).reshape(X.shape) + self._mean
        free = terms.shape[1]
        self._expressions = s[:_COMPONENTS, None] * Vt[:_COMPONENTS] / np.sqrt(len(X) - free)
        count = np.maximum(known.sum(axis=0) - free - _COMPONENTS, 1)
        self._head = face.head_motions(self._mean, *_HEAD_ERROR)
        self._variance = np.square(left - low).sum(axis=0) / count + _FLOOR_MM**2

    def covers(self, d: Array) -> Mask:
        """Return whether d (F, 3) [mm] is known and not far wider open than in the training frames, shape (F,).

        Openings are extrapolated wrongly beyond these frames, with a small covariance.
        """
        return np.asarray((d[:, 0] - self._centre[0]) / self._size[0] <= self._widest + _BEYOND)

    def departures(self, hidden: Array) -> Array:
        """Return the additional variances of points (N,) [mm^2] by points (F, N, 3) in frames with hidden teeth."""
        found = np.zeros(len(self._mean))
        if not len(hidden):
            return found
        hidden = hidden[np.linspace(0, len(hidden) - 1, min(len(hidden), _ADAPTED)).astype(int)]
        known = np.isfinite(hidden[..., 0])
        for _ in range(_ROUNDS):
            left = self.jaw(hidden, found)[2]
            square = np.where(known, np.square(np.nan_to_num(left)).mean(axis=2), 0.0).sum(axis=0)
            found = square / np.maximum(known.sum(axis=0), 1)
        return found

    def jaw(self, X: Array, departures: Array | float = 0.0) -> tuple[Array, Array, Array]:
        """Return d (F, 3) [mm] of points (F, N, 3) [mm], covariances (F, 3, 3) [mm^2], and what the terms in d leave.

        Points are NaN where they are not found, d where too few are; `departures` (N,) are additional variances of
        points [mm^2]. The third result has the shape of the points [mm].
        """
        moved = (X - self._mean).reshape(len(X), -1)
        known, moved = np.isfinite(moved), np.nan_to_num(moved)
        weight = known / (self._variance + np.repeat(np.broadcast_to(departures, len(self._mean)), 3))
        # normal equations of the terms in d and of nuisances: errors of the head and expressions, with unit variances
        rows, k = np.concatenate([self._slope, self._head, self._expressions]), len(self._slope)
        every = (weight @ (rows[:, None] * rows).reshape(-1, rows.shape[1]).T).reshape(-1, len(rows), len(rows))
        by_point = (weight * moved) @ rows.T
        inner = np.linalg.inv(every[:, k:, k:] + np.eye(len(rows) - k))
        normal = every[:, :k, :k] - every[:, :k, k:] @ inner @ every[:, k:, :k]
        right = by_point[:, :k] - np.einsum("fij,fjk,fk->fi", every[:, :k, k:], inner, by_point[:, k:])
        u, covariance = _solved(normal, right)
        terms = _terms(u)
        nuisances = np.einsum("fij,fj->fi", inner, by_point[:, k:] - np.einsum("fij,fj->fi", every[:, k:, :k], terms))
        left = moved - terms @ self._slope - nuisances[:, : len(self._head)] @ self._head
        few = known.sum(axis=1) < 3 * _LEAST_MOVING
        u[few], covariance[few] = np.nan, np.nan
        covariance = _WIDER * covariance * self._size[:, None] * self._size
        return self._centre + u * self._size, covariance, np.where(known, left, np.nan).reshape(X.shape)


def _solved(normal: Array, right: Array) -> tuple[Array, Array]:
    """Return the most probable u (F, 3) by normal equations of its terms (F, 10, 10), and its covariance (F, 3, 3)."""
    u, prior = np.zeros((len(right), 3)), np.eye(3) / _PRIOR**2
    for _ in range(_STEPS):
        slopes = _slopes(u)
        matrix = np.swapaxes(slopes, 1, 2) @ normal @ slopes + prior
        towards = right - np.einsum("fij,fj->fi", normal, _terms(u))
        downhill = np.einsum("fij,fi->fj", slopes, towards) - u @ prior
        u = np.clip(u + np.linalg.solve(matrix, downhill[..., None])[..., 0], -_FARTHEST, _FARTHEST)
    return u, np.asarray(np.linalg.inv(matrix), np.float64)


def _terms(u: Array) -> Array:
    """Return the terms (F, 10) of a quadratic polynomial of u (F, 3)."""
    i, j = np.triu_indices(3)
    return np.column_stack([np.ones(len(u)), u, u[:, i] * u[:, j]])


def _slopes(u: Array) -> Array:
    """Return the derivatives (F, 10, 3) of the terms."""
    i, j = np.triu_indices(3)
    unit = np.eye(3)
    linear = np.broadcast_to(np.concatenate([np.zeros((1, 3)), unit]), (len(u), 4, 3))
    return np.concatenate([linear, u[:, i, None] * unit[j] + u[:, j, None] * unit[i]], axis=1)
