"""Tracking of a whole take: alignment of the first frame, passes over all frames, and whole-take corrections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import Mesh
from jawusd.formats.notes import TracksMeta
from jawusd.formats.tracks import LOST, RECOVERED, TRACKED, Tracks
from jawusd.geometry import Camera
from jawusd.tracking.config import FOR_TAKES, TrackingConfig
from jawusd.tracking.contour.annotator import drawn_prior
from jawusd.tracking.contour.frame_record import FrameRecord, PackedRecords, whole_frames
from jawusd.tracking.contour.scan import prepare_scan, teeth_centre
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews, View, masked_sources, present_masks
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.magnification import measure_magnification
from jawusd.tracking.initialization.start import find_start, quote_findings
from jawusd.tracking.initialization.start_search import StartSearch
from jawusd.tracking.sequence.closed_bite import RestFrames, observe_bite, rest_frames
from jawusd.tracking.sequence.delays import BRIDGE_FRAMES, bridge, delay_motions
from jawusd.tracking.sequence.extrinsics import Extrinsics
from jawusd.tracking.sequence.nuisance import Nuisances, TakeEquations
from jawusd.tracking.sequence.passes import LostSearch, Passes, Progress, mark_poorly_seen_lost
from jawusd.tracking.sequence.results import assemble, outline_variance
from jawusd.tracking.sequence.take_checks import (
    lens_findings,
    mirror_findings,
    misfit_findings,
    motion_findings,
    search_findings,
    use_of_cameras,
)
from jawusd.tracking.sequence.time_checks import frame_shifts, time_findings

_SETTLED_REST = 6  # number of frames with closed teeth among the frames on which nuisance parameters are iterated
# Kinds of findings with which camera poses are not corrected, since a correction would hide the underlying errors.
_SHOWN_AS_MOTION = ("focal_length", "scan_size", "lens_distortion", "scans_mirrored")
_CHECKED_FRAMES = 8  # number of frames tested for wrong lenses and scan sizes, which takes half a second


def track_capture(
    capture: Capture,
    cameras: Sequence[Camera],
    offsets: Mapping[str, int],
    upper: Mesh,
    lower: Mesh,
    landmarks: Array,
    config: TrackingConfig | None = None,
    *,
    threads: int = 2,
    progress: Progress | None = None,
) -> Tracks:
    """Track both arches in a capture.

    Args:
        capture: provides masks, frame range and bootstrap picks; without picks, the first pose is searched for.
        cameras: calibrated cameras; world lengths are in mm.
        offsets: time offsets by camera name: the reference frame number minus the camera's own frame number.
        upper, lower: teeth scans in one coordinate frame, in occlusion [mm].
        landmarks: points whose uncertainty is reported, in mandible (= scan) coordinates [mm], shape (5, 3).
        threads: number of worker threads; the result does not depend on it.
        progress: called once per frame with the number of frames done and the total number of frames.

    Raises:
        TrackingError: only one camera, swapped masks or scans, or no frame on which the teeth can be aligned.
        CaptureError: a mask cannot be read.
    """
    config = config or FOR_TAKES
    table = {camera.name: camera for camera in cameras}
    scans = (prepare_scan(upper, "upper"), prepare_scan(lower, "lower"))
    with ThreadPoolExecutor(threads) as pool:
        solver = ContourSolver(scans, config, pool if threads > 1 else None)
        start = find_start(capture, table, offsets, (upper, lower), solver, pool.map)
        centre = teeth_centre(scans, start.poses)
        with MaskViews(capture.cameras, table, offsets, centre, config.working_px_per_mm) as masks:
            first, stop = capture.frames or masks.frames
            take = _Take(solver, masks, first, stop, progress)
            footage = Footage(masked_sources(capture.cameras, table, offsets), table, offsets, capture.frames)
            lost = LostSearch(lambda: StartSearch((upper, lower), solver, start.T_anatomical_scan, pool.map), footage)
            with quote_findings(start.findings):
                take.track_from(start.frame, start.poses, lost)
            point = np.mean([scan.centre for scan in scans], axis=0)
            named, up = capture.motion.rest_frame, start.T_anatomical_scan[1, :3]
            weights = rest_frames(take.records, named, up, point, scans[1].probes)
            corrects = capture.scans.registration == "take"
            rest = RestFrames(weights, named is not None, point, scans[1].centre, corrects)
            shifts = frame_shifts(take.records, masks, solver)
            given = take.scans_and_lenses(start.T_anatomical_scan[0, :3])
            wrong = any(finding.kind in _SHOWN_AS_MOTION for finding in given)
            nuisances, extrinsics = take.refine(rest, may_move=not wrong)
            mark_poorly_seen_lost(take.records)
            records = take.records if capture.frames else _trimmed(take.records)
            names = tuple(camera.name for camera in masks.cameras)
            moved = motion_findings(names, extrinsics)
            corrected = {(finding.kind, finding.camera) for finding in moved}
            findings = [
                *start.findings,
                *masks.findings(),
                *use_of_cameras(names, records),
                *(finding for finding in given if (finding.kind, finding.camera) not in corrected),
                *moved,
                *time_findings(names, take.records, nuisances, extrinsics, config, shifts),
                *misfit_findings(take.records),
                *search_findings(take.searches, take.records),
            ]
    notes: TracksMeta = {
        "start": start.notes,
        "painted": [s.painted for s in scans],
        "findings": [finding.as_json() for finding in findings],
    }
    points = np.asarray(landmarks, np.float64)
    return assemble(records, names, points, nuisances, extrinsics, config, rest, notes)


def _trimmed(records: PackedRecords) -> PackedRecords:
    """Return the records from the first to the last frame with a mask."""
    masked = [frame for frame, record in records.items() if np.isfinite(record.coverage).any()]
    return records.kept(frame for frame in records if min(masked) <= frame <= max(masked))


class _Take(Passes):
    """Tracks a take, estimates its nuisance parameters, and aligns its frames again."""

    def refine(self, rest: RestFrames, may_move: bool) -> tuple[Nuisances, Extrinsics]:
        """Estimate delays, annotator biases and camera poses; correct significant ones and align all frames again.

        Camera poses are corrected only if `may_move`, since wrong lenses or scan sizes have similar effects.
        """
        c = self._config
        middle = np.median([record.solution.centres for record in self.records.values()], axis=(0, 1))
        extrinsics = Extrinsics.calibrated(self._masks.cameras, middle)
        equations = self._equations(extrinsics, rest)
        known = self._late_cameras(equations, extrinsics, rest)
        if known is not None:
            equations = self._equations(extrinsics, rest)
        found = equations.solve(c, True)
        cameras_moved = may_move and found.cameras_moved(c) and c.refine_rounds > 0
        if not cameras_moved:
            extrinsics = extrinsics.then(np.zeros_like(found.twists), found.sigma_twists)
            found = equations.solve(c, False)
        pending, rounds = found.matters(c), 0
        found = found if known is None else known.plus(found)
        if pending and c.refine_rounds:
            found, extrinsics = self._settle(found, extrinsics, rest, cameras_moved)
        while pending and rounds < (c.late_rounds if c.refine_rounds else 0):
            if cameras_moved:
                extrinsics = extrinsics.then(found.twists, found.sigma_twists)
            self._realign(found, extrinsics)
            residual = self._equations(extrinsics, rest).solve(c, cameras_moved)
            found, rounds = found.plus(residual), rounds + 1
            # The correction of a late camera depends on the estimated motion, which the first round improves.
            late = residual.late(c) or (rounds == 1 and found.late(c))
            pending = late or (rounds < c.refine_rounds and residual.matters(c))
        return found, extrinsics

    def _late_cameras(self, equations: TakeEquations, extrinsics: Extrinsics, rest: RestFrames) -> Nuisances | None:
        """Correct delays of about one frame in advance; return None if there are none."""
        c = self._config
        found = equations.solve(c, False)
        if np.abs(found.delays).max() < c.late_frames or not c.refine_rounds:
            return None
        found, _ = self._settle(found, extrinsics, rest, False)
        self._realign(found, extrinsics)
        return found

    def scans_and_lenses(self, left: Array) -> list[Finding]:
        """Return findings about lenses and scans from the uncorrected take; `left` (3,) is in scan coordinates."""
        whole = whole_frames(self.records)
        if not whole:
            return []
        instants = []
        for k in np.unique(np.linspace(0, len(whole) - 1, _CHECKED_FRAMES).astype(int)):
            views = self._masks.at(whole[k])
            instants.append((self.records[whole[k]].solution.poses, views, present_masks(views)))
        scans = [scan.thin or scan for scan in self._solver.scans]
        hands = mirror_findings(scans, left, instants, self._config)
        found = measure_magnification(scans, instants, self._config)
        return hands if found is None else hands + lens_findings([camera.name for camera in self._masks.cameras], found)

    def _equations(self, extrinsics: Extrinsics, rest: RestFrames) -> TakeEquations:
        variance = outline_variance(self.records, self._config)
        equations = TakeEquations(self.records, variance, extrinsics, annotator=drawn_prior(self._solver.scans))
        observe_bite(equations, rest)
        return equations

    def _settle(
        self, found: Nuisances, extrinsics: Extrinsics, rest: RestFrames, cameras_moved: bool
    ) -> tuple[Nuisances, Extrinsics]:
        """Align some frames repeatedly until the nuisance parameters converge, since matches adapt slowly."""
        c, records = self._config, self.records.kept(self.records)
        whole = whole_frames(records)
        if not whole:
            return found, extrinsics
        chosen = {whole[k] for k in np.linspace(0, len(whole) - 1, c.settle_frames).astype(int)}
        chosen |= set(sorted(rest.weights, key=lambda f: -rest.weights[f])[:_SETTLED_REST]) & set(whole)
        sample = {frame: self._masks.at(frame) for frame in sorted(chosen)}
        sampled_rest = replace(rest, weights={f: w for f, w in rest.weights.items() if f in sample})
        variance = outline_variance(records, c)
        for _ in range(c.settle_rounds):
            if cameras_moved:
                extrinsics = extrinsics.then(found.twists, found.sigma_twists)
            for frame, views in sample.items():
                start, used = records[frame].solution.poses, records[frame].used
                views = _corrected_views(views, self.records, frame, found, extrinsics)
                solution = self._solver.solve(start, views, c.gates_from(0.0), used)
                records[frame] = replace(records[frame], solution=solution)
            equations = TakeEquations(records, variance, extrinsics, sample, drawn_prior(self._solver.scans))
            observe_bite(equations, sampled_rest)
            more = equations.solve(c, cameras_moved)
            found = found.plus(more)
            if more.settled(c):
                break
        return found, extrinsics

    def _realign(self, nuisances: Nuisances, extrinsics: Extrinsics) -> None:
        """Align every frame again from its poses, with all nuisance parameters corrected."""
        before = self.records.kept(self.records)
        tracker = self.tracker_beside(self._first)
        for frame, views in self._masks.walk(self._first, self._stop):
            views = _corrected_views(views, before, frame, nuisances, extrinsics)
            record = tracker.track(_starts_again(before, frame), views, None)
            found = record.status == TRACKED
            unreliable = np.isin(before[frame].status, (RECOVERED, LOST))
            status = np.where(found & unreliable, RECOVERED, record.status).astype(np.int8)
            self.records[frame] = replace(record, status=status)
            tracker.history.add(record)
            # free records that are no longer needed, to save memory in long takes
            before.pop(frame - BRIDGE_FRAMES, None)


def _corrected_views(
    views: Sequence[View],
    records: Mapping[int, FrameRecord],
    frame: int,
    nuisances: Nuisances,
    extrinsics: Extrinsics,
) -> list[View]:
    """Return the views of a frame with corrected delays, mask biases and camera poses."""
    moved = delay_motions(records, frame, nuisances.delays)
    views = extrinsics.correct(views)
    return [replace(view, T_delay=moved[c], habits=nuisances.habits[:, c]) for c, view in enumerate(views)]


def _starts_again(records: Mapping[int, FrameRecord], frame: int) -> list[Array]:
    """Return starts for aligning a frame again: its poses, preceded by interpolated poses if an arch is lost."""
    own = records[frame].solution.poses
    lost = np.flatnonzero(records[frame].status == LOST)
    even = own.copy()
    for arch in lost.tolist():
        across = bridge(records, frame, arch)
        if across is not None:
            even[arch] = across[0]
    return [even, own] if len(lost) else [own]
