"""The start of a solve with one camera: a search for head and jaw in its masks.

In a single view, only apparent size and perspective determine the distance, and lips hide an unknown part of the teeth.
The search therefore tries all distances at which teeth could fill the masks, with all orientations, and then tries jaw
poses for the most promising head poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.evaluator import JawRig
from jawusd.formats.mesh import Mesh
from jawusd.geometry import make_transform, se3_inverse, transform_point, transform_points
from jawusd.meshes.raster import count_bits
from jawusd.tracking.config import Mapper
from jawusd.tracking.contour.quality import arch_fit
from jawusd.tracking.contour.scan import ARCH_NAMES, ARCHES
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View
from jawusd.tracking.initialization.first_frame import CLEAR_FIT
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.pose_search import (
    Candidate,
    Grid,
    ShiftCorrelation,
    coarse_scan,
    distinct,
    hinge_at_front,
    search_arch,
)
from jawusd.tracking.initialization.start_search import guessed_axes
from jawusd.tracking.performance.attempts import LARGEST_SIGMA, Attempts, Instant
from jawusd.tracking.performance.coordinates import Coordinates, Pose
from jawusd.tracking.performance.instant import Expected, InstantSolver

_PX_PER_MM = 2.0
# assumed distance of the teeth along the optical axis, which determines the resolution of the views
_ANYWHERE_MM = 200.0
# Number of frames surveyed for large masks; number of frames after which an acceptable start ends the search; and
# maximum number of frames searched.
_SURVEYED, _FRAMES_TRIED, _MOST_TRIED = 24, 4, 10
# Candidate widths of the visible teeth [mm], from the front teeth to a whole arch; they determine the distance.
_WIDTHS_MM = 22.0 * 1.1 ** np.arange(14)
_USUAL_WIDTH_MM = 42.0
# A side camera sees more of one side of the arch, so the centre of its mask lies up to 16 mm beside the front teeth (18
# cameras of 6 synthetic persons). There, lips that hide most of the upper teeth turn the line between both masks by up
# to 37 degrees (12 head-mounted cameras of 12 synthetic persons).
_GRID = Grid(
    yaw_rad=np.radians(np.arange(-60, 61, 10.0)),
    pitch_rad=np.radians(np.arange(-32, 33, 8.0)),
    roll_rad=np.radians(np.arange(-40, 41, 8.0)),
    reach_mm=(18.0, 7.5, 0.1),
)
_SHIFTS = np.stack(np.meshgrid(*[np.arange(-3, 3.1, 1.5)] * 2, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
# Ratio of the areas of the lower and the upper mask above which poses of the lower teeth are searched, not of the upper
# ones: a strip of teeth below the lip does not determine the tilt of the head. Exceeded in single frames of three of 36
# synthetic subjects, and in many frames of four, all of whom are found with the lower teeth.
_MOSTLY_HIDDEN = 2.0
#: Number of jaw poses, over the whole range, that searches try.
JAWS = 32
# Numbers per candidate width of poses of an arch kept, each with all jaw poses, and of pairs of head and jaw poses
# aligned in a few steps; numbers of pairs aligned fully, and at the working resolution. Each distance has its share,
# since masks rank distances poorly before poses are aligned: near teeth cover more of them.
_HEADS, _TRIED, _FINALISTS, _WINNERS = 17, 12, 24, 5
# Penalty per crown pixel outside the mask, in px of contour [1/px]: low, since lips may hide crowns.
_OUTSIDE_PRICE = 0.05
_DISTINCT_MM = 3.0  # minimum distance between head poses that are kept [mm], as mean displacement of the teeth
_LEAST_FIT = 0.1  # fit of the worse arch below which a start is rejected [-]; it is accepted at once from CLEAR_FIT on
_NEARBY = LARGEST_SIGMA / 3.0  # standard deviations of the true pose about a candidate pose [rad, mm, mm]


@dataclass(frozen=True, eq=False)
class FoundPose:
    """A start: frame, pose, and the fit of the worse arch [-]."""

    frame: int
    pose: Pose
    fit: float


class SingleStart:
    """A search for the poses of head and jaw in frames of one camera."""

    def __init__(
        self, meshes: Sequence[Mesh], solver: ContourSolver, jaw: JawRig, T_anatomical_scan: Array, map_: Mapper = map
    ) -> None:
        """Prepare coarse scans; `T_anatomical_scan` (4, 4) maps the scan frame to (left, up, front) axes."""
        solver = solver.exact()
        self._jaw, self._map, self._config = jaw, map_, solver.config
        self._coarse = tuple(coarse_scan(mesh, name) for mesh, name in zip(meshes, ARCH_NAMES, strict=True))
        self._hinges = [hinge_at_front(scan.crown_vertices(), T_anatomical_scan) for scan in self._coarse]
        weight = np.full(2, 1.0 / solver.config.typical_noise_px3)
        # Residual gates scale with the resolution. Otherwise, they would be so wide in mm that teeth half hidden by
        # lips would be fitted to their visible part, as if the teeth were smaller.
        small = self._config.with_gates_scaled(_PX_PER_MM / self._config.working_px_per_mm)
        rough = ContourSolver(self._coarse, small)
        self._rough = Attempts(InstantSolver(rough, Coordinates(jaw, self._coarse)), weight)
        self._fine = Attempts(InstantSolver(solver, Coordinates(jaw, solver.scans)), weight)
        self._jaws = spread_out(jaw, JAWS)

    def find(self, footage: Footage) -> FoundPose:
        """Return the first start that fits clearly; without one, the start that fits best.

        Raises:
            TrackingError: the teeth were not found in any of the frames tried.
            CaptureError: a mask cannot be read.
        """
        best: FoundPose | None = None
        frames = footage.survey(None, _SURVEYED).promising(_MOST_TRIED).tolist()
        for tried, frame in enumerate(frames, 1):
            found = self.at(footage, frame)
            if found is not None and (best is None or found.fit > best.fit):
                best = found
            if best is not None and best.fit >= (CLEAR_FIT if tried < _FRAMES_TRIED else _LEAST_FIT):
                break
        if best is None or best.fit < _LEAST_FIT:
            raise TrackingError(
                f"the teeth were not found in the masks of the single camera; {len(frames)} frames were tried "
                f"({', '.join(map(str, frames))})",
                hint="Check that the rig is of this subject, and check focal length and masks; start the shot with the "
                "teeth visible, or add a second camera.",
            )
        return best

    def at(self, footage: Footage, frame: int) -> FoundPose | None:
        """Return the best start in a frame, or None if no pose fits."""
        camera = footage.cameras[footage.sources[0].name]
        anywhere = camera.centre_world() + _ANYWHERE_MM * camera.T_cam_world[2, :3]
        with footage.views(anywhere, _PX_PER_MM) as masks:
            (view,) = masks.at(frame)
        if not view.present.all():
            return None
        places = _places(view)
        usual = int(np.argmin(np.abs(_WIDTHS_MM - _USUAL_WIDTH_MM)))
        with footage.views(places[usual].mean(0), _PX_PER_MM) as masks:
            views = masks.at(frame)
        instant = self._rough.instant(views)
        ends = [self._after(pose, instant, self._rough.config.wide_gates_px) for pose in self._searched(views, places)]
        ends = sorted(ends, key=_descending)[:_WINNERS]
        best: FoundPose | None = None
        px_per_mm = self._config.working_px_per_mm
        for _, pose in ends:
            with footage.views(transform_point(pose.head, self._coarse[0].centre), px_per_mm) as masks:
                views = masks.at(frame)
            end = self._refined(pose, views, frame)
            if end is not None and (best is None or end.fit > best.fit):
                best = end
        return best

    def _searched(self, views: Sequence[View], places: Array) -> list[Pose]:
        """Return the most promising poses of head and jaw: poses of one arch, each with the jaw poses that fit best."""
        instant, few = self._rough.instant(views), self._rough.config.trial_gates_px
        upper_px, lower_px = ((mask > 127).sum() for mask in views[0].masks)
        arch = int(lower_px > _MOSTLY_HIDDEN * upper_px)
        tried: list[tuple[float, Pose]] = []
        for pair in places:
            base = make_transform(guessed_axes(pair, views[0].eye[None]), pair[arch])
            scan, hinge = self._coarse[arch], self._hinges[arch]
            found = search_arch(scan, arch, views, _PX_PER_MM, base, hinge, _GRID, self._map)
            found = [
                replace(one, objective=one.objective - self._outside_price(arch, one.pose, views[0])) for one in found
            ]
            found = sorted(found, key=lambda one: -one.objective)
            kept = distinct(found, scan.probes[::20], _DISTINCT_MM, _HEADS)
            pairs = sorted(
                (pair for some in self._map(partial(self._with_jaws, views, arch), kept) for pair in some),
                key=_descending,
            )
            tried += [(self._after(pose, instant, few)[0], pose) for _, pose in pairs[:_TRIED]]
        return [pose for _, pose in sorted(tried, key=_descending)[:_FINALISTS]]

    def _with_jaws(self, views: Sequence[View], arch: int, found: Candidate) -> list[tuple[float, Pose]]:
        """Return the two most promising jaw poses for the pose of an arch, with the objectives of both arches."""
        other, motions = 1 - arch, self._jaw.pose(self._jaws)
        poses = found.pose @ (se3_inverse(motions) if arch else motions)
        place = transform_point(found.pose, self._coarse[other].centre)
        correlation = ShiftCorrelation(views[0], other, _PX_PER_MM, _SHIFTS @ found.pose[:3, :3].T, place)
        prices = np.array([self._outside_price(other, pose, views[0]) for pose in poses])
        scores = correlation.objectives(self._coarse[other], poses).max(axis=1) - prices
        best = np.argsort(scores)[::-1][:2]
        heads = poses if arch else np.broadcast_to(found.pose, poses.shape)
        return [(found.objective + scores[k], Pose(heads[k], self._jaws[k])) for k in best]

    def _outside_price(self, arch: int, pose: Array, view: View) -> float:
        """Return the penalty for crowns outside the mask, without which teeth near the camera would cover any mask."""
        bits = self._coarse[arch].silhouette(view.matrix @ pose, view.masks.shape[1:])
        return _OUTSIDE_PRICE * max(int(count_bits(bits)) - int((view.masks[arch] > 127).sum()), 0)

    def _after(self, pose: Pose, instant: Instant, gates: Sequence[float]) -> tuple[float, Pose]:
        """Return the objective of both arches after some alignment steps [px], and the pose reached."""
        expected = Expected(pose, _NEARBY**-2.0)
        trial = self._rough.attempt(pose, expected, instant, instant.present, gates)
        arches = self._rough.instants.coordinates.arches(trial.pose)
        outside = sum(self._outside_price(r, arches[r], instant.views[0]) for r in ARCHES)
        price = self._config.uncovered_price * self._config.working_px_per_mm / _PX_PER_MM
        return trial.objective(price) - outside, trial.pose

    def _refined(self, pose: Pose, views: Sequence[View], frame: int) -> FoundPose | None:
        """Align a pose at working resolution; return None if an arch is not found.

        If only one arch is found, other jaw poses are tried around it.
        """
        fine, instant = self._fine, self._fine.instant(views)
        found = fine.near(pose, instant)
        if found.found.sum() == 1:
            arch = int(found.found.argmax())
            starts = [fine.instants.coordinates.with_jaw(found.pose, d, arch) for d in self._jaws]
            best = fine.best_starts(starts, _NEARBY**-2.0, instant)
            found = max((fine.near(start, instant) for start in best), key=lambda fit: fit.objective_px)
        if found.solution is None or not found.found.all():
            return None
        fit = arch_fit(self._fine.instants.solver.scans, found.solution, views, self._config.uncovered_price)
        return FoundPose(frame, found.pose, float(fit.min()))


def _descending(entry: tuple[float, Pose]) -> float:
    return -entry[0]


def spread_out(jaw: JawRig, count: int) -> Array:
    """Choose captured jaw parameters, including closed teeth, by farthest-point sampling [mm], shape (<= count, 3)."""
    d = np.vstack([np.zeros(3), jaw.captured_d])
    tips = transform_points(jaw.pose(d), jaw.landmarks[:1])[:, 0]
    chosen, distance = [0], np.linalg.norm(tips - tips[0], axis=1)
    while len(chosen) < min(count, len(d)):
        farthest = int(distance.argmax())
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(tips - tips[farthest], axis=1))
    return np.asarray(d[chosen], np.float64)


def _places(view: View) -> Array:
    """Return the 3-D centres of both arches [mm], shape (W, 2, 3), for every candidate width of the visible teeth."""
    pixels = [np.argwhere(mask > 127)[:, ::-1] for mask in view.masks]
    middles = np.array([[*of_arch.mean(0), 1.0] for of_arch in pixels])
    # The camera may be turned about its axis, so the width is measured along the arches.
    _, axes = np.linalg.eigh(sum(np.cov(of_arch.T) * len(of_arch) for of_arch in pixels))
    width_px = float(np.ptp(np.concatenate(pixels) @ axes[:, 1]))
    # If the third row of the camera matrix has unit length, the scale factor along a ray is the depth.
    matrix = view.matrix / np.linalg.norm(view.matrix[2, :3])
    rays = np.linalg.solve(matrix[:, :3], middles.T).T
    focal_px = float(np.linalg.norm(np.cross(matrix[0, :3], matrix[2, :3])))
    depths = focal_px * _WIDTHS_MM / max(width_px, 1.0)
    return np.asarray(view.eye + depths[:, None, None] * rays, np.float64)
