"""The tracks of a take that was followed by the colours of its pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.tracks import LOST, TRACKED, LostReason, Tracks, TracksMeta
from jawusd.geometry import Camera
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.frame_record import NO_LOSS, FrameRecord, Loss
from jawusd.tracking.contour.quality import matched_px
from jawusd.tracking.contour.scan import ARCHES, Scan
from jawusd.tracking.contour.views import View
from jawusd.tracking.region.condyle_fusion import CondyleFusion
from jawusd.tracking.region.learned import CORRELATION_PX
from jawusd.tracking.region.take_checks import camera_findings, scan_findings
from jawusd.tracking.region.tracker import RegionPose
from jawusd.tracking.sequence.closed_bite import observe_bite
from jawusd.tracking.sequence.extrinsics import Extrinsics
from jawusd.tracking.sequence.nuisance import Hand, TakeEquations, corrected_pose
from jawusd.tracking.sequence.rest_frames import RestFrames, rest_frames
from jawusd.tracking.sequence.results import assemble, outline_variance
from jawusd.tracking.sequence.time_checks import time_findings

#: How borders of colours lie beside the teeth's edges: up to half a pixel inside, as teeth darken towards them; where
#: the gum line is found was learned on the way.
BORDERS = Hand(edge_px=0.3, gum_px=0.08, gum_mm=0.02, arch_px=0.25, arch_mm=0.01, camera_px=0.08, frames=5.0)
FOR_COLOURS = TrackingConfig(known_correlation_px=CORRELATION_PX)


@dataclass(frozen=True, eq=False)
class TakeFacts:
    """Say what is known of a take besides its frames.

    Attributes:
        cameras: in their order.
        scans: upper and lower.
        landmarks: mandible coordinates [mm], shape (5, 3).
        axes: rotation from scan to anatomical axes: left, up, front; shape (3, 3).
        rest_frame: frame with the teeth together that the capture names, or None.
        registers: whether the lower scan is moved to where the closed bite shows it.
    """

    cameras: Sequence[Camera]
    scans: Sequence[Scan]
    landmarks: Array
    axes: Array
    rest_frame: int | None = None
    registers: bool = False


def tracks_of(
    followed: Mapping[int, RegionPose], take: TakeFacts, looks: Sequence[tuple[Array, Sequence[View]]] = ()
) -> Tracks:
    """Return the tracks of frames; delays between cameras and where borders lie are estimated from all of them.

    Args:
        looks: poses and views of some of the frames, which sizes and focal lengths are estimated from.

    Raises:
        TrackingError: the registration of the scans is to be corrected, and the mouth was not closed.
    """
    config = FOR_COLOURS
    solved = [(frame, found, found.solution) for frame, found in followed.items() if found.solution is not None]
    records = {frame: _record(found, solution, config) for frame, found, solution in solved}
    point = np.mean([scan.centre for scan in take.scans], axis=0)
    frames = rest_frames(records, take.rest_frame, take.axes[1], point, take.scans[1].probes)
    rest = RestFrames(frames, take.rest_frame is not None, point, take.scans[1].centre, take.registers)
    middle = np.median([record.solution.centres for record in records.values()], axis=(0, 1))
    extrinsics = Extrinsics.calibrated(take.cameras, middle)
    variance = outline_variance(records, config)
    equations = TakeEquations(records, variance, extrinsics, hand=BORDERS)
    observe_bite(equations, records, rest, extrinsics, variance)
    nuisances = equations.solve(config, False)
    names = tuple(camera.name for camera in take.cameras)
    findings = [
        *camera_findings(names, [solution for _, _, solution in solved]),
        *scan_findings(names, take.scans, take.axes[0], looks, config),
        *time_findings(names, records, nuisances, extrinsics, config),
    ]
    notes: TracksMeta = {
        "painted": [s.painted for s in take.scans],
        "findings": [found.as_json() for found in findings],
    }
    moved = {f: np.stack([corrected_pose(records, f, arch, nuisances) for arch in ARCHES]) for f in records}
    records = {f: replace(r, solution=replace(r.solution, poses=moved[f])) for f, r in records.items()}
    fuse = CondyleFusion(take.landmarks, take.axes)
    return assemble(records, names, take.landmarks, nuisances, extrinsics, config, rest, notes, fuse)


def _record(found: RegionPose, solution: Solution, config: TrackingConfig) -> FrameRecord:
    seen = solution.visible_px > 0
    matched = matched_px(solution)
    losses = [NO_LOSS, NO_LOSS]
    for r in np.flatnonzero(~found.found).tolist():
        losses[r] = Loss(LostReason.LOW_SCORE, float(found.usual[r]), float(found.least[r]))
        if matched[r] < config.least_matched_px:
            losses[r] = Loss(LostReason.LITTLE_CONTOUR, float(matched[r]), config.least_matched_px)
    status = np.where(found.found, TRACKED, LOST).astype(np.int8)
    return FrameRecord(solution, status, seen, np.full(seen.shape, np.nan), (losses[0], losses[1]))
