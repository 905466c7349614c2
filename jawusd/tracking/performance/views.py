"""Views of a take: a compressed cache of views, and their dependence on unknown focal lengths."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import transform_points
from jawusd.tracking.contour.samples import HABITS, LENGTH, NX, NY, U, V, X, Z
from jawusd.tracking.contour.solver import Matched
from jawusd.tracking.contour.views import View

_FAST = 1  # zlib level: even the fastest level compresses masks to a fiftieth of their size

#: Prior standard deviation of the logarithm of a focal length that was guessed from the type of lens [-].
PRIOR_LOG_FOCAL = 0.1


class Views(Protocol):
    """Source of one view per camera for each frame number of the reference camera, such as `MaskViews`."""

    def at(self, frame: int) -> list[View]:
        """Return one view per camera."""
        ...


@dataclass(frozen=True, eq=False)
class _Kept:
    """A view with compressed masks."""

    view: View
    shape: tuple[int, ...]
    masks: bytes

    @classmethod
    def of(cls, view: View) -> _Kept:
        packed = zlib.compress(np.ascontiguousarray(view.masks).data, _FAST)
        return cls(replace(view, masks=np.zeros((2, 0, 0), np.uint8)), view.masks.shape, packed)

    def unpacked(self) -> View:
        masks = np.frombuffer(zlib.decompress(self.masks), np.uint8).reshape(self.shape)
        return replace(self.view, masks=masks)


class KeptViews:
    """Cache of views: a take is processed repeatedly, and decoding and undistorting masks is slower than aligning."""

    def __init__(self, source: Views) -> None:
        self._source = source
        self._kept: dict[int, Sequence[_Kept]] = {}

    def at(self, frame: int) -> list[View]:
        """Return one view per camera."""
        if frame not in self._kept:
            views = self._source.at(frame)
            self._kept[frame] = [_Kept.of(view) for view in views]
            return views
        return [kept.unpacked() for kept in self._kept[frame]]


@dataclass(frozen=True, eq=False)
class Growth:
    """Sums like those of `OutlineSums`, for a sample's derivative g with respect to log focal length [px].

    The vector h is the derivative of a sample's outline shift with respect to the components of annotator bias.

    Attributes:
        twist: sum w J g, shape (2, C, 6).
        habit: sum w h g, shape (2, C, 3).
        own, distance: sum w g^2 and sum w g d, shape (2, C).
    """

    twist: Array
    habit: Array
    own: Array
    distance: Array


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
        slope = _slopes(samples, views[c].T_delay[r] @ poses[r], views[c].matrix, centres[r])
        out.twist[r, c] = slope.T @ (weight * growth)
        out.habit[r, c] = samples[:, HABITS].T @ (weight * growth)
        out.own[r, c], out.distance[r, c] = weight @ growth**2, weight @ (growth * d)
    return out


def _slopes(samples: Array, pose: Array, matrix: Array, centre: Array) -> Array:
    """Return derivatives (n, 6) of normal displacements [px] with respect to a left twist about a world point."""
    points = transform_points(pose, samples[:, X : Z + 1])
    depth = points @ matrix[2, :3] + matrix[2, 3]
    across = matrix[:2, :3] - samples[:, [U, V], None] * matrix[2, :3]
    along = np.einsum("nk,nkj->nj", samples[:, [NX, NY]], across) / depth[:, None]
    return np.hstack([np.cross(points - centre, along), along])


def with_focal(view: View, log_factor: float) -> View:
    """Return a view with its focal length scaled by exp(log_factor)."""
    if log_factor == 0.0:
        return view
    factor = float(np.exp(log_factor))
    grow = np.diag([factor, factor, 1.0])
    grow[:2, 2] = (1.0 - factor) * principal_point(view.matrix)
    return replace(view, matrix=grow @ view.matrix)


def principal_point(matrix: Array) -> Array:
    """Return the principal point of a camera matrix (3, 4) without skew [px], shape (2,)."""
    return np.asarray(matrix[:2, :3] @ matrix[2, :3] / (matrix[2, :3] @ matrix[2, :3]), np.float64)
