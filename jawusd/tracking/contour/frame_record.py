"""What is known about single frames, and why an arch was given up in one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.formats.tracks import LOST, LostReason
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.quality import residual_px, score_px


class Loss(NamedTuple):
    """Name the check an arch failed, with the figure found and its limit in the unit of `LostReason`."""

    reason: LostReason
    value: float
    limit: float


#: Of an arch that is not lost, or whose loss has no recorded reason.
NO_LOSS = Loss(LostReason.NONE, np.nan, np.nan)


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """Hold what is known about one instant."""

    solution: Solution  # the alignment; its poses of lost arches mean nothing
    status: NDArray[np.int8]  # of both arches, as in `Tracks`, shape (2,)
    used: Mask  # masks that took part, shape (2, C)
    coverage: Array  # E_SP over mask pixels, shape (2, C); NaN without a mask
    losses: tuple[Loss, Loss] = (NO_LOSS, NO_LOSS)  # why each arch is lost


def whole_frames(records: Mapping[int, FrameRecord]) -> list[int]:
    """Return the frames in which both arches are tracked, in order."""
    return [frame for frame in sorted(records) if (records[frame].status != LOST).all()]


@dataclass(frozen=True, eq=False)
class FrameSummary:
    """Hold what the frames after an instant need to know about it.

    Attributes:
        poses: T_world_upper and T_world_lower, shape (2, 4, 4).
        status, used, coverage: as in `FrameRecord`.
        score_px: contour that fits per arch and view, shape (2, C).
        residual_px: standard deviation of the residuals per arch, shape (2,).
    """

    poses: Array
    status: NDArray[np.int8]
    used: Mask
    coverage: Array
    score_px: Array
    residual_px: Array

    @classmethod
    def of(cls, record: FrameRecord) -> FrameSummary:
        """Return what to keep of a frame."""
        solution = record.solution
        seen = (record.status, record.used, record.coverage)
        return cls(solution.poses, *seen, score_px(solution), residual_px(solution))
