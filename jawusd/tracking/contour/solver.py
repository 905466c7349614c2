"""Gauss-Newton alignment of both rows of teeth with their masks in all views at one instant."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jawusd.geometry import (
    make_transform,
    orthonormalise,
    se3_exp,
    transform_point,
    transform_points,
)
from jawusd.geometry.arrays import Array, Mask
from jawusd.imaging.raster import draw_depth_labels, project
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.correspondences import accumulate, scatter_of_tiles, search_edges
from jawusd.tracking.contour.equations import (
    ARCHES,
    NormalEquations,
    OutlineSums,
    OutlineTerm,
    ResidualTerm,
    Solution,
    StartTerm,
)
from jawusd.tracking.contour.samples import CROWN, GUM, LENGTH, contour_samples
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.contour.views import View

_DENSE_STEPS = 2  # with all faces of a dense scan, after the thinned one has settled


class ContourSolver:
    """Align two scans with masks; keeps buffers, so one solver serves one thread of control."""

    def __init__(self, scans: Sequence[Scan], config: TrackingConfig, executor: Executor | None = None) -> None:
        self.scans = tuple(scans)
        self.config = config
        self._map: Callable[..., Iterable] = executor.map if executor else map
        thin = [scan.thin or scan for scan in self.scans]
        arms = np.array([[(s.radius_mm / 2) ** 2] * 3 + [1.0] * 3 for s in self.scans])
        self._start_strength = config.typical_noise_px3 / config.prediction_mm**2 * arms
        self._thin = ContourSolver(thin, config, executor) if any(scan.thin for scan in self.scans) else None

    def solve(
        self,
        poses: Array,
        views: Sequence[View],
        gates_px: Sequence[float],
        use: Mask | None = None,
        terms: Sequence[ResidualTerm] = (),
        outline_weight: Array | None = None,
    ) -> Solution:
        """Align both rows, starting from given poses.

        Args:
            poses: start T_world_upper, T_world_lower, shape (2, 4, 4).
            views: one picture per camera.
            gates_px: residual gate of every iteration; without any, the poses are judged where they are.
            use: masks that take part, shape (2, C); by default all present ones.
            terms: what constrains the poses besides the masks.
            outline_weight: as in `NormalEquations`; needed if the terms are log-likelihoods.
        """
        use = np.array([[v.present[r] for v in views] for r in ARCHES]) if use is None else use
        if self._thin is None or not gates_px:
            return self._descend(poses, poses, views, gates_px, use, terms, outline_weight)
        rough = self._thin.solve(poses, views, gates_px, use, terms, outline_weight)
        last = self._descend(poses, rough.poses, views, tuple(gates_px[-1:]) * _DENSE_STEPS, use, terms, outline_weight)
        return replace(last, iterations=rough.iterations + last.iterations)

    def _descend(
        self,
        start: Array,
        poses: Array,
        views: Sequence[View],
        gates_px: Sequence[float],
        use: Mask,
        terms: Sequence[ResidualTerm],
        weight: Array | None,
    ) -> Solution:
        """Take one step per gate from the given poses."""
        poses = np.array(poses, np.float64)
        render = _Rendering(self, views)
        iterations = 0
        for gate in gates_px:
            iterations += 1
            state = self._linearise(poses, views, use, gate, render)
            step = self._step(state, start, terms, weight)
            for r in ARCHES:
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
        tasks = [(r, c) for r in ARCHES for c in range(len(views)) if use[r, c]]
        centres = np.stack([transform_point(poses[r], self.scans[r].centre) for r in ARCHES])
        reach = gate + 1.0

        def match(task):
            r, c = task
            return self._match(views[c].lead[r] @ poses[r], views[c], r, render.labels[c], render.depths[c], reach)

        matches = dict(zip(tasks, self._map(match, tasks), strict=True))
        outline = OutlineSums.zeros(len(views))
        scatters, visible = np.zeros((2, 6, 6)), np.zeros((2, len(views)))
        for r in ARCHES:
            used = gate
            if gate <= config.final_gate_px[1]:
                used = self._final_gate([matches[t][1] for t in tasks if t[0] == r], gate)
            pull = config.pull if gate > config.pull_above_px else 0.0
            for c in np.flatnonzero(use[r]):
                samples, distances, visible[r, c] = matches[r, c]
                where = (views[c].lead[r] @ poses[r], views[c].matrix, centres[r])
                tables = (outline.precision[r, c], outline.gradient[r, c], outline.bias_slope[r, c])
                sums = accumulate(samples, distances, used, config.score_gate_px, pull, *where, *tables)
                for table, value in zip(outline[3:], sums, strict=True):
                    table[r, c] = value
                if final:
                    shape = views[c].masks.shape[1:]
                    scatters[r] += scatter_of_tiles(samples, distances, used, *where, shape, config.tile_px)
        return Solution(poses.copy(), outline, centres, scatters, visible, 0)

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

    def _step(self, state: Solution, start: Array, terms: Sequence[ResidualTerm], weight: Array | None) -> Array:
        """Solve the joint normal equations; twists about the centres, shape (2, 6)."""
        equations = NormalEquations(weight)
        for term in (OutlineTerm(), StartTerm(start, self._start_strength), *terms):
            term.accumulate(state, equations)
        return equations.solve()

    def _motion_mm(self, step: Array) -> float:
        """Return the largest motion of a crown vertex under twists about the centres [mm]."""
        return max(
            float(np.linalg.norm(step[r, :3]) * self.scans[r].radius_mm + np.linalg.norm(step[r, 3:])) for r in ARCHES
        )


class _Rendering:
    """Keep pictures of both scans in every view, drawn again only after they have moved."""

    def __init__(self, solver: ContourSolver, views: Sequence[View]) -> None:
        self._solver = solver
        self._views = views
        self._drawn: list[list[NDArray | None]] = [[None] * len(views) for _ in ARCHES]
        shapes = [v.masks.shape for v in views]
        self.labels = [np.zeros(s, np.uint8) for s in shapes]
        self.depths = [np.zeros(s, np.float32) for s in shapes]

    def update(self, poses: Array) -> None:
        """Draw the scans whose projection has moved by more than the allowed pixels."""
        tasks = [(r, c) for r in ARCHES for c in range(len(self._views)) if self._moved(r, c, poses[r])]
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


def _moved(pose: Array, twist: Array, centre: Array) -> Array:
    """Return the pose after a left twist about a world point; rotations are made orthonormal again.

    Without the last step rounding grows exponentially when predictions multiply poses frame after frame.
    """
    to, back = make_transform(np.eye(3), -centre), make_transform(np.eye(3), centre)
    return orthonormalise(back @ se3_exp(twist) @ to @ pose)
