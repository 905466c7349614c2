"""What is known about single frames, and what the good ones lately looked like."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.formats.tracks import TRACKED
from jawusd.geometry.arrays import Array, Mask
from jawusd.tracking.quality import residual_px, score_px
from jawusd.tracking.solver import Solution


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """Hold what is known about one instant.

    Attributes:
        solution: the alignment; its poses of lost rows mean nothing.
        status: of both rows, as in `Tracks`, shape (2,).
        used: masks that took part, shape (2, C).
        coverage: E_SP over mask pixels, shape (2, C); NaN without a mask.
    """

    solution: Solution
    status: NDArray[np.int8]
    used: Mask
    coverage: Array


@dataclass(frozen=True, eq=False)
class Past:
    """Hold what the frames after an instant need to know about it.

    Attributes:
        poses: T_world_upper and T_world_lower, shape (2, 4, 4).
        status, used, coverage: as in `FrameRecord`.
        score_px: contour that fits per row and view, shape (2, C).
        residual_px: standard deviation of the residuals per row, shape (2,).
    """

    poses: Array
    status: NDArray[np.int8]
    used: Mask
    coverage: Array
    score_px: Array
    residual_px: Array

    @classmethod
    def of(cls, record: FrameRecord) -> Past:
        """Return what to keep of a frame."""
        solution = record.solution
        seen = (record.status, record.used, record.coverage)
        return cls(solution.poses, *seen, score_px(solution), residual_px(solution))


class History:
    """Remember what good frames looked like lately, to tell a bad one."""

    def __init__(self, length: int, score_length: int) -> None:
        """Start empty; keep at most `length` frames, scores of at most `score_length`."""
        self._scores: deque[NDArray] = deque(maxlen=score_length)
        self._residuals: deque[NDArray] = deque(maxlen=length)
        self._coverages: deque[NDArray] = deque(maxlen=length)

    def add(self, record: FrameRecord) -> None:
        """Take in a frame; only rows tracked without trouble count."""
        self.take_up(Past.of(record))

    def take_up(self, past: Past) -> None:
        """Take in what was kept of a frame."""
        good = past.status == TRACKED
        self._scores.append(np.where(good[:, None], past.score_px, np.nan))
        self._residuals.append(np.where(good, past.residual_px, np.nan))
        self._coverages.append(np.where(good[:, None] & past.used, past.coverage, np.nan))

    def usual_score(self) -> Array:
        """Return the median score per row and view [px], shape (2, C); 0 while unknown."""
        return _median(self._scores, 0.0)

    def usual_residual(self) -> Array:
        """Return the median residual per row [px], shape (2,); infinite while unknown."""
        return _median(self._residuals, np.inf)

    def usual_coverage(self) -> Array:
        """Return the median coverage error per row and view, shape (2, C); 0 while unknown."""
        return _median(self._coverages, 0.0)


def _median(values: deque[NDArray], otherwise: float) -> Array:
    stack = np.array(values)
    known = np.isfinite(stack).any(0)
    out = np.full(stack.shape[1:], otherwise)
    out[known] = np.nanmedian(stack[:, known], axis=0)
    return out
