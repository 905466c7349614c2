"""Search for the world scale at which masks and scans agree best.

Images of a calibration board do not reveal the size of its squares. A wrong square size scales the whole world, and
then no pose of the teeth fits their masks in several views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera
from jawusd.tracking.config import Mapper, TrackingConfig
from jawusd.tracking.contour.quality import arch_fit, penalised_score_px, uncovered_px
from jawusd.tracking.contour.scan import ARCH_NAMES, prepare_scan, teeth_centre
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import masked_sources
from jawusd.tracking.initialization.first_frame import CLEAR_FIT
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.scan_checks import check_occlusion
from jawusd.tracking.initialization.start_search import StartSearch

# World scales at which poses are searched for from scratch: from the nearest one, the fit increases monotonically up to
# the true scale.
_STARTS = (1.0, 1 / 1.15, 1.15, 1 / 1.32, 1.32)
_STEPS = (0.03, 0.01, 0.005)
_SMALLEST, _LARGEST = 0.5, 2.0
_SURVEYED, _FRAMES_TRIED = 24, 2
_MOST_SIZES = 64  # maximum number of evaluations of a hill climb: the range in the widest steps, and the finer steps


def seen_size(
    capture: Capture,
    cameras: Sequence[Camera],
    offsets: Mapping[str, int],
    meshes: Sequence[Mesh],
    map_: Mapper = map,
) -> float:
    """Return the size of the teeth in the calibrated world relative to the scans, accurate to 0.5 %.

    The cameras are calibrated up to the scale of the world; other arguments are as for `find_start`.

    Raises:
        TrackingError: too few masks, or the scans do not fit the masks at any size.
        CaptureError: a mask cannot be read.
    """
    solver = ContourSolver(tuple(prepare_scan(m, n) for m, n in zip(meshes, ARCH_NAMES, strict=True)), TrackingConfig())
    T_anatomical_scan, _ = check_occlusion(solver.scans, capture.anatomy.T_anatomical_skull)
    sizes = _Sizes(capture, cameras, offsets, StartSearch(meshes, solver, T_anatomical_scan, map_))
    frames = sizes.footage(1.0).survey(None, _SURVEYED).promising(_FRAMES_TRIED).tolist()
    best_fit = -np.inf
    for frame in frames:
        for start in _STARTS:
            try:
                poses = sizes.search.at(sizes.footage(start), frame).poses
            except TrackingError:
                continue
            size, fit = sizes.climb(frame, start, poses)
            if fit >= CLEAR_FIT:
                return 1.0 / size  # teeth that appear too small indicate a world that is too small by the same factor
            best_fit = max(best_fit, fit)
    raise TrackingError(
        f"the scans do not fit the masks of frames {', '.join(map(str, frames))} at any size from {_SMALLEST:g} to "
        f"{_LARGEST:g} (the best fit is {best_fit:.2f}; at least {CLEAR_FIT} is needed)"
    )


class _Sizes:
    """Aligns the teeth in a calibrated world that is scaled by a factor."""

    def __init__(
        self, capture: Capture, cameras: Sequence[Camera], offsets: Mapping[str, int], search: StartSearch
    ) -> None:
        self._capture, self._cameras, self._offsets = capture, cameras, offsets
        self.search, self._solver = search, search.solver

    def footage(self, size: float) -> Footage:
        """Return the masks, viewed by cameras whose positions are multiplied by a factor."""
        cameras = {}
        for camera in self._cameras:
            T = camera.T_cam_world.copy()
            T[:3, 3] *= size
            cameras[camera.name] = replace(camera, T_cam_world=T)
        sources = masked_sources(self._capture.cameras, cameras, self._offsets)
        return Footage(sources, cameras, self._offsets, self._capture.frames)

    def climb(self, frame: int, size: float, poses: Array) -> tuple[float, float]:
        """Return the size with the best fit, by hill climbing, and the fit of the worse arch, -inf without an end."""
        objective, fit, poses = self._fitted(frame, size, poses, size)
        left = _MOST_SIZES
        beside = {}
        for step in _STEPS:
            beside = {0: objective}
            for direction in (1, -1):
                while left > 0:
                    left -= 1
                    there = size * (1 + step) ** direction
                    if not _SMALLEST <= there <= _LARGEST:
                        break
                    other = self._fitted(frame, there, poses, size)
                    if other[0] <= objective:
                        beside[direction] = other[0]
                        break
                    beside = {-direction: objective}
                    size, (objective, fit, poses) = there, other
        if left == 0:
            return size, -np.inf
        if {1, -1} <= beside.keys():  # vertex of a parabola through the objectives at the last size and its neighbours
            bend = beside[1] - 2 * objective + beside[-1]
            size *= (1 + _STEPS[-1]) ** (0.5 * (beside[-1] - beside[1]) / bend if bend < 0 else 0.0)
        return size, fit

    def _fitted(self, frame: int, size: float, poses: Array, size_of_poses: float) -> tuple[float, float, Array]:
        """Align at one size, from poses at another; return objective, fit of the worse arch, and poses."""
        scans, config = self._solver.scans, self._solver.config
        start = poses.copy()
        start[:, :3, 3] *= size / size_of_poses
        with self.footage(size).views(teeth_centre(scans, start), config.working_px_per_mm) as masks:
            views = masks.at(frame)
        end = self._solver.solve(start, views, config.wide_gates_px)
        uncovered, _ = uncovered_px(scans, end.poses, views)
        objective = float(penalised_score_px(end, uncovered, config.uncovered_price).sum())
        return objective, float(arch_fit(scans, end, views, config.uncovered_price).min()), end.poses
