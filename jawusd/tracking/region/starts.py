"""Where to look for teeth that moved faster than expected, or were out of sight."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import se3_exp, transform_points
from jawusd.tracking.contour.equations import translation
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.contour.views import View
from jawusd.tracking.region.condyles import CondyleMotion
from jawusd.tracking.region.view import RegionView

_POINTS = 400  # of a scan, in the colours of which a start is judged
# Turns of the jaw tried, of opening and to the side [degrees].
_OPENED, _ASIDE = (-6.0, -4.5, -3.0, -1.5, 1.5, 3.0, 4.5, 6.0), (-4.0, -2.0, 2.0, 4.0)
# Places of the incisal point: to the left, down, and before where opening takes it [mm]. Contours are caught from some
# 1.7 mm. A jaw that goes aside turns about the condyle on that side, half as far beside the middle as behind the teeth.
_DOWN = np.arange(0.0, 46.0, 2.5).tolist()
_LEFT = (-12.0, -9.0, -6.0, -3.0, 3.0, 6.0, 9.0, 12.0)
_PLACES_MM = [
    *((0.0, down, 0.0) for down in _DOWN),
    *((left, down, 0.5 * abs(left)) for left in _LEFT for down in (0.0, 2.5, 5.0, 8.0)),
    *((0.0, down, forward) for down in (2.0, 4.5, 7.0) for forward in (3.5, 7.0)),
]
# Shifts of the head: to the left, up and forwards [mm].
_NEAR_MM, _FAR_MM = (-3.0, 0.0, 3.0), (-6.0, 6.0)
_SHIFTS_MM = [
    *((left, up, front) for left in _NEAR_MM for up in _NEAR_MM for front in _NEAR_MM),
    *((far, 0.0, 0.0) for far in _FAR_MM),
    *((0.0, far, 0.0) for far in _FAR_MM),
]


def head_shifts(T_world_head: Array, axes: Array) -> Array:
    """Return motions of the head in the world, shape (N, 4, 4); `axes` rotate from scan to left, up, front (3, 3)."""
    to_world = T_world_head[:3, :3] @ axes.T
    return np.stack([translation(to_world @ shift) for shift in np.array(_SHIFTS_MM)])


def turned_starts(condyles: CondyleMotion, bases: Sequence[Array]) -> list[Array]:
    """Return poses T_upper_lower (4, 4) near each of some, turned about the condyles."""
    hinge, axes = condyles.hinge, condyles.axes
    turns = [np.deg2rad(a) * axes[0] for a in _OPENED] + [np.deg2rad(a) * axes[1] for a in _ASIDE]
    about = [translation(hinge) @ se3_exp(np.append(turn, np.zeros(3))) @ translation(-hinge) for turn in turns]
    return [base @ turn for turn in about for base in bases]


def starts_everywhere(condyles: CondyleMotion) -> list[Array]:
    """Return poses T_upper_lower (4, 4) all over what jaws do."""
    return [condyles.placed(*place) for place in _PLACES_MM]


def likeliest(
    places: Sequence[Array], views: Sequence[View], scans: Sequence[Scan], arch: int, taken: Sequence[Mask] = ()
) -> list[int]:
    """Return the order of poses T_world_arch (4, 4) by how much the pixels under their crowns look like teeth.

    Args:
        places, views, scans, arch: the poses, and what they are judged by.
        taken: by view, pixels (h, w) that show the other arch and count for nothing; empty if that is not known.
    """
    points = scans[arch].crown_vertices(_POINTS)
    worth = np.zeros(len(places))
    for c, view in enumerate(views):
        if not isinstance(view.edges, RegionView):
            continue
        like = view.edges.likeness(arch)
        if taken:
            like = np.where(taken[c], 0.0, like)
        for k, pose in enumerate(places):
            h = transform_points(pose, points) @ view.matrix[:, :3].T + view.matrix[:, 3]
            x, y = np.rint(h[:, :2] / h[:, 2:]).astype(int).T
            inside = (x >= 0) & (y >= 0) & (x < like.shape[1]) & (y < like.shape[0])
            worth[k] += float(like[y[inside], x[inside]].sum())
    return [int(k) for k in np.argsort(-worth, kind="stable")]
