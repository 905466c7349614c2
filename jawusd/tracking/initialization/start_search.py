"""Search for the poses of both arches on single frames: a coarse global search, then refinement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.mesh import Mesh
from jawusd.geometry import make_transform, se3_inverse, so3_exp, so3_log, transform_point, transform_points
from jawusd.tracking.config import Mapper
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.quality import arch_fit, penalised_score_px, uncovered_px
from jawusd.tracking.contour.scan import ARCH_NAMES, ARCHES, prepare_scan, teeth_centre
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.pose_search import (
    Candidate,
    Grid,
    coarse_scan,
    distinct,
    hinge_at_front,
    search_arch,
)

_PX_PER_MM = 2.0  # resolution: a pixel is a third of the motion of the canines between neighbouring orientations
_FINALISTS = 5  # number of poses per arch that are refined
# Number of poses per arch that are combined to pairs, number of pairs that are aligned by a few steps, number of these
# that are refined, and penalty for the squared distance of the lower arch from its nearest position in a typical jaw
# [px/mm^2]. Arches that are shifted along themselves by a tooth fit images from the sides almost as well as correct
# ones.
_COMBINED, _PAIRS, _REFINED, _ATYPICAL_PRICE = 80, 48, 4, 4.0
_DISTINCT_MM = 2.0  # minimum distance of distinct poses [mm]: closer ones converge to the same local minimum
# Rotations and translations around a guess in which the teeth face the cameras with the upper arch above the lower one.
# Lateral movement and the lips mainly bias the roll of the guess. With retracted lips, the centre of the masks lies up
# to 20 mm behind the front teeth.
_GRID = Grid(
    yaw_rad=np.radians(np.arange(-50, 51, 10.0)),
    pitch_rad=np.radians(np.arange(-40, 41, 10.0)),
    roll_rad=np.radians(np.arange(-50, 51, 10.0)),
    reach_mm=(13.0, 9.0, 22.5),
)
# Rotations and translations around picked poses: possible errors after four careless clicks close together.
_NEAR_GRID = Grid(
    yaw_rad=np.radians(np.arange(-20, 21, 10.0)),
    pitch_rad=np.radians(np.arange(-20, 21, 10.0)),
    roll_rad=np.radians(np.arange(-20, 21, 10.0)),
    reach_mm=(6.0, 6.0, 6.0),
)
# Height and depth [mm] of the hinge axis relative to the front teeth, and jaw openings for placing one arch relative to
# the other: downward motion of the front teeth, upward and forward motion of the condyles [mm]. Some jaws open by pure
# rotation at first; the condyles of others slide forward from the first millimetre. A single arch also fits when
# shifted along itself by one tooth, but jaws do not move that way.
_CONDYLES_MM = (40.0, -90.0)
_OPENINGS_MM = (
    *((opening, 0.0, 0.0) for opening in (0.0, 6.0, 14.0, 24.0, 36.0)),
    *((14.0, -3.0, 4.0), (24.0, -6.0, 8.0), (36.0, -7.0, 11.5), (48.0, -8.0, 14.0)),
)
# Openings of typical jaws, by rotation alone and with condyles that slide forward in proportion.
_TYPICAL_MM = [(mm, -slid * mm, 1.8 * slid * mm) for mm in np.arange(0.0, 50.0, 4.0) for slid in (0.0, 0.17)]
_WIDEST_JAW_RAD = 0.8  # maximum rotation between the arches [rad]
_FARTHEST_JAW_MM = 75.0  # maximum distance between the front teeth of the arches [mm]


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The result of a search on a frame."""

    poses: Array  # T_world_upper, T_world_lower, shape (2, 4, 4)
    objective_px: float  # matched contour of both arches less the penalty for uncovered mask [px]
    fits: Array  # `arch_fit` of both arches [-], shape (2,)

    @property
    def fit(self) -> float:
        """Fit of the worse arch [-]."""
        return float(self.fits.min())


