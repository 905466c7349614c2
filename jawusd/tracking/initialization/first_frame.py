"""Alignment of the first frame, with the checks that only a first frame needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import TrackingError
from jawusd.formats.tracks import PARTIAL, TRACKED
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import arch_fit, coverage_error, fitting_share, score_px, uncovered_px
from jawusd.tracking.contour.scan import ARCH_NAMES, ARCHES
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import FEWEST_MASKS, View, present_masks
from jawusd.tracking.initialization.magnification import magnified, measure_magnification

#: Minimum `arch_fit` of a first frame [-]: wrong poses stay below it; correct poses exceed it, even with most lower
#: teeth hidden.
LEAST_FIT = 0.03
#: Minimum fit that counts as clear [-]: correct poses exceed it unless lips are nearly closed; wrong poses stay below
#: 0.1 in one arch.
CLEAR_FIT = 0.3
#: Minimum acceptable fit with a mistake corrected [-]: wrong poses do not reach it.
EXPLAINS = 0.1
# Minimum magnification error of a camera for it to explain a failed start [-]; minimum deviation from the other cameras
# for it to be corrected [-]; and number of iterations, since contours far from their masks are not matched at first.
_LEAST_SCALE, _OWN_SCALE, _SIZE_ROUNDS = 0.02, 0.015, 3
_SIZE_HINT = "Check the scans' scale, the board's square size, and that each calibration is for the lens and zoom used."
#: Number of refinements of a first pose from picks or a search, whose error may be a few tenths of a millimetre: each
#: one removes most of the remaining error.
FIRST_ROUNDS = 3


def first_record(
    solver: ContourSolver, start: Array, views: Sequence[View], frame: int, explain: bool = False
) -> FrameRecord:
    """Align the first frame from its views, starting from given T_world_upper and T_world_lower, shape (2, 4, 4).

    With `explain`, which takes longer, the error message names a wrong focal length if that is the cause.

    Raises:
        TrackingError: too few masks on this frame, or the alignment failed.
    """
    use, config = present_masks(views), solver.config
    for r in ARCHES:
        if use[r].sum() < FEWEST_MASKS:
            raise TrackingError(
                f"the first frame has {use[r].sum()} masks of the {ARCH_NAMES[r]} teeth; at least two are needed",
                frame=frame,
                hint="Choose a bootstrap frame that is segmented in every camera.",
            )
    first = _aligned(solver, start, views, use)
    if (problem := _problem(first, config)) is not None:
        # Wrong masks of one camera (another position, size or time) may have biased all poses.
        kept = [_without(use, np.arange(len(views)) == c) for c in range(len(views))]
        others = [_aligned(solver, start, views, rest) for rest in kept]
        clear = [one for one in others if one.fit.min() >= CLEAR_FIT and _problem(one, config) is None]
        if not clear:
            if explain and (cause := _wrong_size(solver, start, views)) is not None:
                raise TrackingError(cause, frame=frame, hint=_SIZE_HINT)
            raise TrackingError(
                problem,
                frame=frame,
                hint="Check the picks, the calibration, the time offsets and the masks of this frame.",
            )
        first = max(clear, key=lambda one: float(one.fit.min()))
    status = np.where(first.use.all(1), TRACKED, PARTIAL).astype(np.int8)
    return FrameRecord(first.solution, status, first.use, first.coverage)


@dataclass(frozen=True, eq=False)
class _Aligned:
    """An alignment of both arches, the masks used for it, and its quality."""

    solution: Solution
    use: Mask  # whether each mask is used, shape (2, C)
    coverage: Array  # uncovered fraction of every mask, shape (2, C)
    fit: Array  # `arch_fit` of both arches, shape (2,)


def _aligned(solver: ContourSolver, start: Array, views: Sequence[View], use: Mask) -> _Aligned:
    """Align both arches with narrow and with wide residual gates, then exclude masks that the scans do not cover."""
    whole, config = use, solver.config
    best = solver.solve(start, views, config.gates_from(0.0), use)
    wide = solver.solve(start, views, config.wide_gates_px, use)
    if (better := score_px(wide).sum(1) > score_px(best).sum(1)).any():
        poses = np.where(better[:, None, None], wide.poses, best.poses)
        best = solver.solve(poses, views, config.wide_gates_px[-2:], use)
    coverage = coverage_error(*uncovered_px(solver.scans, best.poses, views))
    for _ in range(2):  # exclude uncovered masks, and include previously excluded ones that are now covered
        kept = _without(whole, coverage > config.lost_coverage)  # an arch aligned with such a mask would be lost
        if (kept == use).all():
            break
        use = kept
        best = solver.solve(best.poses, views, config.wide_gates_px, use)
        coverage = coverage_error(*uncovered_px(solver.scans, best.poses, views))
    return _Aligned(best, use, coverage, arch_fit(solver.scans, best, views, config.uncovered_price))


def _problem(first: _Aligned, config: TrackingConfig) -> str | None:
    """Return the reason for which an alignment is rejected; None if it is accepted."""
    for r, share in enumerate(fitting_share(first.solution)):
        uncovered = np.nanmedian(first.coverage[r, first.use[r]])
        if share < config.first_share or uncovered > config.lost_coverage or first.fit[r] < LEAST_FIT:
            return (
                f"the {ARCH_NAMES[r]} teeth do not fit their masks: {share:.0%} of the visible contour "
                f"matches (at least {config.first_share:.0%} is needed), {uncovered:.1%} of the masks is not covered "
                f"(at most {config.lost_coverage:.0%} is allowed), and the match minus the penalty for uncovered mask "
                f"is {first.fit[r]:.3f} (at least {LEAST_FIT} is needed)"
            )
    return None


def _wrong_size(solver: ContourSolver, start: Array, views: Sequence[View]) -> str | None:
    """Return a message about a camera whose magnification explains a failed alignment; None without such a camera."""
    use, config = present_masks(views), solver.config
    poses = solver.solve(start, views, config.wide_gates_px, use).poses
    scales = np.zeros(len(views))
    for _ in range(_SIZE_ROUNDS):
        grown = [magnified(view, 1.0 + scale) for view, scale in zip(views, scales, strict=True)]
        found = measure_magnification(solver.scans, [(poses, grown, use)], config)
        if found is None:
            return None
        own = found.scale - found.common
        scales = scales + np.where(np.abs(own) > _OWN_SCALE, own, 0.0)
        grown = [magnified(view, 1.0 + scale) for view, scale in zip(views, scales, strict=True)]
        again = _aligned(solver, poses, grown, use)
        poses = again.solution.poses
    if np.abs(scales).max() > _LEAST_SCALE and _problem(again, config) is None and again.fit.min() >= CLEAR_FIT:
        worst = int(np.abs(scales).argmax())
        return (
            f"camera {worst + 1} of {len(views)} magnifies the teeth by {100 * scales[worst]:+.1f} % relative to the "
            "scans and its calibration, and everything fits once that is corrected: its focal length is wrong"
        )
    return None


def _without(use: Mask, left_out: Mask) -> Mask:
    """Return the masks (2, C) without some of them, except for arches that would have too few masks."""
    kept = use & ~left_out
    return np.where(kept.sum(1, keepdims=True) >= FEWEST_MASKS, kept, use)
