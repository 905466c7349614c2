"""Nuisance parameters of a whole take: delays shorter than a frame, mask biases, and errors of camera poses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import se3_adjoint
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.annotator import DRAWN, AnnotatorPrior, bias_layers
from jawusd.tracking.contour.equations import Solution, motion_about, translation
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.scan import ARCHES
from jawusd.tracking.sequence.delays import interpolation_errors, velocity_twist
from jawusd.tracking.sequence.extrinsics import Extrinsics


@dataclass(frozen=True, eq=False)
class Nuisances:
    """Nuisance parameters common to all frames of a take, with the standard deviations of these estimates."""

    #: exposure times relative to the first camera [frames], shape (C,): the image of camera c for a frame was taken at
    #: time frame + delays[c]
    delays: Array
    habits: Array  # outward mask bias, per arch and camera, with the components of `OutlineSums`, shape (2, C, 3)
    shift_px: Array  # the resulting mean shift of edges and gum line, shape (2, C, 2)
    sigma_delays: Array
    sigma_habits: Array
    twists: Array  # corrections of the camera poses as in `Extrinsics`, shape (C, 6)
    sigma_twists: Array
    contour_px: float  # rms contour shift by the twists, without the part that poses of the teeth compensate [px]
    covariance: Array  # of all unknowns in the order of `TakeEquations`, zero where not estimated, shape (U, U)

    def plus(self, more: Nuisances) -> Nuisances:
        """Return the sum of these estimates and further estimates of delays and annotator biases."""
        shift = self.shift_px + more.shift_px
        return replace(more, delays=self.delays + more.delays, habits=self.habits + more.habits, shift_px=shift)

    def matters(self, config: TrackingConfig) -> bool:
        """Return whether any estimate exceeds its limit; delays and camera poses must also be significant.

        Annotator biases have a prior, so even an insignificant estimate is the most likely value.
        """
        wide = np.abs(self.shift_px) > config.refine_bias_px
        return bool(self.late(config) or wide.any() or self.cameras_moved(config))

    def late(self, config: TrackingConfig) -> bool:
        """Return whether a delay exceeds its limit and is significant."""
        return bool((np.abs(self.delays) > np.maximum(config.refine_delay_frames, 4 * self.sigma_delays)).any())

    def settled(self, config: TrackingConfig) -> bool:
        """Return whether all estimates are small enough to need no further iteration."""
        late = np.abs(self.delays).max() / config.refine_delay_frames
        wide = np.abs(self.shift_px).max() / config.refine_bias_px
        return max(late, wide, self.contour_px / config.refine_shift_px) < config.settled_share

    def cameras_moved(self, config: TrackingConfig) -> bool:
        """Return whether the errors of camera poses exceed the limit and are significant."""
        clear = (np.abs(self.twists) > 4 * self.sigma_twists).any()
        return bool(clear and self.contour_px > config.refine_shift_px)


# Prior standard deviation of the delays that remain after cameras have been synchronised to whole frames.
_PRIOR_DELAY_FRAMES = 0.5


class _Layout:
    """Indices of the unknowns of a take: delays, annotator biases, and camera twists."""

    def __init__(self, cameras: int, annotator: AnnotatorPrior = DRAWN) -> None:
        self.cameras, self._annotator = cameras, annotator
        self.twists = cameras + 9 + 4 * cameras
        self.size = self.twists + 6 * cameras
        self._habits = np.zeros((2, cameras, 3, self.size))
        self._habits[..., cameras : self.twists] = bias_layers(cameras)

    def twist(self, camera: int) -> slice[int, int, None]:
        """Return the slice of a camera's twist in the unknowns."""
        return slice(self.twists + 6 * camera, self.twists + 6 * camera + 6)

    def habits(self, arch: int, camera: int) -> Array:
        """Return the matrix from the unknowns to the mask biases of an arch in a camera, shape (3, size)."""
        return np.asarray(self._habits[arch, camera])

    def prior_sigma(self) -> Array:
        """Return the prior standard deviations of delays and annotator biases, shape (twists,)."""
        return np.r_[np.full(self.cameras, _PRIOR_DELAY_FRAMES), self._annotator.sigma(self.cameras)]

    def redundancy(self, frames: int) -> Array:
        """Return the factor by which a number of frames overstates the information on each of the unknowns (size,)."""
        out = np.ones(self.size)
        out[self.cameras : self.twists] = self._annotator.redundancy(frames)
        return out


