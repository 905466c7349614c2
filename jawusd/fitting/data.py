"""Training data: captured poses as motions away from the closed bite, in the anatomical frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.base.errors import FittingError
from jawusd.evaluator.models import JawModelForm
from jawusd.evaluator.motions import motions_of_poses, poses_of_motions
from jawusd.fitting.metric import MandibleMetric
from jawusd.formats.tracks import LOST, Tracks
from jawusd.geometry import LANDMARKS, hat, orthonormalise, rigidity_defect, so3_log, transform_points

#: Tracks, or frame numbers (F,) and poses T_skull_mandible (F, 4, 4), which are NaN where unknown.
Source = Tracks | tuple[ArrayLike, ArrayLike]

#: Names of the parameters d1, d2 and d3.
PARAMETERS = ("opening", "laterotrusion", "protrusion")
#: Typical deviation of real jaws from a three-parameter model [mm]; smaller tracking errors hardly matter.
MODEL_SIGMA_MM = 0.3
_LARGEST_SIGMA_MM = 2.0  # maximum standard deviation of a pose [mm rms over the mandible]; other poses are discarded
_RIGID = 1e-3
_FEWEST_POSES = 15
_SMALLEST_MOTION_MM = 1.0  # minimum 95 % quantile of the mandible's rms displacement from the first pose [mm]

_FEWEST = 60  # minimum number of poses for outlier screening
_TRIALS, _SAMPLE = 300, 15  # numbers of random samples and of their poses; each output component has ten unknowns
_CONSENSUS = 0.75  # minimum fraction of the poses that must agree with the quadratic map
_REFITS = 3
# Outlier thresholds: relative to the majority's spread, and absolute [mm, rms over the mandible]. A real jaw deviates
# from the quadratic map by one or two millimetres; the models themselves trim smaller failures.
_TIMES, _FLOOR_MM = 8.0, 6.0
REASON = "far from the other poses' smooth motion"


@dataclass(frozen=True)
class SubjectAnatomy:
    """Landmarks and measured points of a subject's jaw, and the coordinate frames of its poses."""

    T_anatomical_skull: Array  # skull (scan) frame to anatomical frame, shape (4, 4)
    landmarks: Array  # `geometry.LANDMARKS` in mandible coordinates [mm], shape (5, 3)
    mandible_vertices: Array  # points whose motion is measured, mandible coordinates [mm], shape (V, 3)
    T_rest: Array  # T_skull_mandible of the closed bite, shape (4, 4)

    @classmethod
    def of(
        cls,
        T_anatomical_skull: ArrayLike,
        landmarks: ArrayLike,
        mandible_vertices: ArrayLike | None,
        T_rest: ArrayLike | None,
    ) -> SubjectAnatomy:
        """Check the arrays or raise ValueError; default: points are the landmarks, the closed bite is the identity."""
        landmarks = _array(landmarks, (len(LANDMARKS), 3), "landmarks")
        vertices = landmarks if mandible_vertices is None else mandible_vertices
        return cls(
            _array(T_anatomical_skull, (4, 4), "T_anatomical_skull"),
            landmarks,
            _array(vertices, (None, 3), "mandible_vertices"),
            np.eye(4) if T_rest is None else _array(T_rest, (4, 4), "T_rest"),
        )

    def at_rest(self, points: Array) -> Array:
        """Return mandible points (N, 3) in the closed bite, anatomical coordinates [mm]."""
        return transform_points(self.T_anatomical_skull @ self.T_rest, points)

    def motion(self, T_skull_mandible: Array) -> Array:
        """Convert poses to motions away from the closed bite in the anatomical frame; both have shape (..., 4, 4)."""
        return motions_of_poses(T_skull_mandible, self.T_anatomical_skull, self.T_rest)

    def poses(self, motion: Array) -> Array:
        """Convert motions to poses T_skull_mandible; both have shape (..., 4, 4)."""
        return poses_of_motions(motion, self.T_anatomical_skull, self.T_rest)


@dataclass(frozen=True)
class TrainingData:
    """Captured poses to which a model is fitted."""

    frames: NDArray[np.int64]
    motion: Array  # motions away from the closed bite, anatomical frame, shape (N, 4, 4)
    weights: Array  # weight of each pose, 0 .. 1, shape (N,)
    incisor: Array  # lower incisal point in the closed bite, anatomical frame [mm], shape (3,)
    landmarks: Array  # all landmarks in the closed bite, anatomical frame [mm], shape (5, 3)
    metric: MandibleMetric  # metric of pose differences, in the anatomical frame

    def __len__(self) -> int:
        return len(self.frames)

    def displacement(self) -> Array:
        """Return the displacement of the incisal point of every frame [mm], shape (N, 3)."""
        return displacement(self.motion, self.incisor)

    def select(self, rows: Mask) -> TrainingData:
        """Return the training data of the selected frames."""
        return replace(self, frames=self.frames[rows], motion=self.motion[rows], weights=self.weights[rows])


