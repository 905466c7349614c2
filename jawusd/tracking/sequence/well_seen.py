"""Frames that show both arches well, from which others are judged, and frames that show them too poorly."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from dataclasses import replace

import numpy as np

from jawusd.formats.tracks import LOST, TRACKED, LostReason
from jawusd.tracking.contour.frame_record import FrameRecord, Loss
from jawusd.tracking.contour.quality import residual_px, score_px
from jawusd.tracking.contour.scan import ARCHES

# Of the medians of the take, per arch. They only tell where tracking back to the first frame begins, and so what it
# costs: what is kept there is decided frame by frame.
_LEAST_SCORE, _MOST_RESIDUAL = 0.8, 1.2
# Of the medians of the take, per arch: with a smaller share of the visible contour and a larger residual at once, the
# edges of lips were taken for the teeth's. Chosen on 15 persons with lips in the way (9600-9614 and 9503-9521 of
# `tests/benchmarks/population.py`, 360 arches in frames): it names the three that were 0.6 to 0.9 mm off at a promised
# 0.15 (0.3 of the median share, 1.8 times the residual), and no other. Of nine persons besides, none of 216 was named,
# at most 1.4 % (95 %), nor any of 833 frames of a long take (at most 1.43 times the residual).
_POOR_SHARE, _POOR_RESIDUAL, _TELLING_FRAMES = 0.5, 1.6, 6


def nearest_well_seen(records: Mapping[int, FrameRecord], start: int) -> int | None:
    """Return the frame nearest to a given one in which as much of both arches fits, and as well, as usual in the take.

    None if there is none.
    """
    frames = [frame for frame, record in records.items() if (record.status == TRACKED).all()]
    if not frames:
        return None
    scores = np.array([score_px(records[frame].solution).sum(1) for frame in frames])
    residuals = np.array([residual_px(records[frame].solution) for frame in frames])
    well = (scores >= _LEAST_SCORE * np.median(scores, axis=0)) & (
        residuals <= _MOST_RESIDUAL * np.median(residuals, axis=0)
    )
    seen = np.array(frames)[well.all(1)]
    return min(seen.tolist(), key=lambda frame: (abs(frame - start), frame), default=None)


def give_up_poorly_seen(records: MutableMapping[int, FrameRecord]) -> None:
    """Mark arches lost in frames in which far less of them fits than usual in the take, and far more roughly."""
    frames = sorted(records)
    kept = np.array([records[frame].status != LOST for frame in frames])
    share, residual = (np.full((len(frames), 2), np.nan) for _ in range(2))
    for k, frame in enumerate(frames):
        solution = records[frame].solution
        share[k] = score_px(solution).sum(1) / np.maximum(solution.visible_px.sum(1), 1.0)
        residual[k] = residual_px(solution)
    if (kept.sum(0) < _TELLING_FRAMES).any():
        return
    usual = [[float(np.nanmedian(values[kept[:, r], r])) for r in ARCHES] for values in (share, residual)]
    relative = share / np.array(usual[0])
    poor = kept & (relative < _POOR_SHARE) & (residual > _POOR_RESIDUAL * np.array(usual[1]))
    for k in np.flatnonzero(poor.any(1)).tolist():
        record = records[frames[k]]
        losses = [
            Loss(LostReason.LOW_SCORE, float(relative[k, r]), _POOR_SHARE) if poor[k, r] else record.losses[r]
            for r in ARCHES
        ]
        status = np.where(poor[k], LOST, record.status).astype(np.int8)
        records[frames[k]] = replace(record, status=status, losses=(losses[0], losses[1]))
