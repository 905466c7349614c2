"""Pictures and contours of both scans as the cameras see them, redrawn only after they have moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.media.warp import warp_nearest
from jawusd.tracking.config import Mapper
from jawusd.tracking.contour.samples import COLUMNS, INVERSE_DEPTH, NX, NY, U, V, X, Y, Z, contour_samples
from jawusd.tracking.contour.scan import ARCHES, Scan
from jawusd.tracking.contour.views import View

_AROUND_PX = 24  # drawn around the window, which follows the masks
_LARGEST_ZOOM = 1.02  # of a picture against the drawn one
_MOST_KEPT = 64  # drawings; every correction of cameras begins new ones

_Kept = tuple[Array, int]


@dataclass(frozen=True, eq=False)
class Contour:
    """Which contour of a scan is sampled, and how; see `contour_samples`."""

    scan: Scan
    step_px: float
    depth_tolerance_mm: float
    towards_gum: Array | None

    def samples(
        self, matrix: Array, eye: Array, labels: NDArray[np.uint8], inverse_depth: NDArray[np.float32]
    ) -> tuple[Array, int]:
        """Return the samples in pictures of the scan; arguments and result as of `contour_samples`."""
        limits = (self.step_px, self.depth_tolerance_mm)
        return contour_samples(self.scan, matrix, eye, labels, inverse_depth, *limits, self.towards_gum)


class Drawing:
    """Hold a scan drawn for one camera; pictures of it that has moved are this one warped.

    What of a scan is seen, and where its outline runs, depends on where the eye is in the scan's coordinates alone.
    """

    def __init__(self, scan: Scan, matrix: Array, eye: Array, shape: tuple[int, int]) -> None:
        """Draw.

        Args:
            scan: of one arch.
            matrix: projection from scan coordinates [mm] to homogeneous px of a window, shape (3, 4).
            eye: camera centre in scan coordinates [mm], shape (3,).
            shape: of the window (h, w).
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
        self._least_squares = np.linalg.pinv(drawn_at)  # of affine maps from here, shape (3, n)

    def shows(self, matrix: Array, eye: Array, shape: tuple[int, int], parallax_px: float) -> bool:
        """Tell whether this drawing also shows the scan in another pose.

        Args:
            matrix, eye, shape: as for the drawing.
            parallax_px: how far near and far parts may have moved against each other.
        """
        centre, radius_mm = self._scan.centre, self._scan.radius_mm
        before, now = self._eye - centre, eye - centre
        far = np.linalg.norm(before), np.linalg.norm(now)
        px_per_mm = _px_per_mm(matrix, centre)
        zoom = px_per_mm / self._px_per_mm
        if max(zoom, 1.0 / zoom) > _LARGEST_ZOOM:
            return False
        turned_rad = np.linalg.norm(before / far[0] - now / far[1])
        if turned_rad * radius_mm * px_per_mm > parallax_px:
            return False
        to_drawn = self.to_drawn(matrix)
        height, width = shape
        corners = (
            np.array([[0, 0, 1.0], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]]) @ to_drawn.T
        )
        return bool((corners > -1.0).all() and (corners < np.array(self._labels.shape[::-1])).all())

    def to_drawn(self, matrix: Array) -> Array:
        """Return the affine map from pixels at another pose to those of the drawing, shape (2, 3)."""
        *linear, shift = self._least_squares @ projected(matrix, self._probes)
        back = np.linalg.inv(np.transpose(linear))
        return np.column_stack([back, -back @ shift])

    def show(self, matrix: Array, labels: NDArray[np.uint8], inverse_depth: NDArray[np.float32]) -> float:
        """Write the pictures at a pose that the drawing shows; return by how much the scan has turned in them [rad].

        Args:
            matrix: as for the drawing.
            labels, inverse_depth: receive what is seen at every pixel of the window, and how near it is [1/mm].
        """
        if (_shifted(matrix, _AROUND_PX) == self._matrix).all():  # as drawn, or of a smaller window
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
        """Sample a contour as drawn, unless that was done before."""
        if contour not in self._contours:
            self._contours[contour] = contour.samples(self._matrix, self._eye, self._labels, self._inverse_depth)

    def samples(self, contour: Contour, matrix: Array, shape: tuple[int, int], turned_rad: float) -> _Kept:
        """Return the samples of a contour at a pose near one that was shown.

        Args:
            contour: of this arch; the drawing may be of a scan with fewer faces.
            matrix, shape: as for the drawing; of the pose.
            turned_rad: as `show` returned it.

        Returns:
            As `contour_samples`; a copy.
        """
        self.find_samples(contour)
        kept = self._contours[contour]
        out = np.empty_like(kept[0])
        n, silhouettes = _moved(*kept, matrix, np.cos(turned_rad), np.sin(turned_rad), *shape, out)
        return out[:n], silhouettes


