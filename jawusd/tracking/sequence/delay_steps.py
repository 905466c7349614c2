"""Frames that a camera dropped or doubled in mid take: a step of its delay, wherever it lies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.sequence.extrinsics import Extrinsics
from jawusd.tracking.sequence.nuisance import TakeEquations

_PRIOR_FRAMES = 1.0  # standard deviation of a step
_LEAST_FRAMES = 2  # on either side of it


@dataclass(frozen=True)
class DelayStep:
    """The clearest step of one camera's delay: its size and standard deviation [frames], and the first frame after."""

    step: float
    sigma: float
    frame: int


def delay_steps(
    records: Mapping[int, FrameRecord], variance_px3: Array, extrinsics: Extrinsics, frames: list[int]
) -> list[DelayStep]:
    """Return the clearest step of every camera's delay over some frames; nothing if these are too few.

    One camera's delay from a frame on is added to the unknowns of the take (see `TakeEquations`), for every camera and
    every place in turn; all others are eliminated.

    Args:
        records, variance_px3, extrinsics: as for `TakeEquations`.
        frames: in which both arches are tracked, in order.
    """
    if len(frames) < 2 * _LEAST_FRAMES:
        return []
    cameras = len(extrinsics.twists)
    S, right = TakeEquations(records, variance_px3, extrinsics, []).normal_equations()
    # Of the delays, per frame, then summed up in place from each frame on: of long takes, tens of megabytes.
    after_S = np.empty((len(frames), len(right), cameras))
    after_r = np.empty((len(frames), cameras))
    for k, frame in enumerate(frames):
        own_S, own_right = TakeEquations(records, variance_px3, extrinsics, [frame]).normal_equations()
        S, right = S + own_S, right + own_right
        after_S[k], after_r[k] = own_S[:, :cameras], own_right[:cameras]
    for table in (after_S, after_r):
        np.cumsum(table[::-1], axis=0, out=table[::-1])
    prior = np.linalg.pinv(TakeEquations(records, variance_px3, extrinsics, []).prior_covariance())
    fixed = len(right) - 6 * cameras  # camera motions are taken as known
    keep = np.arange(1, fixed)
    A = np.linalg.inv((S + prior)[np.ix_(keep, keep)])
    out = []
    for c in range(cameras):
        best = DelayStep(0.0, 1.0, frames[0])
        for k in range(_LEAST_FRAMES, len(frames) - _LEAST_FRAMES + 1):
            b = after_S[k][keep, c]
            precision = float(after_S[k][c, c] - b @ A @ b) + _PRIOR_FRAMES**-2
            step = float(after_r[k][c] - b @ A @ right[keep]) / precision
            sigma = precision**-0.5
            if abs(step) / sigma > abs(best.step) / best.sigma:
                best = DelayStep(step, sigma, frames[k])
        out.append(best)
    return out
