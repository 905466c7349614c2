"""Where a take's tracking begins: at the picks, or where a search finds the teeth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from jawusd.errors import TrackingError
from jawusd.formats.capture import Bootstrap, Capture
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera
from jawusd.tracking.bootstrap import pose_from_picks
from jawusd.tracking.footage import Footage, Start
from jawusd.tracking.global_start import StartSearch, search_start
from jawusd.tracking.mixups import check_mixups
from jawusd.tracking.scan_checks import check_occlusion
from jawusd.tracking.solver import ContourSolver
from jawusd.tracking.views import masked_sources


def find_start(
    capture: Capture,
    cameras: Mapping[str, Camera],
    offsets: Mapping[str, int],
    meshes: Sequence[Mesh],
    solver: ContourSolver,
    map_: Callable[..., Iterable] = map,
) -> Start:
    """Return the first frame and the poses there, from the capture's picks or, without any, by search.

    Args:
        capture: the capture; its masks, picks and frame range are used.
        cameras: calibrated cameras by name.
        offsets: reference frame minus own frame number, by camera name.
        meshes: upper and lower teeth scans in one frame, in occlusion [mm].
        solver: holds the same scans, prepared.
        map_: runs parts of the search, in threads if it likes.

    Raises:
        TrackingError: picks that cannot be, scans that do not belong together, masks that were exchanged, or no frame
            on which the search finds the teeth.
        CaptureError: a mask cannot be read.
    """
    footage = Footage(masked_sources(capture.cameras, cameras, offsets), cameras, offsets, capture.frames)
    T_anatomical_scan, findings = check_occlusion(solver.scans, capture.anatomy.T_anatomical_skull)
    if capture.bootstrap is not None:
        first, stop = capture.frames or (0, capture.bootstrap.frame + 1)
        if not first <= capture.bootstrap.frame < stop:
            raise TrackingError(f"bootstrap.frame is {capture.bootstrap.frame}, frames run from {first} to {stop - 1}")
        start = _picked(capture.bootstrap, cameras, meshes)
        check_mixups(footage, solver, start.poses, start.frame)
    else:
        start = search_start(StartSearch(meshes, solver, T_anatomical_scan, map_), footage)
    return Start(start.frame, start.poses, {**start.notes, "scan_findings": findings})


def _picked(bootstrap: Bootstrap, cameras: Mapping[str, Camera], meshes: Sequence[Mesh]) -> Start:
    """Return the poses that agree with the picks."""
    poses, left_out = [], {}
    for row, mesh, picks in zip(("upper", "lower"), meshes, (bootstrap.upper, bootstrap.lower), strict=True):
        pose, wrong = pose_from_picks(picks, np.asarray(mesh.vertices, np.float64), cameras, row)
        poses.append(pose)
        left_out[row] = wrong
    notes = {"by": "picks", "frame": bootstrap.frame, "picks_left_out": left_out}
    return Start(bootstrap.frame, np.stack(poses), notes)
