"""Track a whole take with the paper's method, outwards from the picks; each frame starts at its neighbour's pose.

The optimiser of one arch in one frame (section 4) is a descent with finite differences, then a dense local search.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import product
from math import radians
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.capture import Bootstrap, Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.notes import TracksMeta
from jawusd.formats.tracks import LOST, PARTIAL, TRACKED, LostReason, Tracks
from jawusd.geometry import LANDMARKS, Camera, make_transform, orthonormalise, relative_pose, transform_point
from jawusd.paper.energy import PaperEnergy, PaperScan, PixelCounter, RasterCounter, paper_scan
from jawusd.tracking.contour.scan import ARCH_NAMES, ARCHES
from jawusd.tracking.contour.views import MaskViews, View
from jawusd.tracking.initialization.bootstrap import pose_from_picks

_FEWEST_MASKS = 2  # minimum number of masks of an arch; from a single view, depth is ambiguous

Backend = Literal["cpu", "gl"]
_GOLDEN = (np.sqrt(5) - 1) / 2

Energy = Callable[[Array], Array]
Line = Callable[[list[float]], Array]


@dataclass(frozen=True)
class PaperConfig:
    """Settings of the paper's method. The paper specifies lambda and the order of the steps only.

    The other values were tuned on a synthetic take; changing one of them affects the error by less than a factor of
    two.
    """

    # Weight of the boundary term: lambda in eq. 7.
    boundary_weight: float = 0.4
    # Resolution at the teeth [px/mm]: about that of the paper's 940 x 480 buffer and of the default solver.
    working_px_per_mm: float = 7.2
    # Half step of the finite differences; smaller steps are dominated by pixel quantisation, larger steps by curvature.
    difference_rad: float = radians(0.3)
    difference_mm: float = 0.15
    # Longest step of the line search: about the motion between two video frames of an exercise.
    reach_rad: float = radians(1.0)
    reach_mm: float = 1.0
    # Interval length at which the golden-section search stops: a motion of a tenth of a pixel.
    tolerance_rad: float = radians(0.01)
    tolerance_mm: float = 0.01
    # Maximum number of rounds of rotation and translation steps; typical frames need fewer than ten.
    most_rounds: int = 40
    # Dense search: number of samples per degree of freedom (odd), and their spacing.
    dense_samples: int = 3
    dense_rad: float = radians(0.2)
    dense_mm: float = 0.1


@dataclass(frozen=True, eq=False)
class PaperSolution:
    """Result for one arch in one frame."""

    pose: Array  # T_world_scan, shape (4, 4)
    energy: float  # energy E of eq. 6 at the pose [px]
    rounds: int  # number of rounds of rotation and translation steps


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


def solve_paper(energy: Energy, start: Array, centre: Array, config: PaperConfig) -> PaperSolution:
    """Minimise the energy, E (N,) of poses (N, 4, 4), of one arch in one frame.

    The six parameters are those of eq. 6, R = Rz(theta_z) Ry(theta_y) Rx(theta_x) and t, relative to the start: zero is
    T_world_scan (4, 4) of the previous frame, and rotations are about the centroid of the teeth (3,), in scan
    coordinates [mm]. The paper does not specify this.
    """

    def at(parameters: Array) -> Array:
        return energy(_poses(start, centre, parameters))

    best, lowest = np.zeros(6), float(at(np.zeros((1, 6)))[0])
    rounds = 0
    improved = True
    while improved and rounds < config.most_rounds:
        rounds += 1
        before = lowest
        for rotation in (True, False):
            best, lowest = _descend(at, best, lowest, rotation, config)
        improved = lowest < before
    spacing = np.repeat([config.dense_rad, config.dense_mm], 3)
    half = config.dense_samples // 2
    around = best + spacing * np.array(list(product(range(-half, half + 1), repeat=6)))
    values = at(around)
    # The middle sample is `best` itself and wins ties.
    if values.min() < lowest:
        best, lowest = around[values.argmin()], float(values.min())
    return PaperSolution(_poses(start, centre, best[None])[0], lowest, rounds)


def _descend(at: Energy, best: Array, lowest: float, rotation: bool, config: PaperConfig) -> tuple[Array, float]:
    """Take one step in rotation or in translation; return the better of start and end, and its energy."""
    block = slice(0, 3) if rotation else slice(3, 6)
    step = config.difference_rad if rotation else config.difference_mm
    nudges = np.zeros((6, 6))
    nudges[:3, block] = step * np.eye(3)
    nudges[3:, block] = -step * np.eye(3)
    values = at(best + nudges)
    gradient = (values[:3] - values[3:]) / (2 * step)
    steepness = np.linalg.norm(gradient)
    if steepness == 0:
        return best, lowest
    direction = np.zeros(6)
    direction[block] = -gradient / steepness
    reach = config.reach_rad if rotation else config.reach_mm
    tolerance = config.tolerance_rad if rotation else config.tolerance_mm
    length, value = golden_section(lambda s: at(best + np.outer(s, direction)), reach, tolerance)
    return (best + length * direction, value) if value < lowest else (best, lowest)


def golden_section(line: Line, reach: float, tolerance: float) -> tuple[float, float]:
    """Return the best point on [0, reach] and its value, found by golden-section search (J. Kiefer, Proc. AMS 4, 1953).

    `line` returns its values at a list of points. The search stops at an interval of the length `tolerance`.
    """
    low, high = 0.0, reach
    a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_a, at_b = (float(v) for v in line([a, b]))
    while high - low > tolerance:
        if at_a <= at_b:
            high, b, at_b = b, a, at_a
            a = high - _GOLDEN * (high - low)
            at_a = float(line([a])[0])
        else:
            low, a, at_a = a, b, at_b
            b = low + _GOLDEN * (high - low)
            at_b = float(line([b])[0])
    return (a, at_a) if at_a <= at_b else (b, at_b)


def _poses(start: Array, centre: Array, parameters: Array) -> Array:
    """Return T_world_scan for angles and translations (N, 6) relative to the start, shape (N, 4, 4)."""
    R = Rotation.from_euler("ZYX", parameters[:, 2::-1]).as_matrix()
    pivot = transform_point(start, centre)
    moved = R @ (start[:3, 3] - pivot) + pivot + parameters[:, 3:]
    return orthonormalise(make_transform(R @ start[:3, :3], moved))
