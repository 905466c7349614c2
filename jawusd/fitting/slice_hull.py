"""The default bound: for every opening a convex section of (laterotrusion, protrusion), in mm.

A tight alpha shape in three dimensions is hollow: captured border movements leave the inside of the envelope empty.
Sections of the envelope at one opening are close to convex, so the support function of the captured poses near that
opening, smoothed over the opening, encloses it with few numbers. It lies close around the captured poses, so that
whatever a slider reaches is anatomical; how much farther a measured pose may lie comes from frames left out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jawusd.evaluator.bounds import SliceHull
from jawusd.geometry.arrays import Array

DIRECTIONS = 16
KNOTS = 48
SOFTNESS_MM = 0.1

_PROTRUSION_STRETCH = 1.6  # directions are spread evenly after stretching protrusion, the shorter axis, by this
_WINDOW_MM = 3.5  # frames within this opening of a section shape it,
_FEWEST_IN_WINDOW = 12  # or this many nearest ones where there are fewer
_TAPER = 0.35  # reach lost, relative to the section's middle, by a frame at the edge of the window
_KERNEL_KNOTS = 1.0  # sd of the smoothing over the opening, in knots
_FOLDS, _BLOCK = 5, 50  # left-out blocks of about one exercise each [frames]
# The soft maximum of all half-spaces at once is SOFTNESS_MM * log(DIRECTIONS + 2) = 0.29 mm above the largest one: with
# less margin, a section without extent (a direction the data do not show) would contain nothing.
_MARGIN_MM = 0.38
_CONTACT_TOLERANCE_MM = 0.05  # how far below the captured openings the teeth may be said to close
_FRAMES_PER_SLIP = 400  # one frame in so many may close farther than the teeth allow, by noise
_SHORTEST_RANGE_MM = 1.0
_TOLERANCE_QUANTILE, _LARGEST_TOLERANCE_MM = 0.95, 1.0


def fit_slice_hull(d: Array) -> tuple[dict[str, Array], float]:
    """Build the bound of captured parameters.

    Args:
        d: parameters of the captured poses in the order of time [mm], shape (N, 3).

    Returns:
        The `slice_*` arrays of a model; and how far outside of it measured poses may lie [mm]: the 95 % quantile of
        frames left out, as other exercises go a little farther than those captured.
    """
    blocks = np.arange(len(d)) // min(_BLOCK, max(1, len(d) // _FOLDS)) % _FOLDS
    excess = [SliceHull.from_arrays(_hull(d[blocks != k])).excess(d[blocks == k]) for k in range(_FOLDS)]
    tolerance = np.quantile(np.concatenate(excess), _TOLERANCE_QUANTILE)
    return _hull(d), float(np.clip(tolerance, 0.0, _LARGEST_TOLERANCE_MM))


def valid_box(arrays: Mapping[str, Array]) -> Array:
    """Return the axis-parallel box of d that contains everything within a bound [mm], shape (3, 2).

    Args:
        arrays: the `slice_*` arrays; their directions include both senses of both axes.
    """
    reach, directions, d1 = arrays["slice_support"].max(0), arrays["slice_directions"], arrays["slice_d1"]
    ends = [sign * reach[np.argmax(sign * directions[:, axis])] for axis in (0, 1) for sign in (-1, 1)]
    box = np.array([[d1[0], d1[-1]], ends[:2], ends[2:]])
    return box + arrays["slice_margin_mm"] * np.array([-1.0, 1.0])


def _hull(d: Array) -> dict[str, Array]:
    """Return the arrays of the bound."""
    angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    directions = np.stack([np.cos(angle), np.sin(angle) * _PROTRUSION_STRETCH], axis=-1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # The margin widens closing too, which the teeth do not allow: take it back there.
    closed = float(np.sort(d[:, 0])[len(d) // _FRAMES_PER_SLIP])
    low, high = closed + _MARGIN_MM - _CONTACT_TOLERANCE_MM, float(d[:, 0].max())
    knots = np.linspace(low, max(high, low + _SHORTEST_RANGE_MM), KNOTS)
    reach = d[:, 1:] @ directions.T
    support = _smoothed(np.stack([_section(np.abs(d[:, 0] - knot) / _WINDOW_MM, reach) for knot in knots]))
    return {
        "slice_d1": knots,
        "slice_directions": directions,
        "slice_support": support,
        "slice_softness_mm": np.array(SOFTNESS_MM),
        "slice_margin_mm": np.array(_MARGIN_MM),
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
