"""Pictures and contours of both scans at one instant, kept as long as they have hardly moved."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jawusd.geometry.arrays import Array
from jawusd.tracking.contour.samples import U, V, Z
from jawusd.tracking.contour.scan import ARCHES
from jawusd.tracking.contour.views import View

if TYPE_CHECKING:
    from jawusd.tracking.contour.solver import ContourSolver

_CORNERS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]])  # of a ball, that show its motion


class Rendering:
    """Keep pictures and contours of both scans in every view of one instant, made again only after they have moved.

    Until then the points of a contour move with the scan. That its outline runs through other points then, as it turns,
    is of second order.
    """

    def __init__(self, solver: ContourSolver, views: Sequence[View]) -> None:
        self._solver = solver
        self._views = views
        self._drawn: dict[tuple[int, int], Array] = {}
        self._contours: dict[tuple[ContourSolver, int, int], tuple[Array, Array, int]] = {}
        shapes = [view.masks.shape for view in views]
        self.labels = [np.zeros(shape, np.uint8) for shape in shapes]
        self.depths = [np.zeros(shape, np.float32) for shape in shapes]

    def update(self, poses: Array) -> None:
        """Draw the scans whose projection has moved by more than the allowed pixels."""

        def draw(task: tuple[int, int]) -> None:
            self._draw(*task, poses[task[0]])

        tasks = [(r, c) for r in ARCHES for c in range(len(self._views)) if self._moved(r, c, poses[r])]
        list(self._solver.map(draw, tasks))

    def contour(self, solver: ContourSolver, r: int, c: int, pose: Array) -> tuple[Array, int]:
        """Return the contour of a solver's scan in a view, moved to a pose near the one the view was drawn at.

        Args:
            solver: whose scan it is; its pictures may be another solver's, of the same scans.
            r, c: arch and view.
            pose: T_world_arch at the view's instant, shape (4, 4).

        Returns:
            As `contour_samples`; a copy.
        """
        view, drawn = self._views[c], self._drawn[r, c]
        kept = self._contours.get((solver, r, c))
        if kept is None or kept[0] is not drawn:
            found = solver.contour(r, view.T_delay[r] @ drawn, view, self.labels[c][r], self.depths[c][r])
            kept = self._contours[solver, r, c] = (drawn, *found)
        samples = kept[1].copy()
        samples[:, [U, V]] = _pixels(view.matrix @ pose, samples[:, : Z + 1])
        return samples, kept[2]

    def _moved(self, r: int, c: int, pose: Array) -> bool:
        last = self._drawn.get((r, c))
        if last is None:
            return True
        scan, matrix = self._solver.scans[r], self._views[c].matrix
        corners = scan.centre + scan.radius_mm * _CORNERS
        change = _pixels(matrix @ pose, corners) - _pixels(matrix @ last, corners)
        return float(np.abs(change).max()) > self._solver.config.redraw_px

    def _draw(self, r: int, c: int, pose: Array) -> None:
        view, labels, depth = self._views[c], self.labels[c][r], self.depths[c][r]
        labels[:] = 0
        depth[:] = 0
        self._solver.scans[r].draw(view.matrix @ view.T_delay[r] @ pose, depth, labels)
        self._drawn[r, c] = pose.copy()


def _pixels(matrix: Array, points: Array) -> Array:
    h = points @ matrix[:, :3].T + matrix[:, 3]
    return h[:, :2] / h[:, 2:]
