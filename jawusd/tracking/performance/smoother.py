"""The second pass: joint refinement of all frames under a smoothness prior; outlines are rematched in every round."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator.skin import SkinJaw
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.annotator import AnnotatorPrior, drawn_prior
from jawusd.tracking.contour.quality import outline_errors
from jawusd.tracking.contour.solver import Matched
from jawusd.tracking.performance.attempts import LARGEST_SIGMA, Attempts, FrameFit, usual_of
from jawusd.tracking.performance.coordinates import HEAD, JAW, LOCAL, Coordinates, Pose
from jawusd.tracking.performance.instant import InstantSolver, rig_gain
from jawusd.tracking.performance.motion import Motion, head_bends, measured_motion
from jawusd.tracking.performance.skin import SLOW, SkinFactor
from jawusd.tracking.performance.system import TakeSystem
from jawusd.tracking.performance.unknowns import TakeState, Unknowns
from jawusd.tracking.performance.views import Views, growth_of

_ROUNDS = 2  # number of rounds in which outlines are matched again; a third round would change less than 0.01 mm
_FOCAL_ROUNDS = 6  # the same if focal lengths are unknown, since they are coupled with the distance of the head
# Maximum number of solutions of the linearised equations, each with the bound linearised at the previous one; change of
# d below which no further one is computed [mm].
_BOUND_ROUNDS, _SAME_MM = 5, 0.05
#: Ratios of true to computed variance of a frame's unknowns [-], without and with a model of smooth outline errors: the
#: equations ignore that errors persist over frames, and the model removes a part of these.
VARIANCE_RATIO, _VARIANCE_RATIO_SMOOTH = 1.5**2, 1.25**2
# Standard deviations of the prior for aligning frames again in which an arch was missed [rad, mm, mm].
_NEARBY = np.r_[[0.05] * 3, [3.0] * 3, [3.0] * 3]


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A take after the second pass: fits, their covariances (F, 9, 9), and the unknowns shared by all frames."""

    fits: list[FrameFit]
    covariance: Array
    state: TakeState
    sigma_log_focal: Array  # standard deviations of the log focal lengths, shape (C,)
    by_skin: Mask  # frames in which skin contributed to d, shape (F,)
    rig_gain: Array  # derivatives of d with respect to an error of the rig, shape (F, 3, 6); see `rig_gain`