@dataclass(frozen=True)
class Selection:
    """Captured poses (F, 4, 4) with their frame numbers (F,), and the training data selected from them."""

    frames: NDArray[np.int64]
    T_skull_mandible: Array
    data: TrainingData
    used: Mask  # mask of the captured frames that the data contain, shape (F,)
    excluded: dict[str, list[int]]  # excluded frame numbers, by reason


def ranges_of(d: Array) -> dict[str, list[float]]:
    """Return the smallest and the largest value [mm] of each parameter by name, over d (N, 3)."""
    return dict(zip(PARAMETERS, np.stack([d.min(axis=0), d.max(axis=0)], axis=1).tolist(), strict=True))


def displacement(motion: Array, point: Array) -> Array:
    """Return the displacements (N, 3) [mm] of a point (3,) under motions (N, 4, 4)."""
    return motion[:, :3, :3] @ point + motion[:, :3, 3] - point


def select(source: Source, anatomy: SubjectAnatomy) -> Selection:
    """Select the frames of a source that can train a model, using `select_tracks` or `select_poses`."""
    return select_tracks(source, anatomy) if isinstance(source, Tracks) else select_poses(*source, anatomy)


def select_tracks(tracks: Tracks, anatomy: SubjectAnatomy) -> Selection:
    """Select the frames of a take that can train a model: those measured without a prior and with a small covariance.

    Raises:
        FittingError: there are too few frames, or there is no motion.
    """
    T = tracks.raw_T_upper_lower
    finite = np.all(np.isfinite(T), axis=(1, 2))
    sigma = np.full(len(T), np.nan)
    sigma[finite] = _mandible_sigma(T[finite], tracks.covariance_relative[finite], anatomy)
    known = sigma[np.isfinite(sigma)]
    sigma = np.where(np.isfinite(sigma), sigma, np.median(known) if known.size else 0.0)
    reasons = {
        "lost": np.any(tracks.status == LOST, axis=1),
        "prior aided": tracks.prior_aided,
        f"uncertain (sd over the mandible above {_LARGEST_SIGMA_MM} mm)": sigma > _LARGEST_SIGMA_MM,
    }
    weights = MODEL_SIGMA_MM**2 / (MODEL_SIGMA_MM**2 + sigma**2)
    return _select(tracks.frames, T, weights, reasons, anatomy)


def select_poses(frames: ArrayLike, T_skull_mandible: ArrayLike, anatomy: SubjectAnatomy) -> Selection:
    """Select the poses (F, 4, 4) of frames (F,) that can train a model; poses with NaN count as lost.

    Raises:
        ValueError: an array has a wrong shape.
        FittingError: there are too few frames, there is no motion, or a pose is not rigid.
    """
    T = np.asarray(T_skull_mandible, dtype=np.float64)
    frames = np.asarray(frames, dtype=np.int64)
    if T.shape != (len(frames), 4, 4):
        raise ValueError(f"poses must have shape ({len(frames)}, 4, 4), got {T.shape}")
    return _select(frames, T, np.ones(len(T)), {}, anatomy)


