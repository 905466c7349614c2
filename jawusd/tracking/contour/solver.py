"""Gauss-Newton alignment of both rows of teeth with their masks in all views at one instant."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from jawusd.geometry import (
    make_transform,
    orthonormalise,
    se3_exp,
    se3_inverse,
    se3_log,
    transform_point,
    transform_points,
)
from jawusd.geometry.arrays import Array, Mask
from jawusd.imaging.raster import draw_depth_labels, project
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.correspondences import accumulate, scatter_of_tiles, search_edges
from jawusd.tracking.contour.samples import CROWN, GUM, LENGTH, contour_samples
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.contour.views import View

_ROWS = (0, 1)  # upper, lower
_DENSE_STEPS = 2  # with all faces of a dense scan, after the thinned one has settled


@dataclass(frozen=True, eq=False)
class Solution:
    """Hold the outcome of one alignment.

    Attributes:
        poses: T_world_upper and T_world_lower, shape (2, 4, 4).
        systems: normal equations per row and view as `accumulate` sums them, shape (2, C, 8, 8).
        centres: points the twists turn about, world coordinates [mm], shape (2, 3).
        scatters: sums over picture tiles of the squared score of `scatter_of_tiles`, per row, shape (2, 6, 6).
        visible_px: contour length that could have been matched, per row and view [px], shape (2, C).
        iterations: how many linearised steps were taken.
    """

    poses: Array
    systems: Array
    centres: Array
    scatters: Array
    visible_px: Array
    iterations: int


class WeighedPrior(Protocol):
    """Know something of both poses, and how much a pixel of contour is worth against it.

    Attributes:
        variance_px3: outline variance times correlation length per row [px^3], shape (2,).
    """

    variance_px3: Array

    def terms(self, poses: Array, centres: Array) -> tuple[Array, Array]:
        """Return precision (12, 12) and right side (12,) of left twists about the centres, rows (upper, lower)."""
        ...


class ContourSolver:
    """Align two scans with masks; keeps buffers, so one solver serves one thread of control."""

    def __init__(self, scans: Sequence[Scan], config: TrackingConfig, executor: Executor | None = None) -> None:
        self.scans = tuple(scans)
        self.config = config
        self._map: Callable[..., Iterable] = executor.map if executor else map
        thin = [scan.thin or scan for scan in self.scans]
        self._thin = ContourSolver(thin, config, executor) if any(scan.thin for scan in self.scans) else None

    def solve(
        self,
        poses: Array,
        views: Sequence[View],
        gates_px: Sequence[float],
        use: Mask | None = None,
        prior: WeighedPrior | None = None,
    ) -> Solution:
        """Align both rows, starting from given poses.

        Args:
            poses: start T_world_upper, T_world_lower, shape (2, 4, 4).
            views: one picture per camera.
            gates_px: residual gate of every iteration; without any, the poses are judged where they are.
            use: masks that take part, shape (2, C); by default all present ones.
            prior: what else is known of the two poses; by default nothing.
        """
        use = np.array([[v.present[r] for v in views] for r in _ROWS]) if use is None else use
        if self._thin is None or not gates_px:
            return self._descend(poses, poses, views, gates_px, use, prior)
        rough = self._thin.solve(poses, views, gates_px, use, prior)
        last = self._descend(poses, rough.poses, views, tuple(gates_px[-1:]) * _DENSE_STEPS, use, prior)
        return replace(last, iterations=rough.iterations + last.iterations)

    def _descend(self, start, poses, views, gates_px, use, prior) -> Solution:
        """Take one step per gate from the given poses, pulled weakly towards the start."""
        poses = np.array(poses, np.float64)
        render = _Rendering(self, views)
        iterations = 0
        for gate in gates_px:
            iterations += 1
            state = self._linearise(poses, views, use, gate, render)
            step = self._step(state, start, prior)
            for r in _ROWS:
                poses[r] = _moved(poses[r], step[r], state.centres[r])
            if gate == gates_px[-1] and self._motion_mm(step) < self.config.converged_mm:
                break
        gate = gates_px[-1] if gates_px else self.config.final_gate_px[1]
        state = self._linearise(poses, views, use, gate, render, final=True)
        return replace(state, iterations=iterations)

    def _linearise(self, poses, views, use, gate, render: _Rendering, final: bool = False) -> Solution:
        """Find correspondences at the given poses and sum up the normal equations."""
        config = self.config
        render.update(poses)
        tasks = [(r, c) for r in _ROWS for c in range(len(views)) if use[r, c]]
        centres = np.stack([transform_point(poses[r], self.scans[r].centre) for r in _ROWS])
        reach = gate + 1.0

        def match(task):
            r, c = task
            return self._match(views[c].lead[r] @ poses[r], views[c], r, render.labels[c], render.depths[c], reach)

        matches = dict(zip(tasks, self._map(match, tasks), strict=True))
        systems = np.zeros((2, len(views), 8, 8))
        scatters, visible = np.zeros((2, 6, 6)), np.zeros((2, len(views)))
        for r in _ROWS:
            used = gate
            if gate <= config.final_gate_px[1]:
                used = self._final_gate([matches[t][1] for t in tasks if t[0] == r], gate)
            pull = config.pull if gate > config.pull_above_px else 0.0
            for c in np.flatnonzero(use[r]):
                samples, distances, visible[r, c] = matches[r, c]
                where = (views[c].lead[r] @ poses[r], views[c].matrix, centres[r])
                accumulate(samples, distances, used, config.score_gate_px, pull, *where, systems[r, c])
                if final:
                    shape = views[c].masks.shape[1:]
                    scatters[r] += scatter_of_tiles(samples, distances, used, *where, shape, config.tile_px)
        return Solution(poses.copy(), systems, centres, scatters, visible, 0)

    def _match(self, pose, view: View, r: int, labels, depths, reach):
        config, scan = self.config, self.scans[r]
        eye = pose[:3, :3].T @ (view.eye - pose[:3, 3])
        samples = contour_samples(
            scan, view.matrix @ pose, eye, labels[r], depths[r], config.sample_step_px, config.depth_tolerance_mm
        )
        distances = np.empty(len(samples))
        search_edges(
            samples,
            view.masks[r],
            view.masks[1 - r],
            depths[1 - r],
            reach,
            config.overlap_tolerance_mm,
            config.normal_cosine,
            distances,
        )
        return samples, distances - view.bias_px[r], float(samples[:, LENGTH].sum())

    def _final_gate(self, distances: list[NDArray], gate: float) -> float:
        """Return the Tukey gate that suits the spread of the residuals (median absolute deviation)."""
        d = np.concatenate(distances) if distances else np.empty(0)
        d = np.abs(d[np.isfinite(d)])
        d = d[d < gate]
        if len(d) < 20:
            return gate
        return float(np.clip(self.config.gate_sigmas * 1.4826 * np.median(d), *self.config.final_gate_px))

    def _step(self, state: Solution, start: Array, prior: WeighedPrior | None) -> Array:
        """Solve the joint 12x12 normal equations; twists about the centres, shape (2, 6).

        A weak pull towards the start keeps motions finite that the masks leave free.
        """
        H, g = np.zeros((12, 12)), np.zeros(12)
        for r in _ROWS:
            total = state.systems[r].sum(0)
            arm = self.scans[r].radius_mm / 2
            pull = self.config.typical_noise_px3 / self.config.prediction_mm**2 * np.array([arm**2] * 3 + [1.0] * 3)
            away = _twist_between(start[r], state.poses[r], state.centres[r])
            block = slice(6 * r, 6 * r + 6)
            H[block, block] = total[:6, :6] + np.diag(pull)
            g[block] = total[:6, 6] - pull * away
        if prior is not None:
            weight = np.repeat(1.0 / prior.variance_px3, 6)
            known, towards = prior.terms(state.poses, state.centres)
            H, g = weight[:, None] * H + known, weight * g + towards
        return np.linalg.solve(H, g).reshape(2, 6)

    def _motion_mm(self, step: Array) -> float:
        """Return the largest motion of a crown vertex under twists about the centres [mm]."""
        return max(
            float(np.linalg.norm(step[r, :3]) * self.scans[r].radius_mm + np.linalg.norm(step[r, 3:])) for r in _ROWS
        )


class _Rendering:
    """Keep pictures of both scans in every view, drawn again only after they have moved."""

    def __init__(self, solver: ContourSolver, views: Sequence[View]) -> None:
        self._solver = solver
        self._views = views
        self._drawn: list[list[NDArray | None]] = [[None] * len(views) for _ in _ROWS]
        shapes = [v.masks.shape for v in views]
        self.labels = [np.zeros(s, np.uint8) for s in shapes]
        self.depths = [np.zeros(s, np.float32) for s in shapes]

    def update(self, poses: Array) -> None:
        """Draw the scans whose projection has moved by more than the allowed pixels."""
        tasks = [(r, c) for r in _ROWS for c in range(len(self._views)) if self._moved(r, c, poses[r])]
        list(self._solver._map(lambda task: self._draw(*task, poses[task[0]]), tasks))

    def _moved(self, r: int, c: int, pose: Array) -> bool:
        last = self._drawn[r][c]
        if last is None:
            return True
        scan = self._solver.scans[r]
        corners = scan.centre + scan.radius_mm * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]])
        change = _pixels(self._views[c].matrix, transform_points(pose, corners)) - _pixels(
            self._views[c].matrix, transform_points(last, corners)
        )
        return float(np.abs(change).max()) > self._solver.config.redraw_px

    def _draw(self, r: int, c: int, pose: Array) -> None:
        scan, view = self._solver.scans[r], self._views[c]
        points = np.empty((len(scan.vertices), 3), np.float32)
        project(scan.vertices_single, (view.matrix @ view.lead[r] @ pose).astype(np.float32), points)
        labels, depth = self.labels[c][r], self.depths[c][r]
        labels[:] = 0
        depth[:] = 0
        draw_depth_labels(points, scan.crown_faces, 0, 0, scan.painted, depth, labels, CROWN)
        draw_depth_labels(points, scan.gum_faces, 0, 0, False, depth, labels, GUM)
        self._drawn[r][c] = pose.copy()


def _pixels(matrix: Array, points: Array) -> Array:
    h = points @ matrix[:, :3].T + matrix[:, 3]
    return h[:, :2] / h[:, 2:]


def _twist_between(start: Array, pose: Array, centre: NDArray) -> Array:
    """Return the twist about a world point that takes one pose to another, shape (6,)."""
    to, back = make_transform(np.eye(3), -centre), make_transform(np.eye(3), centre)
    return se3_log(to @ pose @ se3_inverse(start) @ back)


def _moved(pose: Array, twist: Array, centre: Array) -> Array:
    """Return the pose after a left twist about a world point; rotations are made orthonormal again.

    Without the last step rounding grows exponentially when predictions multiply poses frame after frame.
    """
    to, back = make_transform(np.eye(3), -centre), make_transform(np.eye(3), centre)
    return orthonormalise(back @ se3_exp(twist) @ to @ pose)