class Smoother:
    """Joint refinement of the fits of consecutive frames."""

    def __init__(
        self,
        instants: InstantSolver,
        views: Views | None,
        frames: Sequence[int],
        fps: float,
        cameras: int,
        *,
        fixed_head: bool = False,
        free_focal: bool = False,
        shared_px3: float = 0.0,
        annotator: AnnotatorPrior | None = None,
        skin: SkinJaw | None = None,
    ) -> None:
        """Configure the refinement.

        Args:
            views: source of the views; None to use the outlines of the fits as matched. In that case, with a fixed
                head, all fits must have the same head pose.
            frames: frame numbers in temporal order.
            shared_px3: variance times correlation length [px^3] of outline errors that the residuals do not show.
            annotator: prior on annotator bias; default: of hand-drawn masks.
            skin: jaw parameters estimated from facial skin in every frame.
        """
        self._variance_ratio = VARIANCE_RATIO if instants.config.smooth_errors is None else _VARIANCE_RATIO_SMOOTH
        self._skin = None if skin is None else SkinFactor(skin, fps, self._variance_ratio)
        self._cameras, self._rounds, self._shared_px3 = cameras, _FOCAL_ROUNDS if free_focal else _ROUNDS, shared_px3
        if views is None:
            self._rounds = 0
        self._instants, self._views, self._frames, self._fps = instants, views, frames, fps
        self._coordinates: Coordinates = instants.coordinates
        self._unknowns = Unknowns(
            instants.coordinates,
            len(frames),
            cameras,
            fixed_head=fixed_head,
            free_focal=free_focal,
            annotator=annotator or drawn_prior(instants.solver.scans),
        )

    def run(self, fits: Sequence[FrameFit], done: Callable[[int, int], None] = lambda done, total: None) -> Smoothed:
        """Return the most likely take, from the fits of the first pass.

        `done` is called with the number of frames matched and the total number of frames.
        """
        config, fits = self._instants.config, list(fits)
        state, slow = self._unknowns.start(), np.zeros((len(fits), SLOW))
        weight = 1.0 / (outline_variance(fits, config) + self._shared_px3)
        good = np.array([fit.found.all() for fit in fits])
        motion = measured_motion(self._coordinates, [fit.pose for fit in fits], good, self._fps)
        total = self._rounds * len(fits)
        if self._skin is not None:
            fits = self._skin.started(fits)
        if self._unknowns.fixed_head and self._views is not None:
            fits = with_one_head(self._coordinates, fits)
            fits = [self._matched(fit, frame, state) for fit, frame in zip(fits, self._frames, strict=True)]
        if self._unknowns.free_focal and self._views is not None:
            fits = [self._matched(fit, frame, state) for fit, frame in zip(fits, self._frames, strict=True)]
        for round_ in range(self._rounds + 1):
            local, shared = self._step(fits, state, weight, motion, slow)
            own, more = np.split(local, [self._unknowns.local], axis=1)
            poses, state = self._unknowns.moved([fit.pose for fit in fits], state, own, shared)
            slow = slow + more if self._skin is not None else slow
            fits = [self._moved(fit, pose, weight) for fit, pose in zip(fits, poses, strict=True)]
            if round_ == self._rounds:
                break
            for k, fit in enumerate(fits):
                fits[k] = self._matched(fit, self._frames[k], state)
                done(round_ * len(fits) + k + 1, total)
            weight = 1.0 / (outline_variance(fits, config) + self._shared_px3)
            if round_ == 0:
                fits = self._aligned_again(fits, weight)
        sigma = np.zeros(self._cameras)
        # The bound of the rig is omitted: it is an inequality, and would make the covariance too small.
        covariance, shared = self._covariance(self._system(fits, state, weight, motion, slow, None))
        if self._unknowns.free_focal:
            sigma = np.sqrt(self._variance_ratio * np.diag(shared)[self._unknowns.focal])
        gains = np.stack([self._rig_gain(fit, weight) for fit in fits])
        by_skin = np.zeros(len(fits), bool) if self._skin is None else self._skin.used
        return Smoothed(fits, covariance, state, sigma, by_skin, gains)

    def _moved(self, fit: FrameFit, pose: Pose, weight: Array) -> FrameFit:
        """Return the fit of a frame at another pose, with the misfit that belongs to it."""
        if fit.solution is not None and fit.found[1]:
            misfit = self._instants.outline_equations(fit.pose, fit.solution, weight).misfit
            pose = replace(pose, misfit=misfit.after(self._coordinates.step(fit.pose, pose)))
        return replace(fit, pose=pose)

    def _rig_gain(self, fit: FrameFit, weight: Array) -> Array:
        """Return the derivative (3, 6) of d with respect to an error of the rig; 0 if outlines do not determine d."""
        if fit.solution is None or not fit.found[1]:
            return np.zeros((3, 6))
        outlines = self._instants.outline_equations(fit.pose, fit.solution, weight * fit.found)
        matrix, lower = np.diag(LARGEST_SIGMA**-2.0) + outlines.matrix, outlines.misfit.precision
        return rig_gain(self._coordinates, fit.pose, matrix, lower, fixed_head=self._unknowns.fixed_head)

    def _step(
        self, fits: Sequence[FrameFit], state: TakeState, weight: Array, motion: Motion, slow: Array
    ) -> tuple[Array, Array]:
        """Return the step of all unknowns, shapes (F, L) and (G,), that is most likely for the outlines as matched.

        The bound only acts on poses outside it, so it is linearised at the poses after the step.
        """
        d = np.stack([fit.pose.d for fit in fits])
        bound_at = d
        for _ in range(_BOUND_ROUNDS):
            local, shared = self._system(fits, state, weight, motion, slow, bound_at).solve()
            before, bound_at = bound_at, d + local[:, self._unknowns.jaw]
            if np.abs(bound_at - before).max() < _SAME_MM:
                break
        return local, shared

    def _system(
        self,
        fits: Sequence[FrameFit],
        state: TakeState,
        weight: Array,
        motion: Motion,
        slow: Array,
        bound_at: Array | None,
    ) -> TakeSystem:
        """Linearise the equations of the take; `bound_at` (F, 3) is where the bound is linearised, None to omit it."""
        unknowns = self._unknowns
        more = 0 if self._skin is None else SLOW
        system = TakeSystem(len(fits), unknowns.local + more, unknowns.shared)
        weak = np.zeros(unknowns.local + unknowns.shared)
        weak[unknowns.jaw] = LARGEST_SIGMA[JAW] ** -2.0
        if unknowns.head is not None:
            weak[unknowns.head] = LARGEST_SIGMA[HEAD] ** -2.0
        for k, fit in enumerate(fits):
            precision, right = unknowns.frame(fit, weight, None if bound_at is None else bound_at[k])
            # The weak prior regularises unknowns without measurements.
            precision, right = _with_more(precision + np.diag(1e-3 * weak), right, unknowns.local, more)
            system.add_frame(k, precision, right)
        system.add_shared(*unknowns.prior(state))
        # In gaps, first differences are penalised as well, so that the jaw does not drift at constant velocity.
        unseen = np.array([not fit.found.all() for fit in fits])
        unknown = unseen if self._skin is None else unseen & ~self._skin.familiar
        gap, jaw_gap = ((one[1:] | one[:-1])[:, None] for one in (unseen, unknown))
        poses = [fit.pose for fit in fits]
        d = np.stack([pose.d for pose in poses])
        system.add_bends(unknowns.jaw, np.diff(d, 2, axis=0), 1.0 / motion.bend[JAW])
        system.add_steps(unknowns.jaw, np.diff(d, axis=0), jaw_gap / motion.step[JAW])
        if self._skin is not None:
            self._skin.add(system, d, slow, unknowns.jaw.start)
        if unknowns.head is not None:
            bend, step = head_bends(self._coordinates, poses)
            system.add_bends(unknowns.head, bend, 1.0 / motion.bend[HEAD])
            system.add_steps(unknowns.head, step, gap / motion.step[HEAD])
        return system

    def _matched(self, fit: FrameFit, frame: int, state: TakeState) -> FrameFit:
        """Match the outlines of a frame again at its current pose."""
        if not fit.use.any() or self._views is None:
            return fit
        views = state.corrected(self._views.at(frame))
        rendering = self._instants.solver.rendering(views)
        gate = self._instants.config.final_gate_px[1]
        matched: list[Matched] | None = [] if self._unknowns.free_focal else None
        solution = self._instants.linearise(fit.pose, views, fit.use, rendering, gate, True, matched)
        growth = None if matched is None else growth_of(matched, solution.poses, solution.centres, views)
        return replace(fit, solution=solution, growth=growth)

    def _aligned_again(self, fits: list[FrameFit], weight: Array) -> list[FrameFit]:
        """Repeat the alignment, from smoothed poses, where an arch was not found or one of its masks does not fit."""
        if self._views is None:
            return fits
        attempts = Attempts(self._instants, weight, usual_of(fits))

        def uses_wrong_mask(fit: FrameFit) -> bool:
            several = fit.use.sum(1, keepdims=True) > 1  # a single mask cannot be left out
            return fit.solution is not None and bool((attempts.wrong_masks(fit.solution, fit.use) & several).any())

        for k, fit in enumerate(fits):
            wrong = uses_wrong_mask(fit)
            if fit.missed.any() or wrong:
                again = attempts.near(fit.pose, attempts.instant(self._views.at(self._frames[k])), _NEARBY)
                corrected = wrong and not uses_wrong_mask(again) and bool((again.found >= fit.found).all())
                if corrected or again.found.sum() > fit.found.sum():
                    fits[k] = again
        return fits

    def _covariance(self, system: TakeSystem) -> tuple[Array, Array]:
        """Return the covariances of each frame's unknowns, shape (F, 9, 9), and of the take's unknowns."""
        found, unknowns = system.covariance(), self._unknowns
        size = unknowns.local
        found = found._replace(own=found.own[:, :size, :size], response=found.response[:, :size])
        wide = np.sqrt(unknowns.redundancy)
        shared = found.shared * np.outer(wide, wide)
        if not unknowns.fixed_head:
            own = self._variance_ratio * found.own + found.response @ shared @ np.swapaxes(found.response, 1, 2)
            return np.asarray(own, np.float64), found.shared
        # The head pose, which is constant over the take, is one of the take's unknowns.
        response = np.zeros((system.frames, LOCAL, unknowns.shared))
        response[:, HEAD, :6] = np.eye(6)
        response[:, JAW] = found.response
        out = response @ (self._variance_ratio * shared) @ np.swapaxes(response, 1, 2)
        out[:, JAW, JAW] += self._variance_ratio * found.own
        return np.asarray(out, np.float64), found.shared


def _with_more(precision: Array, right: Array, local: int, more: int) -> tuple[Array, Array]:
    """Return equations of a frame and the take with `more` unknowns inserted after those of the frame."""
    if not more:
        return precision, right
    at = np.full(more, local)
    return np.insert(np.insert(precision, at, 0.0, axis=0), at, 0.0, axis=1), np.insert(right, at, 0.0)


def with_one_head(coordinates: Coordinates, fits: Sequence[FrameFit]) -> list[FrameFit]:
    """Return the fits with a common head pose: the median over the frames in which both arches were found."""
    seen = [fit for fit in fits if fit.found.all()] or fits
    first = seen[0].pose.head
    away = np.median([coordinates.head_steps(first, fit.pose.head) for fit in seen], axis=0)
    head = coordinates.turned(first, away)
    return [replace(fit, pose=replace(fit.pose, head=head)) for fit in fits]


def outline_variance(fits: Sequence[FrameFit], config: TrackingConfig) -> Array:
    """Return variance times correlation length of the outline errors of a take, per arch [px^3], shape (2,)."""
    return outline_errors(((fit.solution, fit.found) for fit in fits if fit.solution is not None), config)[0]
