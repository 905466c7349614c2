"""The solve of a shot (start pose, first pass in both directions, joint refinement), or of skin alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import Mesh
from jawusd.formats.performance import Performance
from jawusd.geometry import Camera, transform_points
from jawusd.tracking.config import Mapper, TrackingConfig
from jawusd.tracking.contour.quality import arch_fit
from jawusd.tracking.contour.scan import Scan, prepare_scan, teeth_centre
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews, View, masked_sources
from jawusd.tracking.follow import Begin, TwoWays
from jawusd.tracking.initialization.first_frame import LEAST_FIT
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.scan_checks import check_occlusion
from jawusd.tracking.initialization.start import find_start
from jawusd.tracking.performance.attempts import Attempts, FrameFit, usual_of
from jawusd.tracking.performance.coordinates import HEAD, Coordinates, Pose
from jawusd.tracking.performance.forward import ForwardPass
from jawusd.tracking.performance.instant import InstantSolver, quick, whole
from jawusd.tracking.performance.results import performance_of
from jawusd.tracking.performance.single_start import SingleStart
from jawusd.tracking.performance.skin import SkinOf, jaw_of_skin
from jawusd.tracking.performance.smoother import Smoothed, Smoother
from jawusd.tracking.performance.views import KeptViews, Views

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Shot:
    """Input of a solve."""

    views: Views
    camera_names: tuple[str, ...]  # in the order of the views
    frames: tuple[int, int]  # range of reference-camera frames, end exclusive
    start_frame: int
    start: Pose
    fps: float
    fixed_head: bool = False  # whether the cameras are head-mounted, so that the head pose is constant
    free_focal: bool = False  # whether to estimate the focal lengths
    skin: SkinOf | None = None  # jaw parameters estimated from facial skin


def solve_performance(
    jaw: JawRig,
    scans: Sequence[Scan],
    shot: Shot,
    config: TrackingConfig | None = None,
    *,
    progress: Progress | None = None,
) -> Performance:
    """Solve head pose and jaw parameters of every frame of a shot.

    Args:
        scans: prepared scans of the upper and lower teeth.
        progress: called after each frame with the number of frames done and the total.

    Raises:
        TrackingError: the teeth do not fit the masks of the start frame.
        CaptureError: a mask cannot be read.
    """
    solver = ContourSolver(scans, config or TrackingConfig())
    take = _Take(jaw, solver, shot, progress or (lambda done, total: None))
    take.first_pass()
    smoothed = take.second_pass()
    return performance_of(
        jaw,
        take.coordinates.pivot,
        sorted(take.fits),
        smoothed,
        shot.camera_names,
        shot.fps,
        free_focal=shot.free_focal,
    )


class _Take:
    """A shot being solved; `fits` are the frame fits so far, by frame number."""

    def __init__(self, jaw: JawRig, solver: ContourSolver, shot: Shot, progress: Progress) -> None:
        self._jaw, self._config, self._shot, self._progress = jaw, solver.config, shot, progress
        self.coordinates = Coordinates(jaw, solver.scans)
        self._quick, self._full = (InstantSolver(one, self.coordinates) for one in (quick(solver), whole(solver)))
        self._views, self._scans = KeptViews(shot.views), solver.scans
        self._weight = np.full(2, 1.0 / self._config.typical_noise_px3)
        self.fits: MutableMapping[int, FrameFit] = {}

    def first_pass(self) -> None:
        """Align all frames in both directions from the start; align frames again whose poses may be wrong."""
        first, stop = self._shot.frames
        start = self._shot.start_frame
        attempts = Attempts(self._quick, self._weight)
        views = self._views.at(start)
        begun = attempts.near(self._shot.start, attempts.instant(views))
        if not begun.found.all() or self._fit(begun, views).min() < LEAST_FIT:
            raise TrackingError(
                "the teeth, posed by the rig, do not fit the masks of the start frame",
                frame=start,
                hint="Check that the rig is of this subject, and check the masks and calibration at this frame.",
            )
        take = TwoWays(range(first, stop), self._places, lambda fit: fit.objective_px, progress=self._progress)
        self.fits = take.known
        take.follow(Begin(start, begun, self._walk))

    def _fit(self, found: FrameFit, views: Sequence[View]) -> Array:
        """Return the matched fraction of each arch's contour less the penalty for uncovered mask, shape (2,) [-]."""
        if found.solution is None:
            return np.full(2, -np.inf)
        return arch_fit(self._scans, found.solution, views, self._config.uncovered_price)

    def _walk(self, way: range, near: FrameFit) -> Iterator[FrameFit]:
        """Yield the fits of frames in tracking order, next to a given fit.

        If frames are aligned again, their residuals are compared with those of all frames aligned so far.
        """
        again = any(frame in self.fits for frame in way)
        usual = usual_of(self.fits.values()) if again else None
        passing = ForwardPass(Attempts(self._quick, self._weight, usual), near, fixed_head=self._shot.fixed_head)
        for frame in way:
            yield passing.step(self._views.at(frame))

    def _places(self, fit: FrameFit) -> Array:
        return transform_points(self._jaw.pose(fit.pose.d), self._scans[1].probes)

    def second_pass(self) -> Smoothed:
        """Refine all frames jointly."""
        frames = sorted(self.fits)
        fits = [self.fits[frame] for frame in frames]
        shot = self._shot
        smoother = Smoother(
            self._full,
            self._views,
            frames,
            shot.fps,
            len(shot.camera_names),
            fixed_head=shot.fixed_head,
            free_focal=shot.free_focal,
            skin=jaw_of_skin(shot.skin, frames, fits),
        )
        return smoother.run(fits)


