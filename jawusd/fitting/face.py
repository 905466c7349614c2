"""Learn a mapping from the ARKit jaw weights of a face capture to one subject's jaw, given a simultaneous jaw take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import FittingError
from jawusd.evaluator import JawRig
from jawusd.formats.arkit import ArkitMapping, FaceCapture, moved_terms, shares_of
from jawusd.geometry import transform_points

_REST_SHARE = 0.1  # fraction of the frames, nearest to the closed bite, from which the neutral weights are determined
_DEAD_ZONES = np.linspace(0.0, 0.12, 13)  # candidate dead zones of each weight
_ROUNDS = 2
COARSE_S, _FINE_S, _FINE_STEPS = 0.1, 0.01, 15  # offset search: coarse and fine step [s], number of fine steps per side
_BLOCKS = 5  # number of contiguous blocks in cross-validation
_LEAST_SECONDS = 10.0
_LEAST_REACH = 0.4  # minimum fraction of the subject's range that a take must reach in each direction
_LEAST_FOLLOWING = 0.7  # minimum correlation of JawOpen with the opening; takes of different performances stay below it
_DIRECTIONS = ("opening", "movement to the left", "movement to the right", "movement forward")


@dataclass(frozen=True)
class ArkitFit:
    """A learned mapping, and its cross-validation error."""

    mapping: ArkitMapping
    error_mm: float  # mean error of the incisal point on held-out parts
    shares_error_mm: float  # mean error if the weights are used as fixed fractions of the subject's ranges
    offset_s: float  # jaw time minus face time, each counted from its own first frame
    frames: int  # number of jaw frames from which the mapping was learned


def fit_arkit(rig: JawRig, face: FaceCapture, times_s: Array, d: Array, offset_s: float | None = None) -> ArkitFit:
    """Learn a mapping from a face capture and a jaw take of the same performance.

    Neutral weights are medians near the closed bite, gains and cross-talk follow from a least-squares fit, and dead
    zones from a coordinate search on the residual of that fit.

    Args:
        times_s: times of d [s] from an arbitrary start, shape (N,).
        d: jaw parameters [mm], NaN where unknown, shape (N, 3).
        offset_s: offset added to the times of the face capture, counted from its first row, to obtain the times of d;
            default: estimated by correlating the weights with opening and laterotrusion.

    Raises:
        FittingError: the takes overlap too little, some direction is not exercised, or fixed fractions of the ranges
            are as accurate as the mapping.
    """
    known = np.isfinite(d).all(axis=1)
    times_s, d = times_s[known], d[known]
    face_s = face.frames / face.fps
    if offset_s is None:
        first = _best_offset(face_s, face.weights, times_s, d)
        offset_s = refined_offset(first, face_s, face.weights, times_s, d)
    weights = columns_at(face_s + offset_s, face.weights, times_s)
    seen = np.isfinite(weights).all(axis=1)
    weights, d, times_s = weights[seen], d[seen], times_s[seen]
    _check_take(rig, weights, d, times_s)
    mapping = _learned(rig, weights, d)
    predicted = np.empty_like(d)
    for part in np.array_split(np.arange(len(d)), _BLOCKS):
        others = np.setdiff1d(np.arange(len(d)), part)
        predicted[part] = _learned(rig, weights[others], d[others]).d(weights[part])
    error = incisal_error(rig, predicted, d)
    shares_error = incisal_error(rig, rig.denormalized(shares_of(weights)), d)
    if error >= shares_error:
        raise FittingError(
            f"the mapping learned from this take has an error of {error:.2f} mm on held-out parts; fixed "
            f"fractions of the ranges have {shares_error:.2f} mm. It would not be an improvement.",
            hint="Check that both takes show the same performance, or use `animate --arkit` without a mapping.",
        )
    return ArkitFit(mapping, error, shares_error, offset_s, len(d))


def _learned(rig: JawRig, weights: Array, d: Array) -> ArkitMapping:
    near = np.argsort(np.linalg.norm(d, axis=1))[: max(int(_REST_SHARE * len(d)), 1)]
    neutral = np.median(weights[near], axis=0)
    dead = np.zeros(4)

    def solved(dead: Array) -> tuple[float, Array]:
        design = np.column_stack([np.ones(len(d)), moved_terms(weights, neutral, dead)])
        found = np.linalg.lstsq(design, d, rcond=1e-6)[0]
        return float(np.sum((design @ found - d) ** 2)), np.asarray(found, dtype=np.float64)

    for _ in range(_ROUNDS):
        for weight in range(4):
            tried = [np.where(np.arange(4) == weight, zone, dead) for zone in _DEAD_ZONES]
            dead = min(tried, key=lambda zones: solved(zones)[0])
    found = solved(dead)[1]
    return ArkitMapping.model_validate(
        {
            "actor": str(rig.meta.get("actor", "")),
            "neutral": tuple(neutral.tolist()),
            "dead_zone": tuple(dead.tolist()),
            "rest_mm": tuple(found[0].tolist()),
            "gain_mm": tuple(tuple(row) for row in found[1:5].T.tolist()),
            "opened_gain_mm": tuple(tuple(row) for row in found[5:].T.tolist()),
        }
    )


def columns_at(face_s: Array, weights: Array, times_s: Array) -> Array:
    """Interpolate columns (F, K) to times (N,), shape (N, K); NaN outside the capture and where no face was found."""
    return np.stack([np.interp(times_s, face_s, column, np.nan, np.nan) for column in weights.T], axis=1)


def offsets_between(face_s: Array, times_s: Array) -> Array:
    """Return the candidate clock offsets [s] at which a face capture and a jaw take overlap by at least half a take.

    Raises:
        FittingError: one of the takes is too short.
    """
    shorter = min(face_s[-1] - face_s[0], times_s[-1] - times_s[0]) if len(times_s) > 1 else 0.0
    if shorter < _LEAST_SECONDS:
        raise FittingError(
            f"the takes last {shorter:.1f} s; at least {_LEAST_SECONDS:g} s are needed to learn a mapping."
        )
    return np.arange(times_s[0] + shorter / 2 - face_s[-1], times_s[-1] - shorter / 2 - face_s[0], COARSE_S)


def _best_offset(face_s: Array, weights: Array, times_s: Array, d: Array) -> float:
    """Return the offset [s] at which the weights best correlate with opening and laterotrusion.

    The takes overlap by at least half a take. The opening alone would be ambiguous if the subject opens rhythmically.
    """
    tried = offsets_between(face_s, times_s)
    every = max(int(COARSE_S / np.median(np.diff(times_s))), 1)
    times_s, d = times_s[::every], d[::every]
    following = np.empty((len(tried), 2))
    for row, offset in enumerate(tried):
        shares = shares_of(columns_at(face_s + offset, weights, times_s))
        following[row] = [_correlation(shares[:, i], d[:, i]) for i in range(2)]
    best = int(np.argmax(following.sum(axis=1)))
    if following[best, 0] < _LEAST_FOLLOWING:
        raise FittingError(
            f"JawOpen does not correlate with the opening of the jaw at any clock offset; the best correlation is "
            f"{following[best, 0]:.2f}, but at least {_LEAST_FOLLOWING:g} is required.",
            hint="Use a face capture and a jaw take of the same performance, or set their offset with --offset.",
        )
    return float(tried[best])


def refined_offset(offset_s: float, face_s: Array, weights: Array, times_s: Array, d: Array) -> float:
    """Return the clock offset [s] near an initial one at which all columns (F, K) together predict d best."""
    tried = offset_s + _FINE_S * np.arange(-_FINE_STEPS, _FINE_STEPS + 1)
    left = []
    for offset in tried:
        seen = columns_at(face_s + offset, weights, times_s)
        rows = np.isfinite(seen).all(axis=1)
        design = np.column_stack([np.ones(rows.sum()), seen[rows]])
        found = np.linalg.lstsq(design, d[rows], rcond=1e-6)[0]
        left.append(float(np.mean((design @ found - d[rows]) ** 2)))
    best = int(np.argmin(left))
    if not 0 < best < len(tried) - 1:
        return float(tried[best])
    before, low, after = left[best - 1 : best + 2]  # refine by the vertex of the parabola through three values
    bend = before - 2 * low + after
    return float(tried[best] + (0.5 * _FINE_S * (before - after) / bend if bend > 0 else 0.0))


def _correlation(a: Array, b: Array) -> float:
    both = np.isfinite(a)
    if both.sum() < 3 or np.ptp(a[both]) == 0 or np.ptp(b[both]) == 0:
        return -1.0
    return float(np.corrcoef(a[both], b[both])[0, 1])


def _check_take(rig: JawRig, weights: Array, d: Array, times_s: Array) -> None:
    """Check that a take is long enough and contains motion in every direction."""
    step = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    if len(d) * step < _LEAST_SECONDS:
        raise FittingError(
            f"the face and jaw recordings overlap by {len(d) * step:.1f} s; at least {_LEAST_SECONDS:g} s are needed.",
            hint="Check frame rates and offset: --fps, --jaw-fps, --offset.",
        )
    low, high = rig.d_range.T
    reach = [d[:, 0].max() / high[0], d[:, 1].max() / high[1], d[:, 1].min() / low[1], d[:, 2].max() / high[2]]
    worst = int(np.argmin(reach))
    if reach[worst] < _LEAST_REACH:
        raise FittingError(
            f"the take covers {max(reach[worst], 0.0):.0%} of the range of {_DIRECTIONS[worst]}; "
            f"at least {_LEAST_REACH:.0%} is needed to learn the mapping.",
            hint="Record wide opening, both sides and forward, teeth together and apart, for half a minute.",
        )
    still = np.ptp(weights, axis=0) == 0
    if still.any():
        raise FittingError(f"the weight of {_DIRECTIONS[int(np.argmax(still))]} never changes.")


def incisal_error(rig: JawRig, found: Array, d: Array) -> float:
    """Return the mean distance [mm] of the incisal point between two sets of d (N, 3) [mm], clamped to the bound."""
    incisor = rig.landmarks[:1]
    positions = [transform_points(rig.pose(x), incisor) for x in (rig.project(found), d)]
    return float(np.linalg.norm(positions[0] - positions[1], axis=-1).mean())
