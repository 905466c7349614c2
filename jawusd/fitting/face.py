"""Faces in a performance: clocks of face captures and jaw takes, and jaw errors."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import FittingError
from jawusd.evaluator import JawRig
from jawusd.formats.arkit import shares_of
from jawusd.geometry import transform_points

COARSE_S, _FINE_S, _FINE_STEPS = 0.1, 0.01, 15  # offset search: coarse and fine step [s], number of fine steps per side
_LEAST_SECONDS = 10.0
_LEAST_REACH = 0.4  # minimum fraction of the subject's range that a take must reach in each direction
_DIRECTIONS = ("opening", "movement to the left", "movement to the right", "movement forward")


def columns_at(face_s: Array, weights: Array, times_s: Array) -> Array:
    """Interpolate columns (F, K) to times (N,), shape (N, K); NaN outside the capture and where no face was found."""
    return np.stack([np.interp(times_s, face_s, column, np.nan, np.nan) for column in weights.T], axis=1)


def offsets_between(face_s: Array, times_s: Array) -> Array:
    """Return clock offsets [s] at which two takes overlap by half of the shorter; raises FittingError if too short."""
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
        left.append(float(np.mean(unexplained(seen[rows], d[rows]) ** 2)))
    best = int(np.argmin(left))
    if not 0 < best < len(tried) - 1:
        return float(tried[best])
    before, low, after = left[best - 1 : best + 2]  # refine by the vertex of the parabola through three values
    bend = before - 2 * low + after
    return float(tried[best] + (0.5 * _FINE_S * (before - after) / bend if bend > 0 else 0.0))


def unexplained(columns: Array, d: Array) -> Array:
    """Return what a linear function of columns (N, K) leaves of d (N, n)."""
    design = np.column_stack([np.ones(len(columns)), columns])
    return d - design @ np.linalg.lstsq(design, d, rcond=1e-6)[0]


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