class StartSearch:
    """Searches for the poses of both arches on single frames."""

    def __init__(
        self,
        meshes: Sequence[Mesh],
        solver: ContourSolver,
        T_anatomical_scan: Array,
        map_: Mapper = map,
    ) -> None:
        """Prepare coarse scans; `T_anatomical_scan` (4, 4) maps the scan frame to (left, up, front) axes."""
        self.solver, self._map = solver.exact(), map_
        self._config = self.solver.config
        self._meshes, self._T_anatomical_scan = meshes, T_anatomical_scan
        self._coarse = tuple(coarse_scan(m, n) for m, n in zip(meshes, ARCH_NAMES, strict=True))
        self._hinges = [hinge_at_front(s.crown_vertices(), T_anatomical_scan) for s in self._coarse]
        self._coarse_solver = ContourSolver(self._coarse, self._config)
        crowns, probes = self._coarse[1].crown_vertices(), self._coarse[1].probes
        self._jaws = _opened(crowns, T_anatomical_scan, _OPENINGS_MM)
        typical = _opened(crowns, T_anatomical_scan, _TYPICAL_MM)
        self._typical = np.stack([transform_points(jaw, probes) for jaw in typical])

    def mirrored(self) -> StartSearch:
        """Return a search with mirrored scans, left and right exchanged."""
        T, meshes = self._T_anatomical_scan, []
        for mesh in self._meshes:
            points = transform_points(T, mesh.vertices) * [-1.0, 1.0, 1.0]
            faces = np.ascontiguousarray(mesh.faces[:, ::-1])
            meshes.append(replace(mesh, vertices=transform_points(se3_inverse(T), points), faces=faces))
        return self._of(meshes, T)

    def scaled(self, factor: float) -> StartSearch:
        """Return a search with all lengths of the scans multiplied by a factor [-]."""
        meshes = [replace(mesh, vertices=factor * mesh.vertices) for mesh in self._meshes]
        T = self._T_anatomical_scan.copy()
        T[:3, 3] *= factor
        return self._of(meshes, T)

    def _of(self, meshes: Sequence[Mesh], T_anatomical_scan: Array) -> StartSearch:
        """Return a search with other scans."""
        scans = [prepare_scan(mesh, name) for mesh, name in zip(meshes, ARCH_NAMES, strict=True)]
        solver = ContourSolver((scans[0], scans[1]), self._config)
        return StartSearch(meshes, solver, T_anatomical_scan, self._map)

    def at(self, footage: Footage, frame: int) -> SearchResult:
        """Return the best poses on a frame.

        Raises TrackingError for too few masks, or without an anatomically possible pair of poses.
        """
        survey = footage.survey((frame, frame + 1), 1)
        places = survey.places()[0]
        with footage.views(places.mean(0), _PX_PER_MM) as masks:
            views = masks.at(frame)
        axes = guessed_axes(places, survey.eyes)
        bases = [make_transform(axes, place) for place in places]
        found = [self._searched(r, views, bases[r], _GRID, _COMBINED) for r in ARCHES]
        finalists = [[candidate.pose for candidate in some[:_FINALISTS]] for some in found]
        return self._settled(finalists, self._typical_pairs(*found), views, footage, frame)

    def near(self, footage: Footage, frame: int, poses: Array) -> SearchResult:
        """Return the best poses in a frame, searched near given ones (2, 4, 4); raises TrackingError as `at` does."""
        with footage.views(transform_point(poses[0], self._coarse[0].centre), _PX_PER_MM) as masks:
            views = masks.at(frame)
        finalists = []
        for r in ARCHES:
            base = poses[r] @ np.linalg.inv(self._hinges[r])
            found = self._searched(r, views, base, _NEAR_GRID, _FINALISTS)
            finalists.append([poses[r], *(candidate.pose for candidate in found)])
        return self._settled(finalists, [], views, footage, frame)

    def _searched(self, r: int, views: Sequence[View], base: Array, grid: Grid, most: int) -> list[Candidate]:
        """Return up to `most` poses of an arch that are distinct from one another, the best ones first."""
        found = search_arch(self._coarse[r], r, views, _PX_PER_MM, base, self._hinges[r], grid, self._map)
        return distinct(found, self._coarse[r].probes, _DISTINCT_MM, most)

    def _typical_pairs(self, upper: Sequence[Candidate], lower: Sequence[Candidate]) -> list[Array]:
        """Return the pairs of poses, shape (2, 4, 4) each, that fit best and are similar to those of typical jaws."""
        jaws = np.stack([[se3_inverse(u.pose) @ v.pose for v in lower] for u in upper])
        places = transform_points(jaws, self._coarse[1].probes)
        atypical_mm = np.min([np.linalg.norm(places - one, axis=-1).mean(-1) for one in self._typical], axis=0)
        fit = np.array([[u.objective + v.objective for v in lower] for u in upper])
        order = np.argsort(_ATYPICAL_PRICE * atypical_mm**2 - fit, axis=None)[:_PAIRS]
        return [
            np.stack([upper[u].pose, lower[v].pose]) for u, v in zip(*np.unravel_index(order, fit.shape), strict=True)
        ]

    def _settled(
        self,
        finalists: Sequence[Sequence[Array]],
        pairs: Sequence[Array],
        views: Sequence[View],
        footage: Footage,
        frame: int,
    ) -> SearchResult:
        """Return the best pair, of the finalists or of given pairs, refined at working resolution."""
        pairs = self._refined_pairs(finalists, pairs, views)
        if not pairs:
            raise TrackingError("the best poses of the two arches are anatomically impossible", frame=frame)
        with footage.views(teeth_centre(self._coarse, pairs[0]), self._config.working_px_per_mm) as masks:
            views = masks.at(frame)
        ends = [self.solver.solve(poses, views, self._config.wide_gates_px) for poses in pairs]
        objective = [self._objective(self.solver, s, views).sum() for s in ends]
        best = int(np.argmax(objective))
        fits = arch_fit(self.solver.scans, ends[best], views, self._config.uncovered_price)
        return SearchResult(ends[best].poses, float(objective[best]), fits)

    def _refined_pairs(
        self, finalists: Sequence[Sequence[Array]], pairs: Sequence[Array], views: Sequence[View]
    ) -> list[Array]:
        """Refine the finalists and pairs coarsely; return up to four anatomically possible pairs, shape (2, 4, 4)."""

        def aligned(starts: Sequence[Array], gates_px: Sequence[float]) -> list[tuple[float, Array]]:
            ends = [self._coarse_solver.solve(pair, views, gates_px) for pair in starts]
            found = [(float(self._objective(self._coarse_solver, end, views).sum()), end.poses) for end in ends]
            return sorted(found, key=lambda pair: -pair[0])

        def ranked(r: int, poses: Sequence[Array], others: Array) -> list[tuple[float, Array]]:
            ends = []
            for pose in poses:
                start = np.stack([others if q != r else pose for q in ARCHES])
                end = self._coarse_solver.solve(start, views, self._config.wide_gates_px)
                ends.append((float(self._objective(self._coarse_solver, end, views)[r]), end.poses[r]))
            return sorted(ends, key=lambda e: -e[0])

        alone = [ranked(r, finalists[r], finalists[1 - r][0]) for r in ARCHES]
        upper, lower = (ends[0][1] for ends in alone)
        alone[0] += ranked(0, [lower @ se3_inverse(jaw) for jaw in self._jaws], lower)
        alone[1] += ranked(1, [upper @ jaw for jaw in self._jaws], upper)
        found = [(u[0] + v[0], np.stack([u[1], v[1]])) for u in alone[0] for v in alone[1]]
        best = [poses for _, poses in aligned(pairs, self._config.trial_gates_px)[:_REFINED]]
        found += aligned(best, self._config.wide_gates_px)
        possible = [pair for pair in found if self._possible(pair[1])]
        return [poses for _, poses in sorted(possible, key=lambda pair: -pair[0])[:4]]

    def _possible(self, poses: Array) -> bool:
        """Return whether the poses of the arches are anatomically possible."""
        turn = so3_log(poses[0, :3, :3].T @ poses[1, :3, :3])
        fronts = [(poses[r] @ np.linalg.inv(self._hinges[r]))[:3, 3] for r in ARCHES]
        gap_mm = np.linalg.norm(fronts[1] - fronts[0])
        return bool(np.linalg.norm(turn) < _WIDEST_JAW_RAD and gap_mm < _FARTHEST_JAW_MM)

    def _objective(self, solver: ContourSolver, solution: Solution, views: Sequence[View]) -> Array:
        """Return the matched contour less the penalty for uncovered mask per arch [px], shape (2,)."""
        uncovered, _ = uncovered_px(solver.scans, solution.poses, views)
        # The penalty is per area, and pixels of coarse images are larger.
        price = self._config.uncovered_price
        if solver is self._coarse_solver:
            price *= self._config.working_px_per_mm / _PX_PER_MM
        return penalised_score_px(solution, uncovered, price).sum(1)


