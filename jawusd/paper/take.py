"""Track a whole take with the paper's method, outwards from the picks; each frame starts at its neighbour's pose."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.capture import Bootstrap, Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.notes import TracksMeta
from jawusd.formats.tracks import LOST, PARTIAL, TRACKED, LostReason, Tracks
from jawusd.geometry import LANDMARKS, Camera, relative_pose, transform_point
from jawusd.paper.energy import PaperEnergy, PaperScan, PixelCounter, RasterCounter, paper_scan
from jawusd.paper.solver import PaperConfig, solve_paper
from jawusd.tracking.contour.scan import ARCH_NAMES, ARCHES
from jawusd.tracking.contour.views import MaskViews, View
from jawusd.tracking.initialization.bootstrap import pose_from_picks

_FEWEST_MASKS = 2  # minimum number of masks of an arch; from a single view, depth is ambiguous

Backend = Literal["cpu", "gl"]


@dataclass(frozen=True, eq=False)
class _Record:
    """Result in one frame: poses (2, 4, 4), status (2,), coverage error (2, C)."""

    poses: Array
    status: NDArray[np.int8]
    coverage: Array


def track_capture_paper(
    capture: Capture,
    cameras: Sequence[Camera],
    offsets: Mapping[str, int],
    upper: Mesh,
    lower: Mesh,
    config: PaperConfig | None = None,
    *,
    backend: Backend = "cpu",
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Tracks:
    """Track both arches through a capture with the paper's method.

    The method neither detects failures nor estimates uncertainty: an arch with at least two masks counts as tracked,
    however badly it fits. Covariances, sigmas, residuals and matched lengths are NaN, meaning unknown. The only quality
    measure is `coverage_error`.

    Args:
        upper, lower: teeth scans in one frame [mm], with the boundary of interest painted green.
        threads: number of worker threads of the CPU backend; the result does not depend on this number.
        progress: called after each frame with the number of frames done and the total.

    Raises:
        TrackingError: there are no picks, there is only one camera, or a scan has no boundary of interest.
        CaptureError: a mask cannot be read.
        MissingDependencyError: the GL backend is chosen and OpenGL is unavailable.
    """
    config = config or PaperConfig()
    table = {camera.name: camera for camera in cameras}
    scans = (paper_scan(upper, "upper"), paper_scan(lower, "lower"))
    bootstrap = _picks(capture)
    parts = zip((bootstrap.upper, bootstrap.lower), (upper, lower), ARCH_NAMES, strict=True)
    start = np.stack([pose_from_picks(picks, mesh.vertices, table, name)[0] for picks, mesh, name in parts])
    centre = np.mean([transform_point(start[r], scans[r].centre) for r in ARCHES], axis=0)
    with ExitStack() as stack:
        masks = stack.enter_context(MaskViews(capture.cameras, table, offsets, centre, config.working_px_per_mm))
        first, stop = capture.frames or masks.frames
        begin = bootstrap.frame
        if not first <= begin < stop:
            raise TrackingError(f"bootstrap.frame is {begin}; frames run from {first} to {stop - 1}")
        energies = _energies(scans, config, backend, threads, stack)
        records: dict[int, _Record] = {}
        for frames in (range(begin, stop), range(begin - 1, first - 1, -1)):
            last = start if frames.step > 0 else records[begin].poses
            for frame, views in masks.walk(frames.start, frames.stop, frames.step):
                records[frame] = _instant(energies, scans, config, last, views)
                last = records[frame].poses
                if progress is not None:
                    progress(len(records), stop - first)
        names = tuple(camera.name for camera in masks.cameras)
        findings = [finding.as_json() for finding in masks.findings()]
    if not capture.frames:
        masked = [frame for frame, record in records.items() if np.isfinite(record.coverage).any()]
        records = {f: record for f, record in records.items() if min(masked) <= f <= max(masked)}
    counted = sum(energy.evaluations for energy in energies) / len(energies)
    meta: TracksMeta = {
        "solver": "paper",
        "backend": backend,
        "evaluations_per_row_and_frame": counted / max(len(records), 1),
        "tracking": asdict(config),
        "findings": findings,
    }
    return _assembled(records, names, meta)


def _picks(capture: Capture) -> Bootstrap:
    if capture.bootstrap is None:
        raise TrackingError(
            "the capture has no [bootstrap] picks, which the paper's method requires",
            path=capture.file,
            hint="Add at least three picks per arch, each seen by two cameras.",
        )
    return capture.bootstrap


def _energies(
    scans: Sequence[PaperScan], config: PaperConfig, backend: Backend, threads: int, stack: ExitStack
) -> list[PaperEnergy]:
    """Return the energies of both arches; closing the exit stack releases the OpenGL context."""
    counters: list[PixelCounter]
    if backend == "gl":
        # Imported here because the module requires moderngl, which the CPU backend does not need.
        from jawusd.paper.gl import GlCounter, open_context

        context = open_context()
        stack.callback(context.release)
        counters = [GlCounter(context, scan) for scan in scans]
    else:
        counters = [RasterCounter(scan, threads) for scan in scans]
    return [PaperEnergy(counter, scan, config.boundary_weight) for counter, scan in zip(counters, scans, strict=True)]


def _instant(
    energies: Sequence[PaperEnergy],
    scans: Sequence[PaperScan],
    config: PaperConfig,
    last: Array,
    views: Sequence[View],
) -> _Record:
    """Align both arches independently; an arch with too few masks retains its previous pose and counts as lost."""
    poses, status = last.copy(), np.full(2, LOST, np.int8)
    coverage = np.full((2, len(views)), np.nan)
    for r in ARCHES:
        present = np.array([view.present[r] for view in views])
        if present.sum() < _FEWEST_MASKS:
            continue
        energy = energies[r]
        energy.show([v for v, there in zip(views, present) if there], r, last[r])
        poses[r] = solve_paper(energy, last[r], scans[r].centre, config).pose
        with np.errstate(invalid="ignore"):  # a mask may become empty at the working resolution
            coverage[r, present] = energy.uncovered_px(poses[r]) / energy.mask_px
        status[r] = TRACKED if present.all() else PARTIAL
    return _Record(poses, status, coverage)


def _assembled(records: Mapping[int, _Record], camera_names: tuple[str, ...], meta: TracksMeta) -> Tracks:
    frames = np.array(sorted(records), np.int64)
    count = len(frames)
    status = np.stack([records[f].status for f in frames])
    poses = np.stack([records[f].poses for f in frames])
    poses[status == LOST] = np.nan
    relative = np.full((count, 4, 4), np.nan)
    both = (status != LOST).all(1)
    relative[both] = relative_pose(poses[both, 0], poses[both, 1])
    unknown = np.full((count, 6, 6), np.nan)
    used = np.stack([np.isfinite(records[f].coverage) for f in frames])
    return Tracks(
        frames=frames,
        T_world_upper=poses[:, 0],
        T_world_lower=poses[:, 1],
        T_upper_lower=relative,
        raw_T_world_upper=poses[:, 0].copy(),
        raw_T_world_lower=poses[:, 1].copy(),
        raw_T_upper_lower=relative.copy(),
        status=status,
        prior_aided=np.zeros(count, bool),
        coverage_error=np.stack([records[f].coverage for f in frames]),
        masks_used=used,
        covariance_upper=unknown,
        covariance_lower=unknown.copy(),
        covariance_relative=unknown.copy(),
        sigma_mm=np.full((count, len(LANDMARKS)), np.nan),
        residual_px=np.full((count, 2), np.nan),
        matched_px=np.full((count, 2), np.nan),
        camera_names=camera_names,
        meta=meta,
        lost_reason=np.where(status == LOST, LostReason.FEW_MASKS, LostReason.NONE).astype(np.uint8),
        lost_value=np.where(status == LOST, used.sum(2), np.nan),
        lost_limit=np.where(status == LOST, _FEWEST_MASKS, np.nan),
    )