def solve_capture(
    capture: Capture,
    cameras: Sequence[Camera],
    offsets: Mapping[str, int],
    upper: Mesh,
    lower: Mesh,
    jaw: JawRig,
    config: TrackingConfig | None = None,
    *,
    fixed_head: bool = False,
    free_focal: bool = False,
    skin: SkinOf | None = None,
    threads: int = 2,
    progress: Progress | None = None,
) -> Performance:
    """Solve the performance of a capture.

    Args:
        capture: masks, frame range and optional picks; without picks, the start pose is searched for.
        cameras: calibrated cameras; world lengths are in mm.
        offsets: time offsets by camera name: the reference frame number minus the camera's own frame number.
        upper, lower: teeth scans in the coordinate frame of the rig's scans [mm].
        fixed_head, free_focal, skin: as in `Shot`; focal lengths start from the calibrated ones.
        threads: number of threads of the start search; the result does not depend on it.
        progress: called after each frame with the number of frames done and the total.

    Raises:
        TrackingError: there are no masks, or no frame in which the teeth can be aligned.
        CaptureError: a mask cannot be read.
    """
    config = config or TrackingConfig()
    table = {camera.name: camera for camera in cameras}
    scans = (prepare_scan(upper, "upper"), prepare_scan(lower, "lower"))
    solver = ContourSolver(scans, config)
    with ThreadPoolExecutor(threads) as pool:
        frame, pose, notes, findings = _begin(capture, table, offsets, (upper, lower), solver, jaw, pool.map)
    centre = teeth_centre(scans, Coordinates(jaw, scans).arches(pose))
    with MaskViews(capture.cameras, table, offsets, centre, config.working_px_per_mm, 1) as masks:
        shot = Shot(
            views=masks,
            camera_names=tuple(camera.name for camera in masks.cameras),
            frames=capture.frames or masks.frames,
            start_frame=frame,
            start=pose,
            fps=capture.fps,
            fixed_head=fixed_head,
            free_focal=free_focal,
            skin=skin,
        )
        found = solve_performance(jaw, scans, shot, config, progress=progress)
        found.notes["findings"] = [finding.as_json() for finding in (*findings, *masks.findings())]
    found.notes["start"] = notes
    return found


def _begin(
    capture: Capture,
    cameras: Mapping[str, Camera],
    offsets: Mapping[str, int],
    meshes: tuple[Mesh, Mesh],
    solver: ContourSolver,
    jaw: JawRig,
    map_: Mapper,
) -> tuple[int, Pose, dict[str, object], Sequence[Finding]]:
    """Return start frame and pose, how both were found, and findings; with a single camera, search with the rig."""
    sources = masked_sources(capture.cameras, cameras, offsets, 1)
    if len(sources) > 1:
        start = find_start(capture, cameras, offsets, meshes, solver, map_)
        pose = Coordinates(jaw, solver.scans).pose_of(start.poses)
        return start.frame, pose, start.notes, start.findings
    T_anatomical_scan, findings = check_occlusion(solver.scans, capture.anatomy.T_anatomical_skull)
    footage = Footage(sources, cameras, offsets, capture.frames, 1)
    found = SingleStart(meshes, solver, jaw, T_anatomical_scan, map_).find(footage)
    notes: dict[str, object] = {"by": "search with the rig", "frame": found.frame, "fit": found.fit}
    return found.frame, found.pose, notes, findings


def solve_by_skin(jaw: JawRig, scans: Sequence[Scan], skin: SkinOf, frames: range, fps: float) -> Performance:
    """Solve the jaw parameters of every frame from facial skin, without images of the teeth.

    The head frame is used as the world frame: the head pose is the identity, without uncertainty. There are no cameras.
    """
    coordinates = Coordinates(jaw, scans)
    count, none = len(frames), np.zeros((2, 0), bool)
    fits = [FrameFit(Pose(np.eye(4), np.zeros(3)), None, none, none, np.zeros((2, 0)))] * count
    instants = InstantSolver(ContourSolver(scans, TrackingConfig()), coordinates)
    smoothed = Smoother(instants, None, frames, fps, 0, skin=jaw_of_skin(skin, frames, fits)).run(fits)
    covariance = smoothed.covariance.copy()
    covariance[:, HEAD] = covariance[:, :, HEAD] = 0.0
    return performance_of(jaw, coordinates.pivot, frames, replace(smoothed, covariance=covariance), (), fps)
