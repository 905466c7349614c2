"""What a whole take tells about its cameras and masks: time offsets below a frame, and masks drawn too wide."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.formats.tracks import LOST
from jawusd.geometry import make_transform, se3_exp, se3_inverse, se3_log
from jawusd.tracking.history import FrameRecord


@dataclass(frozen=True, eq=False)
class Nuisances:
    """Hold the disturbances common to all frames of a take.

    Attributes:
        delays: camera c shows the instant of frame + delays[c], in frames, the first camera's is 0, shape (C,).
        bias_px: how far the masks of each row reach beyond the teeth at the working size, shape (2,).
        sigma_delays, sigma_bias_px: their standard deviations, shapes (C,) and (2,).
    """

    delays: NDArray[np.float64]
    bias_px: NDArray[np.float64]
    sigma_delays: NDArray[np.float64]
    sigma_bias_px: NDArray[np.float64]

    def plus(self, more: Nuisances) -> Nuisances:
        """Return the sum with what was estimated on top of this."""
        return Nuisances(self.delays + more.delays, self.bias_px + more.bias_px, more.sigma_delays, more.sigma_bias_px)

    def matters(self, delay_frames: float, bias_px: float) -> bool:
        """Tell whether anything exceeds its limit, and clearly so."""
        late = np.abs(self.delays) > np.maximum(delay_frames, 4 * self.sigma_delays)
        wide = np.abs(self.bias_px) > np.maximum(bias_px, 4 * self.sigma_bias_px)
        return bool(late.any() or wide.any())


# Spread expected before looking, which keeps them finite where a take says nothing: cameras synchronised to whole
# frames, masks by different hands.
_PRIOR_DELAY_FRAMES = 0.5
_PRIOR_BIAS_PX = 0.5


def estimate_nuisances(records: Mapping[int, FrameRecord], variance_px3: NDArray[np.float64]) -> Nuisances:
    """Estimate delays and biases from the normal equations of all frames, the poses eliminated frame by frame.

    The residual of a sample is d = J (x + delay_c v) + bias with the pose correction x of its frame and the row's
    velocity v, so all frames share delays and biases: a bordered block-diagonal system, solved by its Schur
    complement (as in bundle adjustment, Triggs et al. 1999).

    Args:
        records: by frame; rows lost, and frames without both neighbours, are left out.
        variance_px3: outline variance times correlation length per row [px^3], shape (2,).
    """
    cameras = next(iter(records.values())).used.shape[1]
    size = cameras + 2
    S, r = np.zeros((size, size)), np.zeros(size)
    for frame in sorted(records):
        for row in (0, 1):
            velocity = velocity_twist(records, frame, row)
            if velocity is not None:
                block, right = _reduced(records[frame].solution.systems[row], velocity, row)
                S += block / variance_px3[row]
                r += right / variance_px3[row]
    prior = np.r_[np.full(cameras, _PRIOR_DELAY_FRAMES), np.full(2, _PRIOR_BIAS_PX)]
    S += np.diag(prior**-2.0)
    keep = np.arange(1, size)  # a delay common to all cameras cannot be told from motion
    covariance = np.zeros((size, size))
    covariance[np.ix_(keep, keep)] = np.linalg.inv(S[np.ix_(keep, keep)])
    x, sigma = covariance @ r, np.sqrt(np.diag(covariance))
    return Nuisances(x[:cameras], x[cameras:], sigma[:cameras], sigma[cameras:])


def leads(records: Mapping[int, FrameRecord], frame: int, delays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the motion of both rows from the reference instant to each camera's own, shape (C, 2, 4, 4)."""
    out = np.tile(np.eye(4), (len(delays), 2, 1, 1))
    for row in (0, 1):
        velocity = velocity_twist(records, frame, row)
        if velocity is not None:
            to = make_transform(np.eye(3), -records[frame].solution.centres[row])
            out[:, row] = se3_inverse(to) @ se3_exp(delays[:, None] * velocity) @ to
    return out


def _reduced(systems: NDArray[np.float64], velocity: NDArray[np.float64], row: int) -> tuple[NDArray, NDArray]:
    """Return one frame's part of the normal equations of delays and biases, the pose eliminated."""
    cameras = len(systems)
    size = cameras + 2
    b = cameras + row
    S, r, B = np.zeros((size, size)), np.zeros(size), np.zeros((6, size))
    for c, system in enumerate(systems):
        H, g, s = system[:6, :6], system[:6, 6], system[:6, 7]
        B[:, c] = H @ velocity
        B[:, b] += s
        S[c, c] = velocity @ H @ velocity
        S[c, b] = S[b, c] = velocity @ s
        S[b, b] += system[6, 6]
        r[c] = velocity @ g
        r[b] += system[6, 7]
    H, g = systems[:, :6, :6].sum(0), systems[:, :6, 6].sum(0)
    eliminated = np.linalg.lstsq(H, np.column_stack([B, g]), rcond=1e-10)[0]
    return S - B.T @ eliminated[:, :-1], r - B.T @ eliminated[:, -1]


def velocity_twist(records: Mapping[int, FrameRecord], frame: int, row: int) -> NDArray[np.float64] | None:
    """Return the twist per frame about the row's centre, shape (6,); None without tracked frames before and after."""
    around = [records.get(f) for f in (frame - 1, frame, frame + 1)]
    if any(r is None or r.status[row] == LOST for r in around):
        return None
    before, now, after = (r.solution for r in around)
    to = make_transform(np.eye(3), -now.centres[row])
    step = to @ after.poses[row] @ se3_inverse(before.poses[row]) @ se3_inverse(to)
    return 0.5 * se3_log(step)