def _opened(crowns: Array, T_anatomical_scan: Array, openings_mm: Sequence[tuple[float, float, float]]) -> list[Array]:
    """Return T_upper_lower (4, 4) of jaws opened as in `_OPENINGS_MM`; `crowns` (N, 3) are those of the lower scan."""
    points = transform_points(T_anatomical_scan, crowns)
    up, front = _CONDYLES_MM
    hinge = points[points[:, 2].argmax()] * [0.0, 1.0, 1.0] + [0.0, up, front]
    out = []
    for opening, slid_up, slid_front in openings_mm:
        turn = so3_exp(np.array([(opening + slid_up) / np.hypot(up, front), 0.0, 0.0]))
        moved = make_transform(turn, hinge - turn @ hinge + [0.0, slid_up, slid_front])
        out.append(se3_inverse(T_anatomical_scan) @ moved @ T_anatomical_scan)
    return out


def guessed_axes(places: Array, eyes: Array) -> Array:
    """Return a guess of the left, up and front axes of the teeth in the world, as columns, shape (3, 3).

    `places` (2, 3) are the centres of the upper and the lower masks, `eyes` (C, 3) those of the cameras [mm].
    """
    rays = eyes - places.mean(0)
    front = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).mean(0)
    front /= np.linalg.norm(front)
    up = places[0] - places[1]
    up -= front * (front @ up)
    up /= np.linalg.norm(up)
    return np.stack([np.cross(up, front), up, front], axis=1)
