"""Frames that show both arches well, from which others can be judged."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jawusd.formats.tracks import TRACKED
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import residual_px, score_px

# Of the medians of the take, per arch. They only tell where tracking back to the first frame begins, and so what it
# costs: what is kept there is decided frame by frame.
_LEAST_SCORE, _MOST_RESIDUAL = 0.8, 1.2


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
