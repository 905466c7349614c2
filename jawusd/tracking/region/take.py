"""Tracks of a take from colour images, and checks of its cameras, scans and footage."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.formats.finding import Finding
from jawusd.formats.notes import TracksMeta
from jawusd.formats.tracks import LOST, TRACKED, LostReason, Tracks
from jawusd.geometry import Camera
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.annotator import AnnotatorPrior
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.frame_record import NO_LOSS, FrameRecord, Loss
from jawusd.tracking.contour.quality import matched_px, score_px
from jawusd.tracking.contour.scan import ARCHES, Scan
from jawusd.tracking.contour.views import View
from jawusd.tracking.follow import true_runs
from jawusd.tracking.initialization.magnification import measure_magnification
from jawusd.tracking.region.appearance import CORRELATION_PX
from jawusd.tracking.region.jaw_priors import CondyleFusion
from jawusd.tracking.region.tracker import RegionPose
from jawusd.tracking.sequence.closed_bite import RestFrames, observe_bite, rest_frames
from jawusd.tracking.sequence.extrinsics import Extrinsics
from jawusd.tracking.sequence.nuisance import TakeEquations, corrected_pose
from jawusd.tracking.sequence.results import assemble, outline_variance
from jawusd.tracking.sequence.take_checks import OF_COLOURS, lens_findings, mirror_findings
from jawusd.tracking.sequence.time_checks import time_findings

_LEAST_SHARE = 0.3  # matched fraction of a camera's contour, relative to the best one, below which a camera is reported
# Standard deviation of the position of the lower teeth above which a frame is uninformative [mm]; and fractions of such
# frames above which a take is partly unreliable, and above which it is unusable.
_UNKNOWN_MM, _FEW, _MANY = 1.0, 0.03, 0.2
# Minimum length of a run of good frames, as a fraction of the take, at which trimming its ends is suggested.
_MOST = 0.6

#: Prior on the offsets between colour borders and tooth edges. Borders lie up to half a pixel inside the edges, since
#: teeth darken towards them; gum-line offsets are learned while tracking.
BORDERS = AnnotatorPrior(common=(0.3, 0.08, 0.02), arch=(0.25, 0.25, 0.01), camera=(0.08, 0.08), frames=5.0)
FOR_COLOURS = TrackingConfig(known_correlation_px=CORRELATION_PX)


def camera_findings(names: Sequence[str], solutions: Iterable[Solution]) -> list[Finding]:
    """Return a warning "camera_rarely_used" [fraction of the visible contour] for each camera that fits far worse."""
    shares = []
    for solution in solutions:
        seen = solution.visible_px.sum(0)
        shares.append(np.where(seen > 0, score_px(solution).sum(0) / np.maximum(seen, 1.0), np.nan))
    known = np.array(shares)
    seen_at_all = np.isfinite(known).any(0)
    share = np.zeros(len(names))
    share[seen_at_all] = np.nanmedian(known[:, seen_at_all], axis=0)
    out, best = [], float(share.max())
    for c, name in enumerate(names):
        if share[c] < _LEAST_SHARE * best:
            message = f"{share[c]:.0%} of the teeth's outlines match this camera's images, compared with {best:.0%} "
            message += f"for the best camera; at least {_LEAST_SHARE:.0%} of that is usual. "
            message += "This camera contributes little."
            hint = "Check its video, its calibration (the camera may have moved) and its time offset."
            value, limit = round(float(share[c]), 3), round(_LEAST_SHARE * best, 3)
            out.append(Finding("camera_rarely_used", "warning", message, value, limit, camera=name, hint=hint))
    return out


def scan_findings(
    names: Sequence[str],
    scans: Sequence[Scan],
    left: Array,
    looks: Iterable[tuple[Array, Sequence[View]]],
    config: TrackingConfig,
) -> list[Finding]:
    """Return findings about scans and focal lengths from some frames; see `lens_findings` and `mirror_findings`.

    `left` is a unit vector in scan coordinates (3,); `looks` has the poses (2, 4, 4) and views of each frame.
    """

    def shown(views: Sequence[View]) -> Mask:
        return np.tile([view.edges is not None for view in views], (2, 1))

    instants = [(poses, views, shown(views)) for poses, views in looks]
    thin = [scan.thin or scan for scan in scans]
    hands = mirror_findings(thin, left, instants, config)
    found = measure_magnification(thin, instants, replace(config, correlation_px=CORRELATION_PX))
    return hands if found is None else hands + lens_findings(names, found, OF_COLOURS)


def footage_findings(tracks: Tracks) -> list[Finding]:
    """Return a warning "footage_doubtful" [%] if the jaw is lost or uncertain by over 1 mm in too many frames."""
    sigma_mm = tracks.sigma_mm[:, :3].mean(1)
    bad = ~(sigma_mm <= _UNKNOWN_MM)  # also true for NaN, where an arch is lost
    share = float(bad.mean())
    if share <= _FEW:
        return []
    judgement = "is not usable" if share > _MANY else "is partly unreliable"
    message = (
        f"the footage {judgement}: in {bad.sum()} of {len(bad)} frames the jaw is lost or its uncertainty exceeds "
        f"{_UNKNOWN_MM:g} mm; usually at most {_FEW:.0%} of the frames are affected"
    )
    worst = int(np.argmax(np.where(np.isfinite(sigma_mm), sigma_mm, np.inf)))
    hint = "Inspect the overlay, light the mouth better, or draw masks (`jawusd segment`)."
    first, last = max(true_runs(~bad), key=lambda run: run[1] - run[0], default=(0, 0))
    if last - first >= _MOST * len(bad):
        kept = f"[{tracks.frames[first]}, {tracks.frames[last - 1] + 1}]"
        hint = f"If the other frames are too dark or too bright, set frames = {kept} in capture.toml. {hint}"
    value, limit = round(100 * share, 1), 100 * _FEW
    return [Finding("footage_doubtful", "warning", message, value, limit, frame=int(tracks.frames[worst]), hint=hint)]


def tracks_of(
    followed: Mapping[int, RegionPose],
    cameras: Sequence[Camera],
    scans: Sequence[Scan],
    landmarks: Array,
    axes: Array,
    looks: Sequence[tuple[Array, Sequence[View]]] = (),
    *,
    rest_frame: int | None,
    registers: bool,
) -> Tracks:
    """Return the tracks of frames; delays between cameras and border offsets are estimated as well.

    Args:
        landmarks, axes: as in `CondyleMotion`.
        looks: poses and views of some frames, as in `scan_findings`.
        rest_frame: frame with closed teeth, as specified in the capture, or None.
        registers: whether to register the lower scan by the frames with closed teeth.

    Raises:
        TrackingError: the registration of the scans is to be corrected, but the teeth are never closed.
    """
    config = FOR_COLOURS
    solved = [(frame, found, found.solution) for frame, found in followed.items() if found.solution is not None]
    records = {frame: _record(found, solution, config) for frame, found, solution in solved}
    point = np.mean([scan.centre for scan in scans], axis=0)
    weights = rest_frames(records, rest_frame, axes[1], point, scans[1].probes)
    rest = RestFrames(weights, rest_frame is not None, point, scans[1].centre, registers)
    middle = np.median([record.solution.centres for record in records.values()], axis=(0, 1))
    extrinsics = Extrinsics.calibrated(cameras, middle)
    equations = TakeEquations(records, outline_variance(records, config), extrinsics, annotator=BORDERS)
    observe_bite(equations, rest)
    nuisances = equations.solve(config, False)
    names = tuple(camera.name for camera in cameras)
    findings = [
        *camera_findings(names, [solution for _, _, solution in solved]),
        *scan_findings(names, scans, axes[0], looks, config),
        *time_findings(names, records, nuisances, extrinsics, config),
    ]
    notes: TracksMeta = {
        "painted": [s.painted for s in scans],
        "findings": [found.as_json() for found in findings],
    }
    moved = {f: np.stack([corrected_pose(records, f, arch, nuisances) for arch in ARCHES]) for f in records}
    records = {f: replace(r, solution=replace(r.solution, poses=moved[f])) for f, r in records.items()}
    least_mm = np.array([followed[frame].least_mm for frame in sorted(records)])
    fuse = CondyleFusion(landmarks, axes, least_mm)
    return assemble(records, names, landmarks, nuisances, extrinsics, config, rest, notes, fuse)


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
