"""Where a take's tracking begins: at the picks, or where a search finds the teeth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from jawusd.errors import TrackingError
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera
from jawusd.tracking.bootstrap import picked_sigma_mm, pose_from_picks
from jawusd.tracking.footage import Footage, Start
from jawusd.tracking.global_start import search_around, search_start
from jawusd.tracking.mixups import likely_mixup
from jawusd.tracking.scan_checks import check_occlusion
from jawusd.tracking.solver import ContourSolver
from jawusd.tracking.start_search import StartSearch
from jawusd.tracking.views import masked_sources

# Poses as sure as this [mm] lie within the basin of the contour solver.
_SURE_MM = 0.8


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
    search = StartSearch(meshes, solver, T_anatomical_scan, map_)
    if capture.bootstrap is not None:
        start = _picked(capture, footage, meshes, search)
    else:
        start = search_start(search, footage)
    return Start(start.frame, start.poses, {**start.notes, "scan_findings": findings})


def _picked(capture: Capture, footage: Footage, meshes: Sequence[Mesh], search: StartSearch) -> Start:
    """Return the poses that agree with the picks; where picks leave much open, the best ones for the masks nearby."""
    bootstrap = capture.bootstrap
    first, stop = capture.frames or (0, bootstrap.frame + 1)
    if not first <= bootstrap.frame < stop:
        raise TrackingError(f"bootstrap.frame is {bootstrap.frame}, frames run from {first} to {stop - 1}")
    poses, left_out, sigma_mm = [], {}, {}
    for scan, mesh, picks in zip(search.solver.scans, meshes, (bootstrap.upper, bootstrap.lower), strict=True):
        pose, wrong = pose_from_picks(picks, mesh.vertices, footage.cameras, scan.name)
        poses.append(pose)
        left_out[scan.name] = wrong
        good = [pick for k, pick in enumerate(picks, start=1) if k not in wrong]
        sigma_mm[scan.name] = picked_sigma_mm(good, mesh.vertices, footage.cameras, pose, scan.probes)
    notes = {"by": "picks", "frame": bootstrap.frame, "picks_left_out": left_out, "picks_sigma_mm": sigma_mm}
    start = Start(bootstrap.frame, np.stack(poses), notes)
    if (mixup := likely_mixup(footage, search.solver, start.poses, start.frame)) is not None:
        raise mixup.refusal(start.frame)
    if max(sigma_mm.values()) <= _SURE_MM or not footage.has_masks(start.frame):
        return start
    found = search_around(search, footage, start.frame, start.poses)
    notes |= {"by": "picks, then search", "worth_px": found.worth_px, "fit": found.fit}
    return Start(start.frame, found.poses, notes)
