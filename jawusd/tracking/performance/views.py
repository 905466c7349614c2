"""Views of a take: a compressed cache of views, and their dependence on unknown focal lengths."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import transform_points
from jawusd.tracking.contour.correspondences import without_smooth_errors
from jawusd.tracking.contour.samples import HABITS, LENGTH, NX, NY, U, V, X, Z
from jawusd.tracking.contour.solver import Matched
from jawusd.tracking.contour.views import View
from jawusd.tracking.initialization.magnification import displacement_slopes, principal_point

_FAST = 1  # zlib level: even the fastest level compresses masks to a fiftieth of their size

#: Prior standard deviation of the logarithm of a focal length that was guessed from the type of lens [-].
PRIOR_LOG_FOCAL = 0.1


class Views(Protocol):
    """Source of one view per camera for each frame number of the reference camera, such as `MaskViews`."""

    def at(self, frame: int) -> list[View]:
        """Return one view per camera."""
        ...


class KeptViews:
    """Cache of views: a take is processed repeatedly, and decoding and undistorting masks is slower than aligning."""

    def __init__(self, source: Views) -> None:
        self._source = source
        # views without masks, with the shape and the compressed bytes of their masks
        self._kept: dict[int, list[tuple[View, tuple[int, ...], bytes]]] = {}

    def at(self, frame: int) -> list[View]:
        """Return one view per camera."""
        if frame in self._kept:
            return [
                replace(view, masks=np.frombuffer(zlib.decompress(masks), np.uint8).reshape(shape))
                for view, shape, masks in self._kept[frame]
            ]
        views, nothing = self._source.at(frame), np.zeros((2, 0, 0), np.uint8)
        self._kept[frame] = [
            (replace(v, masks=nothing), v.masks.shape, zlib.compress(np.ascontiguousarray(v.masks).data, _FAST))
            for v in views
        ]
        return views


@dataclass(frozen=True, eq=False)
class Growth:
    """Sums like those of `OutlineSums`, for a sample's derivative g with respect to log focal length [px]."""

    twist: Array  # sum w J g, shape (2, C, 6)
    habit: Array  # sum w h g, shape (2, C, 3)
    own: Array  # sum w g^2, shape (2, C)
    distance: Array  # sum w g d, shape (2, C)


def growth_of(matched: Sequence[Matched], poses: Array, centres: Array, views: Sequence[View]) -> Growth:
    """Return the sums over samples matched at poses (2, 4, 4) of both arches, for twists about their centres (2, 3)."""
    count = len(views)
    out = Growth(np.zeros((2, count, 6)), np.zeros((2, count, 3)), np.zeros((2, count)), np.zeros((2, count)))
    for found in matched:
        r, c = found.arch, found.camera
        near = np.abs(found.distances) < found.gate_px  # samples with NaN distances count as not near
        samples, d = found.samples[near], found.distances[near]
        weight = (1.0 - (d / found.gate_px) ** 2) ** 2 * samples[:, LENGTH]
        growth = ((samples[:, [U, V]] - principal_point(views[c].matrix)) * samples[:, [NX, NY]]).sum(1)
        points = transform_points(views[c].T_delay[r] @ poses[r], samples[:, X : Z + 1])
        along = displacement_slopes(samples, points, views[c].matrix)
        slope = np.hstack([np.cross(points - centres[r], along), along])
        rest = growth
        if found.smooth is not None:
            pixels = np.maximum(samples[:, U : V + 1], 0.0)
            rest = without_smooth_errors(growth[:, None], weight, pixels, found.smooth)[:, 0]
        out.twist[r, c] = slope.T @ (weight * rest)
        out.habit[r, c] = samples[:, HABITS].T @ (weight * rest)
        out.own[r, c], out.distance[r, c] = weight @ (growth * rest), weight @ (rest * d)
    return out