class Drawings:
    """Keep the last drawing of every arch for every camera, from instant to instant."""

    def __init__(self, scans: Sequence[Scan], parallax_px: float) -> None:
        """Keep nothing yet; `parallax_px` as `Drawing.shows` takes it."""
        self._scans, self._parallax_px = scans, parallax_px
        self._kept: dict[tuple[int, int, bytes], Drawing] = {}

    def of(
        self, arch: int, view: int, camera: Array, T_world_scan: Array, matrix: Array, shape: tuple[int, int]
    ) -> Drawing:
        """Return a drawing that shows an arch in a pose.

        Safe to call from several threads for different arches or views.

        Args:
            view: number of the view, of those of its instant.
            camera: camera centre in the world [mm], shape (3,).
            T_world_scan: the pose, shape (4, 4).
            matrix: projection from scan coordinates [mm] to homogeneous px of the window, shape (3, 4).
            shape: of the window (h, w).
        """
        eye = T_world_scan[:3, :3].T @ (camera - T_world_scan[:3, 3])
        key = (arch, view, camera.tobytes())
        kept = self._kept.get(key)
        if kept is None or not kept.shows(matrix, eye, shape, self._parallax_px):
            kept = self._kept[key] = Drawing(self._scans[arch], matrix, eye, shape)
        return kept

    def forget_old(self) -> None:
        """Let go of all if there are too many."""
        if len(self._kept) > _MOST_KEPT:
            self.forget()

    def forget(self) -> None:
        """Let go of all."""
        self._kept.clear()


@numba.njit(nogil=True, cache=True)
def _moved(
    samples: Array, silhouettes: int, matrix: Array, cos: float, sin: float, height: int, width: int, out: Array
) -> tuple[int, int]:
    """Write samples as they lie at another pose, those within the window; return how many, and how many silhouettes."""
    n, first = 0, 0
    for s in range(len(samples)):
        x, y, z = samples[s, X], samples[s, Y], samples[s, Z]
        w = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
        u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / w
        v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / w
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
    """Return a projection (3, 4) to pixels that count from so many further up and left."""
    out = matrix.copy()
    out[:2] += px * matrix[2]
    return out


def _px_per_mm(matrix: Array, point: Array) -> float:
    """Return the scale of the picture at a point (3,) of the scan [px/mm], of square pixels."""
    axis = matrix[2, :3] / np.linalg.norm(matrix[2, :3])
    across = matrix[0, :3] - (matrix[0, :3] @ axis) * axis
    return float(np.linalg.norm(across) / (matrix[2, :3] @ point + matrix[2, 3]))


def projected(matrix: Array, points: Array) -> Array:
    """Return where a projection (3, 4) shows points (n, 3) [px], shape (n, 2)."""
    h = points @ matrix[:, :3].T + matrix[:, 3]
    return np.asarray(h[:, :2] / h[:, 2:])


_CORNERS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]])  # of a ball, that show its motion


class Rendering:
    """Keep pictures and contours of both scans in every view of one instant, made again only after they have moved.

    Until then the points of a contour move with the scan. That its outline runs through other points then, as it turns,
    is of second order.
    """

    def __init__(
        self, views: Sequence[View], contours: Sequence[Contour], drawings: Drawings, redraw_px: float, map: Mapper
    ) -> None:
        """Show nothing yet.

        Args:
            views: of the instant.
            contours: of the upper and lower arch, found while drawing.
            drawings: where drawings of earlier instants are kept.
            redraw_px: by how much an arch may move before it is drawn again.
            map: shares the drawing among threads.
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
        """Show the scans anew whose projection has moved by more than the allowed pixels."""

        def show(task: tuple[int, int]) -> None:
            self._show(*task, poses[task[0]])

        self._drawings.forget_old()
        tasks = [(r, c) for r in ARCHES for c in range(len(self._views)) if self._moved(r, c, poses[r])]
        list(self._map(show, tasks))

    def samples(self, contour: Contour, r: int, c: int, pose: Array) -> tuple[Array, int]:
        """Return the samples of a contour in a view, moved to a pose near the one the view shows it in.

        Args:
            contour: of the arch; the pictures may be of a scan with fewer faces.
            r, c: arch and view.
            pose: T_world_arch at the view's instant, shape (4, 4).

        Returns:
            As `contour_samples`; a copy.
        """
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
        drawing.find_samples(self._contours[r])  # here, where threads draw several views side by side
        at = projected(view.matrix @ pose, self._corners[r])
        self._shown[r, c] = (at, drawing, drawing.show(matrix, labels, depth))
