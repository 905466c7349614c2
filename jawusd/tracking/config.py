"""The settings of the tracker, each with its unit and reason."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


class Mapper(Protocol):
    """Run a function over items in their order, as `map` does, or in threads."""

    def __call__(self, function: Callable[[_Item], _Result], items: Iterable[_Item], /) -> Iterable[_Result]:
        """Return the results."""
        ...


@dataclass(frozen=True)
class TrackingConfig:
    """Set up the tracker; px are pixels of the working picture unless said otherwise."""

    # Working resolution at the teeth [px/mm]: beyond it masks by hand carry no more detail, and time goes with area.
    working_px_per_mm: float = 7.2
    # Distance of contour samples [px]: mask noise is correlated over more than this, denser sampling gains nothing.
    sample_step_px: float = 3.0
    # Residual gates per iteration [px]. Narrow at the end: wider ones reach lip and gum edges half a millimetre away.
    wide_gates_px: tuple[float, ...] = (14.0, 10.0, 8.0, 6.0, 4.0, 4.0, 4.0, 4.0, 4.0, 4.0)
    # Gate to start from when motion is easy to predict [px]; the others are for fast motion and the fallback.
    first_gate_px: float = 6.0
    # First gate over the recent prediction error [-]: the next one may be larger.
    gate_per_miss: float = 1.5
    # Bounds of the last gates [px], which follow the spread of the residuals in between: 2 px for good masks by hand.
    final_gate_px: tuple[float, float] = (1.2, 4.0)
    # Residual at which a sample adds nothing to the score [px]: the same for all poses, so that scores compare.
    score_gate_px: float = 2.5
    # Tukey gate in standard deviations: 95 % efficiency for normal noise (Huber & Ronchetti 2009).
    gate_sigmas: float = 4.685
    # Weight of samples deep inside the mask while gates are wide [-]: pulls a model that lies too far inside outwards.
    pull: float = 0.3
    # Gate [px] up to which that pull is off: near the solution it would favour gum counted as tooth.
    pull_above_px: float = 4.0
    # Least cosine between contour and mask normals at a matched edge [-]: lips cross the contour at larger angles.
    normal_cosine: float = 0.7
    # How much nearer a crown may lie one pixel inside its own contour [mm]: a cusp's curvature, not a second tooth.
    depth_tolerance_mm: float = 1.5
    # Depth by which one arch must lie in front of the other to hide it [mm]: above the error of the poses.
    overlap_tolerance_mm: float = 0.4
    # Update below which iterations stop [mm at the crowns]: a tenth of the accuracy that can be reached.
    converged_mm: float = 0.004
    # Update from which on the gates in between are left out [mm at the crowns]: they are for steps that go farther.
    settled_mm: float = 0.0
    # Last update up to which the residuals before it serve for those after it [mm at the crowns]; 0 looks again.
    judged_mm: float = 0.0
    # Motion after which pictures and contour of a scan are made again [px]: hidden parts are judged to so much.
    redraw_px: float = 1.0
    # Motion of near against far parts of a scan in a picture from which on it is drawn anew [px]; until then, pictures
    # of it are warped. Up to 8 px leave the errors of 200 frames as they are (0.038 and 0.045 mm), but at 4 px knocked
    # cameras were corrected 7 sigma off (`tests/tracking/test_tracking_nuisance.py`), at 2 px as at 0, by 1 at most.
    parallax_px: float = 2.0
    # Plausible distance of an arch from its prediction [mm]: a weak pull, for motions that masks leave free.
    prediction_mm: float = 0.5
    # Outline variance times correlation length behind that pull [px^3]: 0.4 px over 18 px, typical masks by hand.
    typical_noise_px3: float = 3.0
    # Contour length over which outline errors move together [px], until it has been measured on the take.
    correlation_px: float = 18.0
    # The same, of outlines whose residuals do not show it; None takes what is measured.
    known_correlation_px: float | None = None
    # Side of the tiles within which errors are measured together [px]: estimates change little from 20 to 45.
    tile_px: int = 30
    # True over measured correlation length [-]: the fit takes part of the error out of the residuals, and the Tukey
    # weight costs efficiency. 2.2 to 3.0 over outline errors of 0.25 and 0.6 px, correlated over 2 to 14 px; with 2.8,
    # sigmas of the persons of `tests/benchmarks/population.py` were a fifth too wide.
    tile_factor: float = 2.2
    # Good frames remembered to judge residuals and coverage [frames]: about a second.
    history_frames: int = 31
    # Good frames remembered to judge scores [frames]: closing lips take longer, a lost pose does not.
    score_frames: int = 7
    # Score below this share of the recent median makes an arch suspect [-]: lips seldom hide as much in a few frames.
    suspect_score: float = 0.6
    # Score share below which even closing lips are no excuse [-].
    alarming_score: float = 0.3
    # Residual spread above this multiple of the recent median makes an arch suspect [-].
    suspect_residual: float = 1.4
    # Uncovered mask above the recent median by more than this makes an arch, or a mask, suspect [-].
    suspect_coverage: float = 0.04
    # Residual of one view above this multiple of the arch's recent median makes its mask suspect [-].
    uneven_residual: float = 1.6
    # Score of one view below this share of its recent median means its mask shows something else [-].
    dead_score: float = 0.03
    # Price of a mask pixel left uncovered, in px of contour [1/px]: tells wrong minima apart where few edges show.
    uncovered_price: float = 0.5
    # Gain in the objective of the remaining masks, as a share of their score, that proves the one left out wrong [-].
    conflict_gain: float = 0.15
    # Gain in the objective over the first attempt, as a share of the score, that makes a frame count as recovered [-].
    recovery_gain: float = 0.05
    # Rings of the multi-start [mm, rad]: the prediction error of a fast chewing stroke, and of teeth back in sight.
    search_rings: tuple[tuple[float, float], ...] = ((2.0, 0.05), (4.0, 0.12))
    # Gates of the brief trial of every start [px], and how many starts are followed to the end.
    trial_gates_px: tuple[float, ...] = (14.0, 8.0)
    search_finalists: int = 4
    # Matched contour below which an arch is lost [px]: 8 mm of tooth edge.
    least_matched_px: float = 60.0
    # Residual spread above this multiple of the suspect limit means lost [-]; with a low score the limit itself does.
    lost_residual: float = 1.3
    # Uncovered share of a mask above which the arch is lost [-]: good poses leave about 0.01.
    lost_coverage: float = 0.12
    # Position uncertainty of the crowns above which an arch is lost [mm].
    lost_sigma_mm: float = 0.5
    # Matched share of the visible contour the first frame must reach [-]: good ones reach 0.15 with lips nearly closed,
    # scans of crowns without gum 0.07. What is wrong in spite of that fails by uncovered masks.
    first_share: float = 0.05
    # Delay between cameras [frames] and mask bias [px] from which all frames are aligned again with them taken out:
    # below, they cost less than the noise of single frames.
    refine_delay_frames: float = 0.03
    refine_bias_px: float = 0.1
    # Delay that is corrected before cameras may count as moved [frames]: beyond what free running cameras differ by.
    late_frames: float = 0.6
    # Most rounds of that [-]: each leaves a tenth of the delay.
    refine_rounds: int = 2
    # The same while a camera is still found to run apart: its masks follow the motion only step by step.
    late_rounds: int = 4
    # Shift of contours by wrong camera poses [px] from which those are corrected: below, apparent shifts are the
    # habits of whoever drew the masks.
    refine_shift_px: float = 0.15
    # How far calibrated cameras turn and move until the take, standard deviation per axis [rad, mm]: a knock.
    refine_turn_rad: float = 0.0035
    refine_move_mm: float = 0.5
    # Frames on which these are settled before all are aligned again [-], most rounds of that, and the share of the
    # limits above below which a round changes too little for another.
    settle_frames: int = 40
    settle_rounds: int = 6
    settled_share: float = 0.2

    def gates_after(self, gates_px: tuple[float, ...], moved_mm: float) -> tuple[float, ...]:
        """Return the gates to go on with after a step of so many mm with the first of them."""
        rest = gates_px[1:]
        if rest and gates_px[0] == rest[-1]:
            return () if moved_mm < self.converged_mm else rest
        return rest[-1:] if moved_mm < self.settled_mm else rest

    def with_gates_scaled(self, factor: float) -> TrackingConfig:
        """Return the numbers for pictures with so many times the pixels per mm, as far as they say what matches."""
        return replace(
            self,
            wide_gates_px=tuple(factor * gate for gate in self.wide_gates_px),
            trial_gates_px=tuple(factor * gate for gate in self.trial_gates_px),
            final_gate_px=(factor * self.final_gate_px[0], factor * self.final_gate_px[1]),
            score_gate_px=factor * self.score_gate_px,
            pull_above_px=factor * self.pull_above_px,
        )

    def gates_from(self, reach_px: float) -> tuple[float, ...]:
        """Return the gates to go through when the start is off by about reach_px, and no less than the usual."""
        return tuple(g for g in self.wide_gates_px if g <= max(reach_px, self.first_gate_px))


#: For takes of several cameras. Pictures are made half as often, with the same errors; a search in a single camera,
#: which has less contour to go by, ended elsewhere (`tests/pipeline/test_solve.py`).
FOR_TAKES = TrackingConfig(redraw_px=2.0)

#: For masks that jawusd made. They vary more from frame to frame than drawn ones: outlines get rougher as lips close,
#: and what looks lost by the rules for drawn masks is not. A pose given up needlessly is a frame without a jaw. Their
#: errors last along whole teeth and many frames: with the factor of drawn masks, NEES of the relative pose was 6 on a
#: rasterised and 13 on a path-traced take, with this one 0.9 and 1.8.
FOR_AUTO_MASKS = replace(FOR_TAKES, suspect_residual=3.0, suspect_score=0.25, tile_factor=20.0)
