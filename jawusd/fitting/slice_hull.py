"""The default bound: for every opening a convex section of (laterotrusion, protrusion), in mm.

A tight alpha shape in three dimensions is hollow: captured border movements leave the inside of the envelope empty.
Sections of the envelope at one opening are close to convex, so the support function of the captured poses near that
opening, smoothed over the opening, encloses it with few numbers; the margin comes from frames left out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from jawusd.evaluator.bounds import SliceHull

Array = NDArray[np.float64]

DIRECTIONS = 16
KNOTS = 48
SOFTNESS_MM = 0.1

_PROTRUSION_STRETCH = 1.6  # directions are spread evenly after stretching protrusion, the shorter axis, by this
_WINDOW_MM = 3.5  # frames within this opening of a section shape it,
_FEWEST_IN_WINDOW = 12  # or this many nearest ones where there are fewer
_TAPER = 0.35  # reach lost, relative to the section's middle, by a frame at the edge of the window
_KERNEL_KNOTS = 1.0  # sd of the smoothing over the opening, in knots
_FOLDS, _BLOCK = 5, 50  # left-out blocks of about one exercise each [frames]
_MARGIN_QUANTILE = 0.999
# The soft maximum of all half-spaces at once is SOFTNESS_MM * log(DIRECTIONS + 2) = 0.29 mm above the largest one: with
# less margin, a section without extent (a direction the data do not show) would contain nothing. Leaving an exercise
# out overstates how far the others' hull must be widened where nothing else reaches, hence the upper limit.
_MARGIN_LIMITS_MM = (0.35, 1.2)
_CONTACT_TOLERANCE_MM = 0.3  # how far below the captured openings the teeth may be said to close
_SHORTEST_RANGE_MM = 1.0
# Retrusion is free only once the teeth have parted, so margins are taken apart and blended between these openings.
_CLOSED_MM, _OPEN_MM = 3.0, 7.0
_FEWEST_IN_ZONE = 40
_TOLERANCE_QUANTILE, _LARGEST_TOLERANCE_MM = 0.95, 0.5


def fit_slice_hull(d: Array) -> tuple[dict[str, Array], float]:
    """Build the bound of captured parameters.

    Every side has a margin of its own, since some borders are hard and met by every exercise (retrusion, closing) and
    others are rarely reached: the 99.9 % quantile of how far left-out frames lie beyond that side of the hull of the
    others, kept within 0.35 and 1.2 mm.

    Args:
        d: parameters of the captured poses in the order of time [mm], shape (N, 3).

    Returns:
        The `slice_*` arrays of a model, whose supports hold what a side's margin has more than the common one; and how
        far outside measured poses may lie [mm]: the 95 % quantile of left-out frames.
    """
    blocks = np.arange(len(d)) // min(_BLOCK, max(1, len(d) // _FOLDS)) % _FOLDS
    left_out = [(d[blocks != k], d[blocks == k]) for k in range(_FOLDS)]
    beyond = np.concatenate([_beyond(_hull(seen), unseen) for seen, unseen in left_out])
    d1 = np.concatenate([unseen[:, 0] for _, unseen in left_out])
    margins = np.stack([_margin(beyond[d1 < _OPEN_MM], beyond), _margin(beyond[d1 > _CLOSED_MM], beyond)])
    excess = [SliceHull.from_arrays(_hull(seen, margins)).excess(unseen) for seen, unseen in left_out]
    tolerance = np.quantile(np.concatenate(excess), _TOLERANCE_QUANTILE)
    return _hull(d, margins), float(np.clip(tolerance, 0.0, _LARGEST_TOLERANCE_MM))


def valid_box(arrays: Mapping[str, Array]) -> Array:
    """Return the axis-parallel box of d that contains everything within a bound [mm], shape (3, 2).

    Args:
        arrays: the `slice_*` arrays; their directions include both senses of both axes.
    """
    reach, directions, d1 = arrays["slice_support"].max(0), arrays["slice_directions"], arrays["slice_d1"]
    ends = [sign * reach[np.argmax(sign * directions[:, axis])] for axis in (0, 1) for sign in (-1, 1)]
    box = np.array([[d1[0], d1[-1]], ends[:2], ends[2:]])
    return box + arrays["slice_margin_mm"] * np.array([-1.0, 1.0])


def _margin(beyond: Array, everywhere: Array) -> Array:
    """Return the margin of every side (K + 1,) from left-out frames of one zone, or of all if it has too few."""
    enough = beyond if len(beyond) >= _FEWEST_IN_ZONE else everywhere
    return np.clip(np.quantile(enough, _MARGIN_QUANTILE, axis=0), *_MARGIN_LIMITS_MM)


def _beyond(hull: dict[str, Array], d: Array) -> Array:
    """Return how far d (n, 3) lies beyond each direction's support and the largest opening [mm], shape (n, K + 1)."""
    supports = SliceHull.from_arrays(hull).supports.value(d[:, 0])
    return np.column_stack([d[:, 1:] @ hull["slice_directions"].T - supports, d[:, 0] - hull["slice_d1"][-1]])


def _hull(d: Array, margins: Array | None = None) -> dict[str, Array]:
    """Return the arrays of the bound, with margins of closed and open jaws (2, K + 1) or none."""
    angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    directions = np.stack([np.cos(angle), np.sin(angle) * _PROTRUSION_STRETCH], axis=-1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    low, high = float(d[:, 0].min()), float(d[:, 0].max())
    common = 0.0
    if margins is not None:
        common = _MARGIN_LIMITS_MM[0]
        # The common margin widens closing too, which the teeth do not allow: take it back there.
        low, high = low + common - _CONTACT_TOLERANCE_MM, high + margins[1, -1] - common
    knots = np.linspace(low, max(high, low + _SHORTEST_RANGE_MM), KNOTS)
    reach = d[:, 1:] @ directions.T
    support = _smoothed(np.stack([_section(np.abs(d[:, 0] - knot) / _WINDOW_MM, reach) for knot in knots]))
    if margins is not None:
        share = np.clip((knots - _CLOSED_MM) / (_OPEN_MM - _CLOSED_MM), 0.0, 1.0)[:, None]
        support += (1 - share) * margins[0, :-1] + share * margins[1, :-1] - common
    return {
        "slice_d1": knots,
        "slice_directions": directions,
        "slice_support": support,
        "slice_softness_mm": np.array(SOFTNESS_MM),
        "slice_margin_mm": np.array(common),
    }


def _section(distance: Array, reach: Array) -> Array:
    """Return the support values of one section.

    Args:
        distance: the frames' distance in opening, in windows, shape (N,).
        reach: the frames' reach along each direction [mm], shape (N, K).
    """
    order = np.argsort(distance, kind="stable")
    count = max(int((distance < 1.0).sum()), min(_FEWEST_IN_WINDOW, len(distance)))
    near = order[:count]
    far = np.minimum(distance[near], 1.0)[:, None]
    middle = np.median(reach[near], axis=0)
    return (middle + (reach[near] - middle) * (1 - _TAPER * far**2)).max(0)


def _smoothed(support: Array) -> Array:
    half = int(np.ceil(3 * _KERNEL_KNOTS))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / _KERNEL_KNOTS) ** 2)
    padded = np.pad(support, ((half, half), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, kernel / kernel.sum(), mode="valid") for column in padded.T], axis=-1)
