"""Disturbances estimated from a whole take: delays below a frame, masks drawn too wide, wrong camera poses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from jawusd.formats.tracks import LOST
from jawusd.geometry.arrays import Array
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution, motion_about, twist_between
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.scan import ARCHES
from jawusd.tracking.sequence.extrinsics import Extrinsics, lever


@dataclass(frozen=True, eq=False)
class Nuisances:
    """Hold the disturbances common to all frames of a take.

    Attributes:
        delays: camera c shows the instant of frame + delays[c], in frames, the first camera's is 0, shape (C,).
        bias_px: how far the masks of each arch reach beyond the teeth at the working size, shape (2,).
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
        """Tell whether all are so small that estimating them once more changes too little."""
        late = np.abs(self.delays).max() / config.refine_delay_frames
        wide = np.abs(self.bias_px).max() / config.refine_bias_px
        return max(late, wide, self.shift_px / config.refine_shift_px) < config.settled_share

    def cameras_moved(self, config: TrackingConfig) -> bool:
        """Tell whether the camera poses are off by more than the limit, and clearly so."""
        clear = (np.abs(self.twists) > 4 * self.sigma_twists).any()
        return bool(clear and self.shift_px > config.refine_shift_px)


# Prior standard deviations, which keep the estimates finite where a take does not constrain them: cameras synchronised
# to whole frames, masks by different hands.
_PRIOR_DELAY_FRAMES = 0.5
_PRIOR_BIAS_PX = 0.5


class TakeEquations:
    """Sum up the normal equations of what all frames share, the poses eliminated frame by frame.

    The residual of a sample is d = J (x + delay_c v + A y_c) + bias with the pose correction x of its frame, the arch's
    velocity v, and the camera's twist y_c brought to the arch's centre by A, so all frames share delays, biases and
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
        """Sum up the given frames, by default all; lost arches and frames without both neighbours are left out.

        Args:
            records: by frame.
            variance_px3: outline variance times correlation length per arch [px^3], shape (2,).
            extrinsics: the camera poses the records were aligned with.
        """
        self._extrinsics = extrinsics
        self._cameras = len(extrinsics.twists)
        size = 7 * self._cameras + 2
        self._S, self._r, self._weight = np.zeros((size, size)), np.zeros(size), 0.0
        for frame in sorted(records if frames is None else frames):
            for arch in ARCHES:
                velocity = velocity_twist(records, frame, arch)
                if velocity is not None:
                    block, right, weight = _reduced(records[frame].solution, velocity, arch, extrinsics.pivot)
                    self._S += block / variance_px3[arch]
                    self._r += right / variance_px3[arch]
                    self._weight += weight / variance_px3[arch]

    def solve(self, config: TrackingConfig, cameras_move: bool) -> Nuisances:
        """Return the nuisances of the frames; camera poses are estimated only if `cameras_move`."""
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
        # A motion common to all cameras is one of the world, which the masks cannot show.
        centred = np.eye(6 * C) - np.kron(np.full((C, C), 1 / C), np.eye(6))
        twists = centred @ x[C + 2 :]
        sigma = np.sqrt(np.diag(covariance))
        sigma_twists = np.sqrt(np.diag(centred @ covariance[C + 2 :, C + 2 :] @ centred))
        square = float(twists @ self._S[C + 2 :, C + 2 :] @ twists) / max(self._weight, 1e-300)
        return Nuisances(
            delays=x[:C],
            bias_px=x[C : C + 2],
            sigma_delays=sigma[:C],
            sigma_bias_px=sigma[C : C + 2],
            twists=twists.reshape(C, 6),
            sigma_twists=sigma_twists.reshape(C, 6),
            shift_px=float(np.sqrt(max(square, 0.0))),
        )


def delay_motions(records: Mapping[int, FrameRecord], frame: int, delays: Array) -> Array:
    """Return the motion of both arches from the reference instant to each camera's own, shape (C, 2, 4, 4)."""
    out = np.tile(np.eye(4), (len(delays), 2, 1, 1))
    for arch in ARCHES:
        velocity = velocity_twist(records, frame, arch)
        if velocity is None:
            across = bridge(records, frame, arch)
            velocity = None if across is None else across[1]
        if velocity is not None:
            out[:, arch] = motion_about(records[frame].solution.centres[arch], delays[:, None] * velocity)
    return out


def _reduced(solution: Solution, velocity: Array, arch: int, pivot: Array) -> tuple[Array, Array, float]:
    """Return one frame's part of the normal equations, the pose eliminated, and the weight of its samples."""
    outline = solution.outline
    C = len(outline.weight[arch])
    size = 7 * C + 2
    to_centre = lever(pivot, solution.centres[arch])
    S, r, B = np.zeros((size, size)), np.zeros(size), np.zeros((6, size))
    bias = np.eye(size)[C + arch]
    for c in range(C):
        H, g, s = outline.precision[arch, c], outline.gradient[arch, c], outline.bias_slope[arch, c]
        D = np.zeros((6, size))  # how the nuisances move the arch in this camera
        D[:, c] = velocity
        D[:, C + 2 + 6 * c : C + 8 + 6 * c] = to_centre
        B += H @ D + np.outer(s, bias)
        S += D.T @ H @ D + np.outer(D.T @ s, bias) + np.outer(bias, s @ D)
        S += outline.weight[arch, c] * np.outer(bias, bias)
        r += D.T @ g + outline.distance[arch, c] * bias
    H, g = outline.precision[arch].sum(0), outline.gradient[arch].sum(0)
    eliminated = np.linalg.lstsq(H, np.column_stack([B, g]), rcond=1e-10)[0]
    return S - B.T @ eliminated[:, :-1], r - B.T @ eliminated[:, -1], float(outline.weight[arch].sum())


def velocity_twist(records: Mapping[int, FrameRecord], frame: int, arch: int) -> Array | None:
    """Return the twist per frame about the arch's centre, shape (6,); None without tracked frames before and after."""
    if not all(_is_tracked(records, f, arch) for f in (frame - 1, frame, frame + 1)):
        return None
    before, now, after = (records[f].solution for f in (frame - 1, frame, frame + 1))
    return 0.5 * twist_between(before.poses[arch], after.poses[arch], now.centres[arch])


def _is_tracked(records: Mapping[int, FrameRecord], frame: int, arch: int) -> bool:
    return frame in records and bool(records[frame].status[arch] != LOST)


_BRIDGE_FRAMES = 6  # a quarter of a second at 24 fps: jaws turn round in less than two of these


def bridge(records: Mapping[int, FrameRecord], frame: int, arch: int) -> tuple[Array, Array] | None:
    """Interpolate an arch evenly between tracked frames: its pose (4, 4) and twist per frame about its centre (6,).

    None without tracked frames close by on both sides.
    """
    reach = range(1, _BRIDGE_FRAMES + 1)
    before = next((frame - k for k in reach if _is_tracked(records, frame - k, arch)), None)
    after = next((frame + k for k in reach if _is_tracked(records, frame + k, arch)), None)
    if before is None or after is None:
        return None
    centre = records[frame].solution.centres[arch]
    start, end = (records[f].solution.poses[arch] for f in (before, after))
    twist = twist_between(start, end, centre) / (after - before)
    return motion_about(centre, (frame - before) * twist) @ start, twist
