"""Pictures and contours of both scans at one instant, made again only after they have moved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jawusd.base.arrays import Array
from jawusd.tracking.config import Mapper
from jawusd.tracking.contour.drawing import Contour, Drawing, Drawings, projected
from jawusd.tracking.contour.scan import ARCHES
from jawusd.tracking.contour.views import View

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
