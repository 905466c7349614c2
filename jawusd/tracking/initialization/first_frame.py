"""The first frame: from picked poses to an aligned one, with the checks only a first frame needs."""

from __future__ import annotations

import numpy as np

from jawusd.errors import TrackingError
from jawusd.formats.tracks import PARTIAL, TRACKED
from jawusd.geometry.arrays import Array
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import row_fit, score_px, uncovered_px
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews

_ROWS = (0, 1)
_NAMES = ("upper", "lower")
# Least `row_fit` of a first frame [-]: teeth that slid along by one reach 0 in one of the rows, right poses 0.1 even
# with lips nearly closed.
_LEAST_FIT = 0.05


def first_record(
    solver: ContourSolver, config: TrackingConfig, start: Array, masks: MaskViews, frame: int
) -> FrameRecord:
    """Align the bootstrap frame, starting from the picks.

    Args:
        solver: aligns frames.
        config: thresholds of the tracker.
        start: T_world_upper, T_world_lower from the picks, shape (2, 4, 4).
        masks: the masks of the take.
        frame: the bootstrap frame.

    Raises:
        TrackingError: too few masks on this frame, or no alignment.
    """
    views = masks.at(frame)
    use = np.array([[v.present[r] for v in views] for r in _ROWS])
    for r in _ROWS:
        if use[r].sum() < 2:
            raise TrackingError(
                f"{use[r].sum()} masks of the {_NAMES[r]} teeth, the first frame needs two",
                frame=frame,
                hint="Choose a bootstrap frame that is segmented in every camera.",
            )
    best: Solution | None = None
    for gates in (config.gates_from(0.0), config.wide_gates_px):
        trial = solver.solve(start, views, gates, use)
        if best is None:
            best = trial
        elif (take := score_px(trial).sum(1) > score_px(best).sum(1)).any():
            poses = np.where(take[:, None, None], trial.poses, best.poses)
            best = solver.solve(poses, views, config.wide_gates_px[-2:], use)
    bare_px, mask_px = uncovered_px(solver.scans, best, views)
    coverage = np.where(mask_px > 0, bare_px / np.maximum(mask_px, 1), np.nan)
    fit = row_fit(solver.scans, best, views, config.bare_price)
    for r in _ROWS:
        share = score_px(best)[r].sum() / max(best.visible_px[r].sum(), 1.0)
        bare = np.nanmedian(coverage[r])
        if share < config.first_share or bare > config.lost_coverage or fit[r] < _LEAST_FIT:
            raise TrackingError(
                f"the {_NAMES[r]} teeth do not fit their masks: {share:.0%} of the visible contour "
                f"matches (at least {config.first_share:.0%} is needed), {bare:.1%} of the masks stays uncovered "
                f"(at most {config.lost_coverage:.0%} is allowed), and the first less the price of the second is "
                f"{fit[r]:.2f} (at least {_LEAST_FIT} is needed)",
                frame=frame,
                hint="Check the picks, the calibration, the time offsets and the masks of this frame.",
            )
    status = np.where(use.all(1), TRACKED, PARTIAL).astype(np.int8)
    return FrameRecord(best, status, use, coverage)
