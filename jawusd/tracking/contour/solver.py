"""Gauss-Newton alignment of both arches with their masks in all views of one frame."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, wait
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import bite_normal, orthonormalise, transform_point
from jawusd.tracking.config import Item, Mapper, Result, SmoothErrors, TrackingConfig
from jawusd.tracking.contour.correspondences import (
    accumulate,
    linear_terms,
    scatter_of_tiles,
    search_edges,
    without_smooth_errors,
)
from jawusd.tracking.contour.equations import (
    NormalEquations,
    OutlineSums,
    OutlineTerm,
    ResidualTerm,
    Solution,
    StartTerm,
    motion_about,
)
from jawusd.tracking.contour.rendering import Contour, Drawings, Rendering
from jawusd.tracking.contour.samples import HABITS, LENGTH
from jawusd.tracking.contour.scan import ARCHES, Scan, thinned
from jawusd.tracking.contour.views import Drawn, View, present_masks

_ROUGH_FACES = 6_000  # number of crown faces of an arch in short trials: a third of that of a decimated scan
_DENSE_STEPS = 2  # number of steps with all faces of a dense scan, after the decimated scan has converged
_CONVERGED_MM = 0.1  # motion in the last step below which least squares counts as converged [mm at the crowns]

# Samples, distances to the mask edge, visible contour length [px].
_Match = tuple[Array, Array, float]


class Matched(NamedTuple):
    """The samples of an arch in a view, their distances to the mask edge, the residual gate, and the error model."""

    arch: int
    camera: int
    samples: Array
    distances: Array
    gate_px: float
    smooth: SmoothErrors | None


class ContourSolver:
    """Aligns two scans with masks. Not thread-safe, since drawings are cached."""

    def __init__(self, scans: Sequence[Scan], config: TrackingConfig, executor: Executor | None = None) -> None:
        self.scans = tuple(scans)
        self.config = config
        self.map: Mapper = ParallelMap(executor) if executor else map
        arms = np.array([[(scan.radius_mm / 2) ** 2] * 3 + [1.0] * 3 for scan in self.scans])
        self._start_strength = config.typical_noise_px3 / config.prediction_mm**2 * arms
        limits = (config.sample_step_px, config.depth_tolerance_mm)
        towards_gum = _towards_gum(self.scans)
        self.contours = tuple(Contour(scan, *limits, way) for scan, way in zip(self.scans, towards_gum, strict=True))
        thin = [scan.thin or scan for scan in self.scans]
        #: A solver with decimated scans; None if no scan is dense.
        self.thin = ContourSolver(thin, config, executor) if any(scan.thin for scan in self.scans) else None
        self._executor = executor
        #: Cache of the last drawings of both scans.
        self.drawings = Drawings(self.scans, config)

    @cached_property
    def rough(self) -> ContourSolver:
        """A solver with coarse scans, for short trial alignments."""
        scans = [thinned(replace(scan.thin or scan, thin=None), _ROUGH_FACES) for scan in self.scans]
        return ContourSolver(scans, self.config, self._executor)

    def exact(self) -> ContourSolver:
        """Return a solver with the same scans that never warps drawings.

        Searches need such a solver: they rank poses by uncovered pixels in small images, and jump between poses.
        """
        return ContourSolver(self.scans, replace(self.config, parallax_px=0.0), self._executor)

    def rendering(self, views: Sequence[View]) -> Rendering:
        """Return a rendering of both scans in the views of one frame, to be shared by all alignments of that frame."""
        return Rendering(views, self.contours, self.drawings, self.config.redraw_px, self.map)

    def forget_drawings(self) -> None:
        """Clear the drawing cache, so that poses do not depend on earlier alignments."""
        self.drawings.forget()
        for solver in (self.thin, self.__dict__.get("rough")):  # the property `rough` would create the solver
            if solver is not None:
                solver.forget_drawings()

    def solve(
        self,
        poses: Array,
        views: Sequence[View],
        gates_px: Sequence[float],
        use: Mask | None = None,
        terms: Sequence[ResidualTerm] = (),
        outline_weight: Array | None = None,
        rendering: Rendering | None = None,
    ) -> Solution:
        """Align both arches, starting from given poses.

        Args:
            poses: start poses T_world_upper and T_world_lower, shape (2, 4, 4).
            gates_px: residual gate of every iteration; if empty, the given poses are only evaluated.
            use: masks to use, shape (2, C); default: all present ones.
            terms: further constraints on the poses.
            outline_weight: as in `NormalEquations`; required if the terms are log-likelihoods.
            rendering: rendering of these views by this solver, shared with other alignments.
        """
        use = present_masks(views) if use is None else use
        rendering = rendering or self.rendering(views)
        all_terms: tuple[ResidualTerm, ...] = (OutlineTerm(), StartTerm(poses, self._start_strength), *terms)
        given = (views, use, rendering, all_terms, outline_weight)
        poses, moved_mm = self._descended(poses, tuple(gates_px), *given)
        gate = gates_px[-1] if gates_px else self.config.final_gate_px[1]
        state = self.linearise(poses, views, use, gate, rendering, final=True)
        if moved_mm < _CONVERGED_MM and self._smooth_errors(gate):
            # From the least-squares solution, one step of generalised least squares is enough (Le Cam's one-step
            # estimator; van der Vaart 1998, section 5.7).
            poses, _ = self._moved(poses, state, all_terms, outline_weight)
            state = self.linearise(poses, views, use, gate, rendering, final=True)
        return state

    def _descended(
        self,
        poses: Array,
        gates_px: tuple[float, ...],
        views: Sequence[View],
        use: Mask,
        rendering: Rendering,
        terms: Sequence[ResidualTerm],
        outline_weight: Array | None,
    ) -> tuple[Array, float]:
        """Return the poses (2, 4, 4) after steps of least squares, and the motion in the last one [mm].

        Arguments are as for `solve`.
        """
        left, moved_mm = gates_px, np.inf
        if self.thin is not None and left:
            given = (views, use, self.thin.rendering(views), terms, outline_weight)
            poses, _ = self.thin._descended(poses, left, *given)
            left = left[-1:] * _DENSE_STEPS
        while left:
            state = self.linearise(poses, views, use, left[0], rendering)
            poses, moved_mm = self._moved(poses, state, terms, outline_weight)
            left = self.config.gates_after(left, moved_mm)
        return poses, moved_mm

    def _moved(
        self, poses: Array, state: Solution, terms: Sequence[ResidualTerm], outline_weight: Array | None
    ) -> tuple[Array, float]:
        """Return the poses after a Gauss-Newton step, and an upper bound on the motion of crown vertices [mm]."""
        equations = NormalEquations(outline_weight)
        for term in terms:
            term.accumulate(state, equations)
        step = equations.solve()
        moved = [motion_about(state.centres[r], step[r]) @ poses[r] for r in ARCHES]
        # Predictions multiply poses frame after frame, so rounding errors would accumulate.
        return orthonormalise(np.stack(moved)), self._motion_mm(step)

    def _smooth_errors(self, gate_px: float) -> SmoothErrors | None:
        """Return the model of outline errors for a residual gate: only the last steps have one."""
        return self.config.smooth_errors if gate_px <= self.config.final_gate_px[1] else None

    def linearise(
        self,
        poses: Array,
        views: Sequence[View],
        use: Mask,
        gate: float,
        rendering: Rendering,
        final: bool = False,
        matched: list[Matched] | None = None,
    ) -> Solution:
        """Find correspondences at the given poses and sum their residuals.

        Args:
            poses: T_world_upper, T_world_lower, shape (2, 4, 4).
            use: masks to use, shape (2, C).
            gate: residual above which a sample has no weight [px].
            final: whether to compute the sums for the covariance as well.
            matched: list to which the matched samples are appended.
        """
        config = self.config
        rendering.update(poses)
        tasks = [(r, c) for r in ARCHES for c in range(len(views)) if use[r, c]]
        moved = {(r, c): views[c].T_delay[r] @ poses[r] for r, c in tasks}

        def match(task: tuple[int, int]) -> _Match:
            r, c = task
            return self._match(moved[task], views[c], r, rendering, c, gate + 1.0)

        # Matching masks takes less time than waking a thread; matching colours does not.
        mapper = map if all(view.edges is None for view in views) else self.map
        matches = dict(zip(tasks, mapper(match, tasks), strict=True))
        centres = np.stack([transform_point(poses[r], self.scans[r].centre) for r in ARCHES])
        outline = OutlineSums.zeros(len(views))
        scatters, gum_scatters, visible = np.zeros((2, 6, 6)), np.zeros((2, 6, 6)), np.zeros((2, len(views)))
        pull = config.pull if gate > config.pull_above_px else 0.0
        used = [gate, gate]
        smooth = self._smooth_errors(gate) if final else None
        if gate <= config.final_gate_px[1]:
            used = [self._final_gate([matches[t][1] for t in tasks if t[0] == r], gate) for r in ARCHES]
        for r, c in tasks:
            samples, distances, visible[r, c] = matches[r, c]
            if matched is not None:
                matched.append(Matched(r, c, samples, distances, used[r], smooth))
            where = (moved[r, c], views[c].matrix, centres[r])
            limits = (used[r], config.score_gate_px, pull)
            linear = linear_terms(samples, distances, limits, where, outline, r, c)
            rest = without_smooth_errors(*linear, smooth) if smooth is not None else linear.rows
            accumulate(linear, rest, outline, r, c)
            if final:
                own, gum = scatter_of_tiles(linear, rest, config.tile_px)
                scatters[r] += own
                gum_scatters[r] += gum
        return Solution(poses.copy(), outline, centres, scatters, gum_scatters, visible)

    def _match(self, pose: Array, view: View, r: int, rendering: Rendering, c: int, reach: float) -> _Match:
        config, depths = self.config, rendering.depths[c]
        samples, silhouettes = rendering.samples(self.contours[r], r, c, pose)
        visible = float(samples[:, LENGTH].sum())
        search_limits = (reach, config.overlap_tolerance_mm, config.normal_cosine)
        if view.edges is None:
            distances = np.empty(len(samples))
            search_edges(samples, view.masks[r], view.masks[1 - r], depths[1 - r], *search_limits, distances)
        else:
            drawn = Drawn(rendering.labels[c][r], rendering.labels[c][1 - r], depths[1 - r])
            distances, weights = view.edges.search(samples, silhouettes, r, drawn, search_limits)
            hidden = np.isnan(weights)
            visible -= float(samples[hidden, LENGTH].sum())
            weights[hidden] = 0.0
            samples[:, LENGTH] *= weights
        return samples, distances - samples[:, HABITS] @ view.habits[r], visible

    def _final_gate(self, distances: list[Array], gate: float) -> float:
        """Return the Tukey gate for the spread of the residuals (median absolute deviation)."""
        d = np.concatenate(distances) if distances else np.empty(0)
        d = np.abs(d[np.isfinite(d)])
        d = np.sort(d[d < gate])
        if len(d) < 20:
            return gate
        median = 0.5 * float(d[(len(d) - 1) // 2] + d[len(d) // 2])  # several times faster than np.median
        low, high = self.config.final_gate_px
        return min(max(self.config.gate_sigmas * 1.4826 * median, low), high)

    def _motion_mm(self, step: Array) -> float:
        """Return an upper bound on the motion of crown vertices under twists about the centres [mm]."""
        return max(
            float(np.linalg.norm(step[r, :3]) * self.scans[r].radius_mm + np.linalg.norm(step[r, 3:])) for r in ARCHES
        )


def _towards_gum(scans: Sequence[Scan]) -> list[Array | None]:
    """Return the unit vector towards the gum of each arch, in scan coordinates; None for a scan with gum."""
    shown = [scan.shows_gum for scan in scans]
    if all(shown):
        return [None, None]
    up = bite_normal(scans[0].crown_vertices(), scans[1].crown_vertices())
    return [None if gum else way * up for gum, way in zip(shown, (1.0, -1.0), strict=True)]


class ParallelMap:
    """A parallel `map` for short tasks; it wakes one thread per core instead of one per item.

    The calling thread works too. Tasks of the tracker take about a millisecond; waking a thread takes a tenth of that.
    """

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self._more_threads = (os.cpu_count() or 1) - 1

    def __call__(self, function: Callable[[Item], Result], items: Iterable[Item], /) -> list[Result]:
        """Return the results in the order of the items; if a task fails, raise its error and start no further task."""
        left = deque(enumerate(items))
        results: dict[int, Result] = {}

        def work() -> None:
            while left:
                try:
                    k, item = left.popleft()
                except IndexError:  # another thread has taken the last item
                    return
                try:
                    results[k] = function(item)
                except BaseException:
                    left.clear()
                    raise

        others = [self._executor.submit(work) for _ in range(min(len(left) - 1, self._more_threads))]
        try:
            work()
        finally:
            started = [other for other in others if not other.cancel()]
            wait(started)
        for other in started:
            other.result()
        return [results[k] for k in sorted(results)]