class TakeEquations:
    """Normal equations of the nuisance parameters of a take, with the poses eliminated frame by frame.

    The residual of a sample is d = J (x + delay_c v + A y_c) + h . b_c with the pose correction x of its frame, the
    arch's velocity v, the camera's twist y_c transferred to the arch's centre by A, and the biases b_c of the masks.
    The system is block-diagonal with a border, and is solved by its Schur complement (Triggs et al. 1999).
    """

    def __init__(
        self,
        records: Mapping[int, FrameRecord],
        variance_px3: Array,
        extrinsics: Extrinsics,
        frames: Iterable[int] | None = None,
        annotator: AnnotatorPrior = DRAWN,
    ) -> None:
        """Sum over the given frames (default: all); lost arches and frames without both neighbours are skipped.

        Args:
            variance_px3: outline variance times correlation length per arch [px^3], shape (2,).
            extrinsics: the camera poses used for the alignment.
            annotator: prior of the mask biases.
        """
        self.records, self.variance_px3, self.extrinsics = records, variance_px3, extrinsics
        self._layout = _Layout(len(extrinsics.twists), annotator)
        size, C = self._layout.size, self._layout.cameras
        self._S, self._r, self._weight = np.zeros((size, size)), np.zeros(size), 0.0
        # sums of weights, and of weighted image shifts per mm along the surface, at the gum line
        self._gum = np.zeros((2, C, 2))
        self._frames = 0
        self._seen_S, self._seen_r = np.zeros((size, size)), np.zeros(size)
        for frame in sorted(records if frames is None else frames):
            self._frames += 1
            for arch in ARCHES:
                velocity = velocity_twist(records, frame, arch)
                if velocity is not None:
                    solution = records[frame].solution
                    block, right, _ = _reduced(solution, velocity, arch, extrinsics.pivot, self._layout)
                    self._S += block / variance_px3[arch]
                    self._r += right / variance_px3[arch]
                    self._weight += solution.outline.weight[arch].sum() / variance_px3[arch]
                    self._gum[arch] += solution.outline.habit_weight[arch, :, 1, 1:]

    def observe(self, slope: Array, deviation: Array, precision: Array) -> None:
        """Add an observation not from masks: deviation (n,) + slope (n, U) @ unknowns = 0 with precision (n, n)."""
        self._seen_S += slope.T @ precision @ slope
        self._seen_r -= slope.T @ precision @ deviation

    def normal_equations(self) -> tuple[Array, Array]:
        """Return the matrix (U, U) and right-hand side (U,) of the normal equations without priors."""
        return self._S, self._r

    def prior_covariance(self) -> Array:
        """Return the prior covariance of delays and annotator biases, zero for camera twists, shape (U, U)."""
        return np.diag(np.r_[self._layout.prior_sigma() ** 2, np.zeros(6 * self._layout.cameras)])

    def solve(self, config: TrackingConfig, cameras_move: bool) -> Nuisances:
        """Solve for the nuisance parameters; camera poses are estimated only if `cameras_move`."""
        layout = self._layout
        C, size, first_twist = layout.cameras, layout.size, layout.twists
        redundancy = layout.redundancy(self._frames)
        S = self._S + redundancy.max() * self._seen_S
        S[:first_twist, :first_twist] += np.diag(redundancy[:first_twist] / layout.prior_sigma() ** 2)
        for c, precision in enumerate(self.extrinsics.precision(config.refine_turn_rad, config.refine_move_mm)):
            S[layout.twist(c), layout.twist(c)] += precision
        # A delay common to all cameras cannot be distinguished from the motion of the teeth.
        keep = np.arange(1, size if cameras_move else first_twist)
        covariance = np.zeros((size, size))
        covariance[np.ix_(keep, keep)] = np.linalg.inv(S[np.ix_(keep, keep)])
        x = covariance @ (self._r + redundancy.max() * self._seen_r)
        # A motion common to all cameras would be a motion of the world, which is unobservable.
        centred = np.eye(size)
        centred[first_twist:, first_twist:] -= np.kron(np.full((C, C), 1 / C), np.eye(6))
        x = centred @ x
        covariance = centred @ (covariance * np.sqrt(np.outer(redundancy, redundancy))) @ centred
        twists, sigma_twists = x[first_twist:], np.sqrt(np.diag(covariance)[first_twist:])
        square = float(twists @ self._S[first_twist:, first_twist:] @ twists) / max(self._weight, 1e-300)
        habits = np.stack([[layout.habits(arch, c) for c in range(C)] for arch in ARCHES])
        slope = self._gum[..., 1] / np.maximum(self._gum[..., 0], 1e-300)
        shift = np.stack([habits[:, :, 0], habits[:, :, 1] + slope[..., None] * habits[:, :, 2]], axis=2)
        return Nuisances(
            delays=x[:C],
            habits=habits @ x,
            shift_px=shift @ x,
            sigma_delays=np.sqrt(np.diag(covariance)[:C]),
            sigma_habits=np.sqrt(np.einsum("...u,uv,...v->...", habits, covariance, habits)),
            twists=twists.reshape(C, 6),
            sigma_twists=sigma_twists.reshape(C, 6),
            contour_px=float(np.sqrt(max(square, 0.0))),
            covariance=covariance,
        )


