"""What a whole take tells: time offsets below a frame, masks drawn too wide, wrong camera poses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from jawusd.formats.tracks import LOST
from jawusd.geometry import make_transform, se3_exp, se3_inverse, se3_log
from jawusd.geometry.arrays import Array
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.sequence.extrinsics import Extrinsics, lever


@dataclass(frozen=True, eq=False)
class Nuisances:
    """Hold the disturbances common to all frames of a take.

    Attributes:
        delays: camera c shows the instant of frame + delays[c], in frames, the first camera's is 0, shape (C,).
        bias_px: how far the masks of each row reach beyond the teeth at the working size, shape (2,).
        sigma_delays, sigma_bias_px: their standard deviations, shapes (C,) and (2,).
        twists, sigma_twists: corrections of the camera poses as in `Extrinsics`, shape (C, 6).
        shift_px: rms distance by which the twists shift contours beyond what poses of the teeth make up for.
    """

    delays: Array
    bias_px: Array
    sigma_delays: Array
    sigma_bias_px: Array
    twists: Array
    sigma_twists: Array
    shift_px: float = 0.0

    def plus(self, more: Nuisances) -> Nuisances:
        """Return the sum with delays and biases that were estimated on top of these."""
        return replace(more, delays=self.delays + more.delays, bias_px=self.bias_px + more.bias_px)

    def matters(self, config: TrackingConfig) -> bool:
        """Tell whether anything exceeds its limit, and clearly so."""
        late = np.abs(self.delays) > np.maximum(config.refine_delay_frames, 4 * self.sigma_delays)
        wide = np.abs(self.bias_px) > np.maximum(config.refine_bias_px, 4 * self.sigma_bias_px)
        return bool(late.any() or wide.any() or self.cameras_moved(config))

    def settled(self, config: TrackingConfig) -> bool:
        """Tell whether all are so small that estimating them once more is not worth it."""
        late = np.abs(self.delays).max() / config.refine_delay_frames
        wide = np.abs(self.bias_px).max() / config.refine_bias_px
        return max(late, wide, self.shift_px / config.refine_shift_px) < config.settled_share

    def cameras_moved(self, config: TrackingConfig) -> bool:
        """Tell whether the camera poses are off by more than the limit, and clearly so."""
        clear = (np.abs(self.twists) > 4 * self.sigma_twists).any()
        return bool(clear and self.shift_px > config.refine_shift_px)


# Spread expected before looking, which keeps them finite where a take says nothing: cameras synchronised to whole
# frames, masks by different hands.
_PRIOR_DELAY_FRAMES = 0.5
_PRIOR_BIAS_PX = 0.5


class TakeEquations:
    """Sum up the normal equations of what all frames share, the poses eliminated frame by frame.

    The residual of a sample is d = J (x + delay_c v + A y_c) + bias with the pose correction x of its frame, the row's
    velocity v, and the camera's twist y_c brought to the row's centre by A, so all frames share delays, biases and
    twists: a bordered block-diagonal system, solved by its Schur complement (as in bundle adjustment, Triggs et al.
    1999).
    """

    def __init__(
        self,
        records: Mapping[int, FrameRecord],
        variance_px3: Array,
        extrinsics: Extrinsics,
        frames: Iterable[int] | None = None,
    ) -> None:
        """Sum up.

        Args:
            records: by frame; rows lost, and frames without both neighbours, are left out.
            variance_px3: outline variance times correlation length per row [px^3], shape (2,).
            extrinsics: the camera poses the records were aligned with.
            frames: the frames to use, by default all.
        """
        self._extrinsics = extrinsics
        self._cameras = len(extrinsics.twists)
        size = 7 * self._cameras + 2
        self._S, self._r, self._weight = np.zeros((size, size)), np.zeros(size), 0.0
        for frame in sorted(records if frames is None else frames):
            for row in (0, 1):
                velocity = velocity_twist(records, frame, row)
                if velocity is not None:
                    block, right, weight = _reduced(records[frame].solution, velocity, row, extrinsics.pivot)
                    self._S += block / variance_px3[row]
                    self._r += right / variance_px3[row]
                    self._weight += weight / variance_px3[row]

    def solve(self, config: TrackingConfig, cameras_move: bool) -> Nuisances:
        """Return the nuisances the frames show.

        Args:
            config: gives the spread of camera poses expected before looking.
            cameras_move: estimate the camera poses too; else they are taken as they are.
        """
        C, size = self._cameras, len(self._r)
        S = self._S.copy()
        prior = np.r_[np.full(C, _PRIOR_DELAY_FRAMES), np.full(2, _PRIOR_BIAS_PX)]
        S[: C + 2, : C + 2] += np.diag(prior**-2.0)
        for c, precision in enumerate(self._extrinsics.precision(config.refine_turn_rad, config.refine_move_mm)):
            block = slice(C + 2 + 6 * c, C + 8 + 6 * c)
            S[block, block] += precision
        keep = np.arange(1, size if cameras_move else C + 2)  # a delay common to all cameras is part of the motion
        covariance = np.zeros((size, size))
        covariance[np.ix_(keep, keep)] = np.linalg.inv(S[np.ix_(keep, keep)])
        x = covariance @ self._r
        # A motion common to all cameras is one of the world, of which the masks tell nothing.
        centred = np.eye(6 * C) - np.kron(np.full((C, C), 1 / C), np.eye(6))
        twists = centred @ x[C + 2 :]
        sigma = np.sqrt(np.diag(covariance))
        sigma_twists = np.sqrt(np.diag(centred @ covariance[C + 2 :, C + 2 :] @ centred))
        square = twists @ self._S[C + 2 :, C + 2 :] @ twists / max(self._weight, 1e-300)
        return Nuisances(
            delays=x[:C],
            bias_px=x[C : C + 2],
            sigma_delays=sigma[:C],
            sigma_bias_px=sigma[C : C + 2],
            twists=twists.reshape(C, 6),
            sigma_twists=sigma_twists.reshape(C, 6),
            shift_px=float(np.sqrt(max(square, 0.0))),
        )


def leads(records: Mapping[int, FrameRecord], frame: int, delays: Array) -> Array:
    """Return the motion of both rows from the reference instant to each camera's own, shape (C, 2, 4, 4)."""
    out = np.tile(np.eye(4), (len(delays), 2, 1, 1))
    for row in (0, 1):
        velocity = velocity_twist(records, frame, row)
        if velocity is None:
            across = bridge(records, frame, row)
            velocity = None if across is None else across[1]
        if velocity is not None:
            to = make_transform(np.eye(3), -records[frame].solution.centres[row])
            out[:, row] = se3_inverse(to) @ se3_exp(delays[:, None] * velocity) @ to
    return out