def _array(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    array = np.asarray(value, dtype=np.float64)
    fits = array.ndim == len(shape) and all(want in (None, have) for want, have in zip(shape, array.shape, strict=True))
    if not fits or not np.isfinite(array).all():
        wanted = ", ".join("N" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} must be finite and of shape ({wanted}), got {array.shape}")
    return array


def _select(
    frames: NDArray[np.int64], T: Array, weights: Array, reasons: dict[str, Mask], anatomy: SubjectAnatomy
) -> Selection:
    used = np.ones(len(frames), dtype=bool)
    excluded: dict[str, list[int]] = {}

    def exclude(reason: str, mask: Mask) -> None:
        out = used & mask
        if out.any():
            excluded[reason] = frames[out].tolist()
            used[out] = False

    exclude("no pose", np.any(~np.isfinite(T), axis=(1, 2)))
    for reason, mask in reasons.items():
        exclude(reason, mask)
    exclude("frame number repeated", _repeats(frames[:, None], used))
    exclude("same pose as an earlier frame", _repeats(T.reshape(len(T), 16), used))
    _check(frames[used], T[used])
    landmarks = anatomy.at_rest(anatomy.landmarks)
    data = TrainingData(
        frames=frames[used],
        motion=anatomy.motion(orthonormalise(T[used])),
        weights=weights[used],
        incisor=landmarks[0],
        landmarks=landmarks,
        metric=MandibleMetric.of_points(anatomy.at_rest(anatomy.mandible_vertices)),
    )
    _check_motion(data)
    return Selection(frames, T, data, used, excluded)


def _repeats(rows: NDArray[np.int64] | Array, used: Mask) -> Mask:
    """Return a mask of the used rows that repeat an earlier used row, shape (F,)."""
    index = np.flatnonzero(used)
    repeats = np.zeros(len(rows), dtype=bool)
    if index.size:
        _, first = np.unique(rows[index], axis=0, return_index=True)
        repeats[np.delete(index, first)] = True
    return repeats


def _check(frames: NDArray[np.int64], T: Array) -> None:
    if len(frames) < _FEWEST_POSES:
        raise FittingError(
            f"{len(frames)} poses are usable; at least {_FEWEST_POSES} are needed.",
            hint="Capture opening, lateral and protrusive movements, about 30 s in all.",
        )
    defect = rigidity_defect(T)
    if defect.max() > _RIGID:
        worst = int(defect.argmax())
        raise FittingError(
            f"the pose of frame {frames[worst]} is not rigid (deviation {defect[worst]:.2g}; at most {_RIGID:g} is "
            "allowed).",
            hint="Poses must be 4x4 rotation and translation without scale or mirroring.",
        )


def _check_motion(data: TrainingData) -> None:
    moved = float(np.percentile(data.metric.rms(data.motion, data.motion[:1]), 95))
    if moved < _SMALLEST_MOTION_MM:
        raise FittingError(
            f"the poses hardly differ: the mandible moves by {moved:.2g} mm; at least {_SMALLEST_MOTION_MM:g} mm are "
            "needed.",
            hint="If the jaw did move, check that the translations are in mm.",
        )


def _mandible_sigma(T: Array, covariance: Array, anatomy: SubjectAnatomy) -> Array:
    """Return the rms standard deviation of the position of mandible points [mm], shape (F,).

    The covariance Sigma is that of the twist xi in T_true = exp(xi) T, skull frame, about the skull origin. A point y
    moves by omega x y + v, so its variance is the trace of J Sigma J^T with J = [-hat(y), I]; the result averages the
    variance over the points.
    """
    points = anatomy.mandible_vertices
    mean, spread = points.mean(0), np.cov(points.T, bias=True)
    R = T[:, :3, :3]
    y = R @ mean + T[:, :3, 3]
    second = R @ spread @ np.swapaxes(R, 1, 2) + y[:, :, None] * y[:, None, :]
    M = np.zeros((len(T), 6, 6))
    M[:, :3, :3] = np.einsum("nii->n", second)[:, None, None] * np.eye(3) - second
    M[:, :3, 3:], M[:, 3:, :3], M[:, 3:, 3:] = hat(y), -hat(y), np.eye(3)
    return np.sqrt(np.maximum(np.einsum("nij,nji->n", M, covariance), 0.0))


@dataclass(frozen=True, eq=False)
class FittedForm:
    """A fitted decoder: the result of every fitting method."""

    model: JawModelForm
    kept: Mask  # mask of the training frames that were not trimmed as outliers, shape (N,)
    notes: dict[str, object]  # JSON-serialisable results of the fit, for the header of the model file


def screened(selection: Selection) -> Selection:
    """Return the selection without gross outliers: isolated tracking failures of centimetres.

    A spline would interpolate them. A quadratic map from the incisal displacement to the rotation, fitted by random
    sample consensus (Fischler & Bolles 1981), follows the majority, and the residual of an outlier is its error.
    """
    outliers = gross_outliers(selection.data)
    if not outliers.any():
        return selection
    used = selection.used.copy()
    used[np.flatnonzero(used)[outliers]] = False
    excluded = {**selection.excluded, REASON: selection.data.frames[outliers].tolist()}
    return replace(selection, data=selection.data.select(~outliers), used=used, excluded=excluded)


def gross_outliers(data: TrainingData) -> Mask:
    """Return a mask (N,) of poses centimetres off the majority's quadratic map; all false for fewer than 60 poses."""
    count = len(data)
    if count < _FEWEST:
        return np.zeros(count, dtype=bool)
    columns = _quadratic(data.displacement())
    # |values|^2 is the mean squared displacement of the mandible due to the rotation about the incisal point [mm^2].
    values = so3_log(data.motion[:, :3, :3]) @ np.linalg.cholesky(data.metric.about(data.incisor))
    rng = np.random.default_rng(0)
    agreeing, best = np.ones(count, dtype=bool), np.inf
    for _ in range(_TRIALS):
        sample = rng.choice(count, _SAMPLE, replace=False)
        residual = _residual(columns, values, sample)
        spread = np.quantile(residual, _CONSENSUS)
        if spread < best:
            agreeing, best = residual <= 3 * spread, spread
    for _ in range(_REFITS):
        residual = _residual(columns, values, agreeing)
        spread = np.quantile(residual, _CONSENSUS)
        agreeing = residual <= 3 * spread
    return residual > max(_TIMES * spread, _FLOOR_MM)


def _quadratic(u: Array) -> Array:
    """Return the ten monomials up to degree two of normalised displacements (N, 3), shape (N, 10)."""
    x = (u - np.median(u, axis=0)) / np.maximum(np.percentile(np.abs(u), 75, axis=0), 1.0)
    pairs = [x[:, i] * x[:, j] for i in range(3) for j in range(i, 3)]
    return np.column_stack([np.ones(len(x)), x, *pairs])


def _residual(columns: Array, values: Array, rows: Indices | Mask) -> Array:
    """Return the residuals (N,) of a least-squares fit to a subset of the rows."""
    solution = np.linalg.lstsq(columns[rows], values[rows], rcond=1e-8)[0]
    return np.linalg.norm(values - columns @ solution, axis=1)