def pose_response(records: Mapping[int, FrameRecord], frame: int, arch: int, extrinsics: Extrinsics) -> Array:
    """Return the twist of a pose about its centre per unit of each nuisance parameter, shape (6, U)."""
    velocity = velocity_twist(records, frame, arch)
    solution, layout = records[frame].solution, _Layout(len(extrinsics.twists))
    velocity = np.zeros(6) if velocity is None else velocity
    return _reduced(solution, velocity, arch, extrinsics.pivot, layout)[2]


def corrected_pose(records: Mapping[int, FrameRecord], frame: int, arch: int, nuisances: Nuisances) -> Array:
    """Return the pose of an arch (4, 4), corrected to first order for delays and mask biases, not for camera twists."""
    velocity = velocity_twist(records, frame, arch)
    solution = records[frame].solution
    outline, habits = solution.outline, nuisances.habits[arch]
    moved = np.einsum("chi,ch->i", outline.habit_slope[arch], habits)
    if velocity is not None:
        moved = moved + np.einsum("cij,j,c->i", outline.precision[arch], velocity, nuisances.delays)
    twist = -np.linalg.lstsq(outline.precision[arch].sum(0), moved, rcond=1e-10)[0]
    return np.asarray(motion_about(solution.centres[arch], twist) @ solution.poses[arch], np.float64)


def interpolation_covariance(records: Mapping[int, FrameRecord], frame: int, arch: int, delays: Array) -> Array:
    """Return the covariance of a pose's twist about its centre caused by interpolation errors, shape (6, 6)."""
    precision = records[frame].solution.outline.precision[arch]
    errors = interpolation_errors(records, frame, arch, delays)
    pull = np.einsum("cij,cj->ic", precision, errors)
    moved = np.linalg.lstsq(precision.sum(0), pull, rcond=1e-10)[0]
    return np.asarray(moved @ moved.T, np.float64)


def _reduced(
    solution: Solution, velocity: Array, arch: int, pivot: Array, layout: _Layout
) -> tuple[Array, Array, Array]:
    """Return the equations of a frame without the pose, and the pose's twist per unit of the unknowns (6, U)."""
    outline, size = solution.outline, layout.size
    to_centre = se3_adjoint(translation(pivot - solution.centres[arch]))
    S, r, B = np.zeros((size, size)), np.zeros(size), np.zeros((6, size))
    for c in range(layout.cameras):
        H, g = outline.precision[arch, c], outline.gradient[arch, c]
        habits = layout.habits(arch, c)
        D = np.zeros((6, size))  # twist of the arch in this camera per unit of each unknown
        D[:, c] = velocity
        D[:, layout.twist(c)] = to_centre
        slope = outline.habit_slope[arch, c].T @ habits
        B += H @ D + slope
        S += D.T @ H @ D + D.T @ slope + slope.T @ D + habits.T @ outline.habit_weight[arch, c] @ habits
        r += D.T @ g + habits.T @ outline.habit_distance[arch, c]
    H, g = outline.precision[arch].sum(0), outline.gradient[arch].sum(0)
    eliminated = np.linalg.lstsq(H, np.column_stack([B, g]), rcond=1e-10)[0]
    return S - B.T @ eliminated[:, :-1], r - B.T @ eliminated[:, -1], -eliminated[:, :-1]