def _reduced(solution, velocity, row: int, pivot) -> tuple[Array, Array, float]:
    """Return one frame's part of the normal equations, the pose eliminated, and the weight of its samples."""
    outline = solution.outline
    C = len(outline.weight[row])
    size = 7 * C + 2
    to_centre = lever(pivot, solution.centres[row])
    S, r, B = np.zeros((size, size)), np.zeros(size), np.zeros((6, size))
    bias = np.eye(size)[C + row]
    for c in range(C):
        H, g, s = outline.precision[row, c], outline.gradient[row, c], outline.bias_slope[row, c]
        D = np.zeros((6, size))  # how the nuisances move the row in this camera
        D[:, c] = velocity
        D[:, C + 2 + 6 * c : C + 8 + 6 * c] = to_centre
        B += H @ D + np.outer(s, bias)
        S += (
            D.T @ H @ D
            + np.outer(D.T @ s, bias)
            + np.outer(bias, s @ D)
            + outline.weight[row, c] * np.outer(bias, bias)
        )
        r += D.T @ g + outline.distance[row, c] * bias
    H, g = outline.precision[row].sum(0), outline.gradient[row].sum(0)
    eliminated = np.linalg.lstsq(H, np.column_stack([B, g]), rcond=1e-10)[0]
    return S - B.T @ eliminated[:, :-1], r - B.T @ eliminated[:, -1], float(outline.weight[row].sum())


def velocity_twist(records: Mapping[int, FrameRecord], frame: int, row: int) -> Array | None:
    """Return the twist per frame about the row's centre, shape (6,); None without tracked frames before and after."""
    around = [records.get(f) for f in (frame - 1, frame, frame + 1)]
    if any(r is None or r.status[row] == LOST for r in around):
        return None
    before, now, after = (r.solution for r in around)
    to = make_transform(np.eye(3), -now.centres[row])
    step = to @ after.poses[row] @ se3_inverse(before.poses[row]) @ se3_inverse(to)
    return 0.5 * se3_log(step)


_BRIDGE_FRAMES = 6  # a quarter of a second at 24 fps: jaws turn round in less than two of these


def bridge(records: Mapping[int, FrameRecord], frame: int, row: int) -> tuple[Array, Array] | None:
    """Return a row's pose (4, 4) and twist per frame about its centre (6,), going evenly between tracked frames.

    None without tracked frames close by on both sides.
    """
    reach = range(1, _BRIDGE_FRAMES + 1)

    def known(f: int) -> bool:
        return f in records and records[f].status[row] != LOST

    before = next((frame - k for k in reach if known(frame - k)), None)
    after = next((frame + k for k in reach if known(frame + k)), None)
    if before is None or after is None:
        return None
    to = make_transform(np.eye(3), -records[frame].solution.centres[row])
    start, end = (records[f].solution.poses[row] for f in (before, after))
    twist = se3_log(to @ end @ se3_inverse(start) @ se3_inverse(to)) / (after - before)
    return se3_inverse(to) @ se3_exp((frame - before) * twist) @ to @ start, twist
