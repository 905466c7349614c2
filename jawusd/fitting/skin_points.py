"""Points on the skin in the frame of the head.

The pose of the head is estimated from points that follow the head, which are visible even if the teeth are not.
"""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FittingError
from jawusd.geometry import rigid_fit, se3_inverse, transform_points

_LEAST_SHARE = 0.4  # minimum fraction of the frames in which a point is found
_FIXED_MM = 0.6  # maximum typical distance of a point that follows the head from its mean position
_LEAST_FIXED, LEAST_MOVING = 8, 12  # minimum numbers of points that follow the head, and of other points
_LEAST_SPREAD_MM = 6.0  # minimum extent of the points that follow the head along their second principal axis
_ROUNDS, _OUTLIER = 4, 2.5  # rounds of reweighting points, and robust sigma beyond which they count less


def in_head(points: Array, T_world_head: Array, seen: Mask) -> Array:
    """Return the points in the skull frame.

    Args:
        points: points on the skin in the world [mm], NaN where they are not found, shape (F, N, 3).
        T_world_head: poses of the head, correct where the teeth are visible, shape (F, 4, 4).
        seen: frames in which the teeth are visible, shape (F,).

    Returns:
        Points (F, M, 3) [mm] in the skull frame; NaN where they or too few points on the head are found.

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
    T[seen] = T_world_head[seen]
    return transform_points(se3_inverse(T), points)


def _check(rest: Array, fixed: Mask) -> None:
    count, moving = int(fixed.sum()), int((~fixed).sum())
    spread = 0.0
    if count >= 3:
        centred = rest[fixed] - rest[fixed].mean(axis=0)
        spread = 2 * float(np.linalg.svd(centred, compute_uv=False)[1]) / np.sqrt(count)
    if moving < LEAST_MOVING:
        raise FittingError(
            f"{moving} points on the skin of chin and lower face can be followed through the shot; at least "
            f"{LEAST_MOVING} are needed.",
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
