"""Faces in a performance: clocks of face captures and jaw takes, skin points in the frame of the head, and jaw errors.

The pose of the head is estimated from points that follow the head, which are visible even if the teeth are not.
"""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FittingError
from jawusd.evaluator import JawRig
from jawusd.formats.arkit import shares_of
from jawusd.geometry import rigid_fit, se3_inverse, transform_points

_LEAST_SHARE = 0.4  # minimum fraction of the frames in which a point is found
_FIXED_MM = 0.6  # maximum typical distance of a point that follows the head from its mean position
_LEAST_FIXED, _LEAST_MOVING = 8, 12  # minimum numbers of points that follow the head, and of other points
_LEAST_SPREAD_MM = 6.0  # minimum extent of the points that follow the head along their second principal axis
_ROUNDS, _OUTLIER = 4, 2.5  # rounds of reweighting points, and robust sigma beyond which they count less
_COMPONENTS = 12  # number of components of skin motion used to fill in missing points


def in_head(points: Array, T_world_head: Array, seen: Mask) -> Array:
    """Return the points that move relative to the head, in the skull frame.

    Args:
        points: points on the skin in the world [mm], NaN where they are not found, shape (F, N, 3).
        T_world_head: poses of the head, correct where the teeth are visible, shape (F, 4, 4).
        seen: frames in which the teeth are visible, shape (F,).

    Returns:
        Points (F, M, 3) [mm] in the skull frame; NaN in frames in which too few points are found.

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
    _check(rest, fixed)
    T = np.stack([_pose(rest[fixed], frame[fixed]) for frame in points])
    moving = transform_points(se3_inverse(T), points[:, ~fixed])
    return _completed(moving)


def _check(rest: Array, fixed: Mask) -> None:
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


def _pose(rest: Array, found: Array) -> Array:
    """Return the robust pose (4, 4) that moves points (N, 3) to the points found (N, 3), NaN if too few are found."""
    known = np.isfinite(found[:, 0])
    T = np.full((4, 4), np.nan)
    if known.sum() < _LEAST_FIXED / 2:
        return T
    weights = np.ones(int(known.sum()))
    for _ in range(_ROUNDS):
        T = rigid_fit(rest[known], found[known], weights)
        off = np.linalg.norm(transform_points(T, rest[known]) - found[known], axis=1)
        weights = 1.0 / (1.0 + (off / (_OUTLIER * max(float(np.median(off)), 1e-6))) ** 2)
    return T


def _completed(X: Array) -> Array:
    """Fill in missing points using the components of skin motion; frames with too few points are NaN."""
    flat = X.reshape(len(X), -1)
    known = np.isfinite(flat)
    usable = known.mean(axis=1) >= 0.5
    filled = np.where(known, flat, np.nanmean(flat[usable], axis=0))
    for _ in range(30):
        mean = filled[usable].mean(axis=0)
        U, s, Vt = np.linalg.svd(filled[usable] - mean, full_matrices=False)
        low = mean + (U[:, :_COMPONENTS] * s[:_COMPONENTS]) @ Vt[:_COMPONENTS]
        filled[usable] = np.where(known[usable], flat[usable], low)
    filled[~usable] = np.nan
    return filled.reshape(X.shape)


COARSE_S, _FINE_S, _FINE_STEPS = 0.1, 0.01, 15  # offset search: coarse and fine step [s], number of fine steps per side
_LEAST_SECONDS = 10.0
_LEAST_REACH = 0.4  # minimum fraction of the subject's range that a take must reach in each direction
_DIRECTIONS = ("opening", "movement to the left", "movement to the right", "movement forward")


def columns_at(face_s: Array, weights: Array, times_s: Array) -> Array:
    """Interpolate columns (F, K) to times (N,), shape (N, K); NaN outside the capture and where no face was found."""
    return np.stack([np.interp(times_s, face_s, column, np.nan, np.nan) for column in weights.T], axis=1)


def offsets_between(face_s: Array, times_s: Array) -> Array:
    """Return the candidate clock offsets [s] at which face capture and jaw take overlap by half of the shorter one.

    Raises:
        FittingError: a take is too short.
    """
    shorter = min(face_s[-1] - face_s[0], times_s[-1] - times_s[0]) if len(times_s) > 1 else 0.0
    if shorter < _LEAST_SECONDS:
        raise FittingError(
            f"the shorter of the two takes lasts {shorter:.1f} s; at least {_LEAST_SECONDS:g} s are needed to learn a "
            "mapping."
        )
    return np.arange(times_s[0] + shorter / 2 - face_s[-1], times_s[-1] - shorter / 2 - face_s[0], COARSE_S)


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


def incisal_error(rig: JawRig, found: Array, d: Array) -> float:
    """Return the mean distance [mm] of the incisal point between two sets of d (N, 3) [mm], clamped to the bound."""
    incisor = rig.landmarks[:1]
    positions = [transform_points(rig.pose(x), incisor) for x in (rig.project(found), d)]
    return float(np.linalg.norm(positions[0] - positions[1], axis=-1).mean())


def check_jaw_weights(rig: JawRig, weights: Array, d: Array, error_mm: float) -> None:
    """Check that a take exercises every direction, and that learning from its weights improves on fixed fractions.

    Args:
        weights: the four ARKit jaw weights, NaN without a face, shape (N, 4).
        d: jaw parameters of the same frames [mm], shape (N, 3).
        error_mm: held-out error of the learned jaw at the incisal point.

    Raises:
        FittingError: a direction is not exercised, a weight is constant, or fixed fractions of the ranges are as
            accurate as the learned jaw.
    """
    rows = np.isfinite(weights).all(axis=1)
    weights, d = weights[rows], d[rows]
    low, high = rig.d_range.T
    reach = [d[:, 0].max() / high[0], d[:, 1].max() / high[1], d[:, 1].min() / low[1], d[:, 2].max() / high[2]]
    worst = int(np.argmin(reach))
    if reach[worst] < _LEAST_REACH:
        raise FittingError(
            f"the take covers {max(reach[worst], 0.0):.0%} of the range of {_DIRECTIONS[worst]}; "
            f"{_LEAST_REACH:.0%} is needed to learn from jaw weights.",
            hint="Record wide opening, both sides and forward, teeth together and apart, for half a minute.",
        )
    constant = np.ptp(weights, axis=0) == 0
    if constant.any():
        raise FittingError(f"the weight of {_DIRECTIONS[int(np.argmax(constant))]} never changes.")
    shares_mm = incisal_error(rig, rig.denormalized(shares_of(weights)), d)
    if error_mm >= shares_mm:
        raise FittingError(
            f"the jaw learned from this take has an error of {error_mm:.2f} mm on held-out frames; fixed fractions of "
            f"the ranges have {shares_mm:.2f} mm. It would not be an improvement.",
            hint="Check that both takes show the same performance, or use `animate --arkit` without a mapping.",
        )
