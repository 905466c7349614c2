"""Skin points of a shot in the frame of the head, which points that follow the head show where no teeth are visible."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FittingError
from jawusd.geometry import rigid_fit, se3_inverse, transform_points

_LEAST_SHARE = 0.4  # fraction of the frames in which a point must be found to be used
_FIXED_MM = 0.6  # largest typical distance of a point that follows the head from its mean place on it
_LEAST_FIXED, _LEAST_MOVING = 8, 12  # numbers of points
_LEAST_SPREAD_MM = 6.0  # smallest extent of the points that follow the head in their second direction
_ROUNDS, _OUTLIER = 4, 2.5  # reweighting of points in a frame: rounds, and a robust sigma beyond which they count less
_COMPONENTS = 12  # of the skin by which missing points are filled


def in_head(points: Array, T_world_head: Array, seen: Mask) -> Array:
    """Return the points that move on the head, relative to it.

    Args:
        points: points on the skin in the world [mm], NaN where they are not found, shape (F, N, 3).
        T_world_head: poses of the head, right in the frames in which the teeth are visible, shape (F, 4, 4).
        seen: those frames, shape (F,).

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
            "Film sharp and closer, and without glare.",
        )
    if count < _LEAST_FIXED or spread < _LEAST_SPREAD_MM:
        raise FittingError(
            f"{count} points on the skin follow the head, over {spread:.0f} mm; at least {_LEAST_FIXED} over "
            f"{_LEAST_SPREAD_MM:g} mm are needed to know the head where the teeth are hidden.",
            hint="Film nose and cheeks too, or paint dots on them.",
        )


def _pose(rest: Array, found: Array) -> Array:
    """Return the robust pose (4, 4) that moves points (N, 3) to those found (N, 3), NaN if too few are found."""
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
    """Fill points that are missing in some frames, by the components of skin motion; few points leave a frame NaN."""
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
