"""Renderings and contours of both scans in every camera, updated only after the scans have moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.media.working_view import warp_nearest
from jawusd.tracking.config import Mapper, TrackingConfig
from jawusd.tracking.contour.samples import COLUMNS, INVERSE_DEPTH, NX, NY, U, V, X, Y, Z, contour_samples, pixel
from jawusd.tracking.contour.scan import ARCHES, Scan
from jawusd.tracking.contour.views import View

_AROUND_PX = 24  # margin rendered around the window [px], since the window moves with the masks
_MOST_KEPT = 64  # maximum number of drawings in the cache; every correction of the camera poses adds new ones

_Kept = tuple[Array, int]


@dataclass(frozen=True, eq=False)
class Contour:
    """The scan of a contour, and the parameters for sampling it; see `contour_samples`."""

    scan: Scan
    step_px: float
    depth_tolerance_mm: float
    towards_gum: Array | None


class Drawing:
    """A rendering of a scan for one camera; for small motions, it is warped instead of rendered again.

    Warping is accurate because visibility and outline of a scan depend only on the camera centre in scan coordinates.
    """

    def __init__(self, scan: Scan, matrix: Array, eye: Array, shape: tuple[int, int]) -> None:
        """Render the scan in a window of size `shape` (h, w).

        Args:
            matrix: projection from scan coordinates [mm] to homogeneous px of a window, shape (3, 4).
            eye: camera centre in scan coordinates [mm], shape (3,).
        """
        self._scan, self._eye = scan, eye
        self._matrix = _shifted(matrix, _AROUND_PX)
        size = (shape[0] + 2 * _AROUND_PX, shape[1] + 2 * _AROUND_PX)
        self._labels, self._inverse_depth = np.zeros(size, np.uint8), np.zeros(size, np.float32)
        scan.draw(self._matrix, self._inverse_depth, self._labels)
        self._px_per_mm = _px_per_mm(self._matrix, scan.centre)
        self._contours: dict[Contour, _Kept] = {}
        self._probes = scan.probes[:: max(1, len(scan.probes) // 24)]
        drawn_at = np.column_stack([projected(self._matrix, self._probes), np.ones(len(self._probes))])
        # pseudo-inverse that fits affine maps to the motion of the drawn points, shape (3, n)
        self._least_squares = np.linalg.pinv(drawn_at)

    def shows(self, matrix: Array, eye: Array, shape: tuple[int, int], limits: TrackingConfig) -> bool:
        """Return whether this drawing can be warped to another pose; arguments are as for the constructor.

        `limits` has the maximum relative motion of near and far parts, and the maximum change of scale.
        """
        centre, radius_mm = self._scan.centre, self._scan.radius_mm
        before, now = self._eye - centre, eye - centre
        far = np.linalg.norm(before), np.linalg.norm(now)
        px_per_mm = _px_per_mm(matrix, centre)
        zoom = px_per_mm / self._px_per_mm
        if max(zoom, 1.0 / zoom) > limits.largest_zoom:
            return False
        turned_rad = np.linalg.norm(before / far[0] - now / far[1])
        if turned_rad * radius_mm * px_per_mm > limits.parallax_px:
            return False
        to_drawn = self.to_drawn(matrix)
        height, width = shape
        corners = (
            np.array([[0, 0, 1.0], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]]) @ to_drawn.T
        )
        return bool((corners > -1.0).all() and (corners < np.array(self._labels.shape[::-1])).all())

    def to_drawn(self, matrix: Array) -> Array:
        """Return the affine map from pixels at another pose to pixels of the drawing, shape (2, 3)."""
        *linear, shift = self._least_squares @ projected(matrix, self._probes)
        back = np.linalg.inv(np.transpose(linear))
        return np.column_stack([back, -back @ shift])

    def show(self, matrix: Array, labels: NDArray[np.uint8], inverse_depth: NDArray[np.float32]) -> float:
        """Write labels and inverse depths [1/mm] at a pose; return the rotation of the scan in the image [rad]."""
        if (_shifted(matrix, _AROUND_PX) == self._matrix).all():  # the pose is unchanged, but the window may be smaller
            window = tuple(slice(_AROUND_PX, _AROUND_PX + side) for side in labels.shape)
            labels[:], inverse_depth[:] = self._labels[window], self._inverse_depth[window]
            return 0.0
        to_drawn = self.to_drawn(matrix)
        warp_nearest(self._labels, to_drawn, labels)
        warp_nearest(self._inverse_depth, to_drawn, inverse_depth)
        centre = np.append(self._scan.centre, 1.0)
        inverse_depth *= np.float32((self._matrix[2] @ centre) / (matrix[2] @ centre))
        return float(np.arctan2(to_drawn[0, 1] - to_drawn[1, 0], to_drawn[0, 0] + to_drawn[1, 1]))

    def find_samples(self, contour: Contour) -> None:
        """Sample a contour in this drawing unless its samples are cached."""
        if contour not in self._contours:
            drawn = (self._matrix, self._eye, self._labels, self._inverse_depth)
            limits = (contour.step_px, contour.depth_tolerance_mm)
            self._contours[contour] = contour_samples(contour.scan, *drawn, *limits, contour.towards_gum)

    def samples(self, contour: Contour, matrix: Array, shape: tuple[int, int], turned_rad: float) -> _Kept:
        """Return a copy of the samples of a contour, which may have more faces, close to the pose of the last `show`.

        `matrix` and `shape` are those of the pose, as for the constructor; `turned_rad` is the result of `show`.
        """
        self.find_samples(contour)
        kept = self._contours[contour]
        out = np.empty_like(kept[0])
        n, silhouettes = _moved(*kept, matrix, np.cos(turned_rad), np.sin(turned_rad), *shape, out)
        return out[:n], silhouettes


class Drawings:
    """A cache of the last drawings of every arch in every camera."""

    def __init__(self, scans: Sequence[Scan], limits: TrackingConfig) -> None:
        """Start with an empty cache; `limits` are as for `Drawing.shows`."""
        self._scans, self._limits = scans, limits
        self._kept: dict[tuple[int, int, bytes], Drawing] = {}

    def of(
        self, arch: int, view: int, camera: Array, T_world_scan: Array, matrix: Array, shape: tuple[int, int]
    ) -> Drawing:
        """Return a drawing that can be warped to a pose of an arch; thread-safe for different arches or views.

        `camera` is the camera centre in the world (3,) [mm], `T_world_scan` the pose (4, 4); others are as for
        `Drawing`.
        """
        eye = T_world_scan[:3, :3].T @ (camera - T_world_scan[:3, 3])
        key = (arch, view, camera.tobytes())
        kept = self._kept.get(key)
        if kept is None or not kept.shows(matrix, eye, shape, self._limits):
            kept = self._kept[key] = Drawing(self._scans[arch], matrix, eye, shape)
        return kept

    def forget_old(self) -> None:
        """Clear the cache if it is full."""
        if len(self._kept) > _MOST_KEPT:
            self.forget()

    def forget(self) -> None:
        """Clear the cache."""
        self._kept.clear()


@numba.njit(nogil=True, cache=True)
def _moved(
    samples: Array, silhouettes: int, matrix: Array, cos: float, sin: float, height: int, width: int, out: Array
) -> tuple[int, int]:
    """Move samples to another pose, and write those in the window; return their number and that of silhouettes."""
    n, first = 0, 0
    for s in range(len(samples)):
        x, y, z = samples[s, X], samples[s, Y], samples[s, Z]
        u, v, w = pixel(matrix, x, y, z)
        if u < 0.5 or v < 0.5 or u > width - 1.5 or v > height - 1.5:
            continue
        for k in range(COLUMNS):
            out[n, k] = samples[s, k]
        nx, ny = samples[s, NX], samples[s, NY]
        out[n, U], out[n, V], out[n, INVERSE_DEPTH] = u, v, 1.0 / w
        out[n, NX], out[n, NY] = cos * nx - sin * ny, sin * nx + cos * ny
        n += 1
        if s < silhouettes:
            first = n
    return n, first


def _shifted(matrix: Array, px: float) -> Array:
    """Return a projection (3, 4) with the pixel origin moved up and left by `px`."""
    out = matrix.copy()
    out[:2] += px * matrix[2]
    return out


def _px_per_mm(matrix: Array, point: Array) -> float:
    """Return the image scale at a point (3,) of the scan [px/mm], assuming square pixels."""
    axis = matrix[2, :3] / np.linalg.norm(matrix[2, :3])
    across = matrix[0, :3] - (matrix[0, :3] @ axis) * axis
    return float(np.linalg.norm(across) / (matrix[2, :3] @ point + matrix[2, 3]))


def projected(matrix: Array, points: Array) -> Array:
    """Return the pixels of points (n, 3) under a projection (3, 4), shape (n, 2)."""
    h = points @ matrix[:, :3].T + matrix[:, 3]
    return np.asarray(h[:, :2] / h[:, 2:])


# Points on the unit sphere whose projections are compared to measure motion.
_CORNERS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]])


class Rendering:
    """Renderings and contours of both scans in every view of one frame, rendered again only after the scans have moved.

    Between renderings, the points of a contour move with the scan; for a rotated scan, the error is of second order.
    """

    def __init__(
        self, views: Sequence[View], contours: Sequence[Contour], drawings: Drawings, redraw_px: float, map: Mapper
    ) -> None:
        """Start without drawings; those in the cache `drawings` are shared between frames.

        The contours of both arches are sampled while drawing, which `map` distributes among threads. An arch is
        rendered again once its image has moved by `redraw_px`.
        """
        self._contours, self._drawings, self._redraw_px, self._map = contours, drawings, redraw_px, map
        self._views = views
        scans = [contour.scan for contour in contours]
        self._corners = [scan.centre + scan.radius_mm * _CORNERS for scan in scans]
        self._shown: dict[tuple[int, int], tuple[Array, Drawing, float]] = {}
        shapes = [view.masks.shape for view in views]
        self.labels = [np.zeros(shape, np.uint8) for shape in shapes]
        self.depths = [np.zeros(shape, np.float32) for shape in shapes]

    def update(self, poses: Array) -> None:
        """Render the scans again whose projections have moved by more than the allowed distance."""
        self._drawings.forget_old()
        tasks = [(r, c) for r in ARCHES for c in range(len(self._views)) if self._moved(r, c, poses[r])]
        list(self._map(lambda task: self._show(*task, poses[task[0]]), tasks))

    def samples(self, contour: Contour, r: int, c: int, pose: Array) -> tuple[Array, int]:
        """Return a copy of a contour's samples in a view, warped to a pose (4, 4) at the view's exposure."""
        _, drawing, turned_rad = self._shown[r, c]
        view = self._views[c]
        return drawing.samples(contour, view.matrix @ pose, view.masks.shape[1:], turned_rad)

    def _moved(self, r: int, c: int, pose: Array) -> bool:
        shown = self._shown.get((r, c))
        if shown is None:
            return True
        matrix = self._views[c].matrix
        moved_px = np.abs(projected(matrix @ pose, self._corners[r]) - shown[0]).max()
        return bool(moved_px > self._redraw_px)

    def _show(self, r: int, c: int, pose: Array) -> None:
        view, labels, depth = self._views[c], self.labels[c][r], self.depths[c][r]
        T_world_scan = view.T_delay[r] @ pose
        matrix = view.matrix @ T_world_scan
        drawing = self._drawings.of(r, c, view.eye, T_world_scan, matrix, labels.shape)
        # contours are sampled here, because threads run this method for several views in parallel
        drawing.find_samples(self._contours[r])
        at = projected(view.matrix @ pose, self._corners[r])
        self._shown[r, c] = (at, drawing, drawing.show(matrix, labels, depth))
