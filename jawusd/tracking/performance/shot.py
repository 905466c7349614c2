"""A shot from its capture: where its masks are, where to begin, and the performance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import Mesh
from jawusd.formats.performance import Performance
from jawusd.geometry import Camera
from jawusd.tracking.config import Mapper, TrackingConfig
from jawusd.tracking.contour.scan import prepare_scan, teeth_centre
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews, masked_sources
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.scan_checks import check_occlusion
from jawusd.tracking.initialization.start import find_start
from jawusd.tracking.performance.coordinates import Coordinates, Pose
from jawusd.tracking.performance.single_start import SingleStart
from jawusd.tracking.performance.take import Shot, solve_performance


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
    threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> Performance:
    """Solve the performance of a capture.

    Args:
        capture: gives masks, frame range and picks; without picks the teeth are searched.
        cameras: calibrated; world lengths in mm.
        offsets: reference frame minus own frame number, per camera name.
        upper, lower: teeth scans in one frame, as the rig knows them [mm].
        jaw: the person's rig.
        config: the tracker's numbers.
        fixed_head: the cameras are worn: the head does not move before them.
        free_focal: the focal lengths of the calibration are guesses.
        threads: of the search for the start; the result does not depend on it.
        progress: called with frames done and frames in all, once per frame.

    Raises:
        TrackingError: no masks, or no frame on which the teeth can be aligned.
        CaptureError: a mask cannot be read.
    """
    config = config or TrackingConfig()
    table = {camera.name: camera for camera in cameras}
    scans = (prepare_scan(upper, "upper"), prepare_scan(lower, "lower"))
    solver = ContourSolver(scans, config)
    with ThreadPoolExecutor(threads) as pool:
        start = _begin(capture, table, offsets, (upper, lower), solver, jaw, pool.map)
    centre = teeth_centre(scans, Coordinates(jaw, scans).arches(start.pose))
    with MaskViews(capture.cameras, table, offsets, centre, config.working_px_per_mm, 1) as masks:
        shot = Shot(
            views=masks,
            camera_names=tuple(camera.name for camera in masks.cameras),
            frames=capture.frames or masks.frames,
            start_frame=start.frame,
            start=start.pose,
            fps=capture.fps,
            fixed_head=fixed_head,
            free_focal=free_focal,
        )
        found = solve_performance(jaw, scans, shot, config, progress=progress)
        found.notes["findings"] = [finding.as_json() for finding in (*start.findings, *masks.findings())]
    found.notes["start"] = start.notes
    return found


@dataclass(frozen=True, eq=False)
class _Begin:
    """Say where to begin, how that was found, and what is doubtful."""

    frame: int
    pose: Pose
    notes: dict[str, object]
    findings: tuple[Finding, ...]


def _begin(
    capture: Capture,
    cameras: Mapping[str, Camera],
    offsets: Mapping[str, int],
    meshes: tuple[Mesh, Mesh],
    solver: ContourSolver,
    jaw: JawRig,
    map_: Mapper,
) -> _Begin:
    """Return a start from picks or by search; with one camera the rig takes part in it."""
    sources = masked_sources(capture.cameras, cameras, offsets, 1)
    if len(sources) > 1:
        start = find_start(capture, cameras, offsets, meshes, solver, map_)
        pose = Coordinates(jaw, solver.scans).pose_of(start.poses)
        return _Begin(start.frame, pose, start.notes, start.findings)
    T_anatomical_scan, findings = check_occlusion(solver.scans, capture.anatomy.T_anatomical_skull)
    footage = Footage(sources, cameras, offsets, capture.frames, 1)
    found = SingleStart(meshes, solver, jaw, T_anatomical_scan, map_).find(footage)
    notes: dict[str, object] = {"by": "search with the rig", "frame": found.frame, "fit": found.fit}
    return _Begin(found.frame, found.pose, notes, tuple(findings))
