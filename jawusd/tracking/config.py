"""Settings of the tracker, with units and reasons; docs/explanation/constants.md explains how they were chosen."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Mapper(Protocol):
    """Map a function over items in order, like the built-in `map`, possibly in threads."""

    def __call__(self, function: Callable[[Item], Result], items: Iterable[Item], /) -> Iterable[Result]:
        """Return the results in the order of the items."""
        ...


class SmoothErrors(NamedTuple):
    """Model of outline errors: a smooth field, interpolated between nodes on a grid, plus white noise."""

    spacing_px: float = 15.0  # spacing of the nodes
    prior_px: float = 2.0  # ratio of the density of the white noise [px^3] to the variance of a node [px^2]
    # Variance times correlation length of all errors, over that of the white noise [-]: weight of what remains.
    noise_ratio: float = 2.5


@dataclass(frozen=True)
class TrackingConfig:
    """Settings of the tracker; px are pixels of the undistorted image at working resolution unless stated otherwise."""

    # Working resolution at the teeth [px/mm]: hand-drawn masks have no finer detail, and run time grows with the area.
    working_px_per_mm: float = 7.2
    # Spacing of contour samples [px]: less than the distance over which mask noise is correlated.
    sample_step_px: float = 3.0
    # Residual gate of each iteration [px]: wider gates at the end would also match lip and gum edges 0.5 mm away.
    wide_gates_px: tuple[float, ...] = (14.0, 10.0, 8.0, 6.0, 4.0, 4.0, 4.0, 4.0, 4.0, 4.0)
    # First residual gate if motion is predictable [px]; wider gates are used for fast motion and as a fallback.
    first_gate_px: float = 6.0
    # Ratio of the first residual gate to the recent prediction error [-]: above 1, since the next error may be larger.
    gate_per_miss: float = 1.5
    # Limits of the final residual gate [px], which adapts to the residuals: 2 px for good hand-drawn masks.
    final_gate_px: tuple[float, float] = (1.2, 4.0)
    score_gate_px: float = 2.5  # residual above which a sample adds nothing to the score [px], whatever the gate
    # Tukey gate in standard deviations: 95 % efficiency for normal noise (Huber & Ronchetti 2009).
    gate_sigmas: float = 4.685
    # Weight of samples deep inside the mask while gates are wide [-]: it pushes out contours that start inside.
    pull: float = 0.3
    pull_above_px: float = 4.0  # residual gate up to which this weight is zero [px]: it favours gum over teeth
    # Minimum cosine between contour and mask normals at a matched edge [-]: lips cross the contour at larger angles.
    normal_cosine: float = 0.7
    # Maximum decrease in depth from a contour point to the pixel just inside it [mm]: more than for a cusp.
    depth_tolerance_mm: float = 1.5
    # Minimum depth difference for one arch to hide the other [mm]: larger than the error of the poses.
    overlap_tolerance_mm: float = 0.4
    # Pose update below which iterations stop [mm at the crowns]: a tenth of the attainable accuracy.
    converged_mm: float = 0.004
    # Pose update below which the intermediate residual gates are skipped [mm at the crowns]; 0 never skips them.
    settled_mm: float = 0.0
    # Last pose update up to which residuals are not recomputed at the final pose [mm at the crowns]; 0: always.
    judged_mm: float = 0.0
    # Image motion after which a scan is rendered again [px]: the maximum error of occlusion boundaries.
    redraw_px: float = 1.0
    # Parallax within a scan above which it is rendered again, not warped [px]; see docs/explanation/constants.md.
    parallax_px: float = 2.0
    # Change of scale up to which it is warped [-], in either direction.
    largest_zoom: float = 1.02
    prediction_mm: float = 0.5  # standard deviation of an arch about its predicted position [mm]: a weak prior
    # Outline variance times correlation length of drawn masks [px^3]: (0.4 px)^2 times 18 px.
    typical_noise_px3: float = 3.0
    # Assumed correlation length of outline errors along the contour [px], until it is measured on the take.
    correlation_px: float = 18.0
    known_correlation_px: float | None = None  # known correlation length of outline errors [px]; None: measured
    # Smooth outline errors; None: errors of neighbouring samples are independent.
    smooth_errors: SmoothErrors | None = SmoothErrors()
    # Side of the tiles over which errors are summed to measure it [px]: estimates change little from 20 to 45.
    tile_px: int = 30
    tile_factor: float = 1.5  # ratio of true to measured correlation length [-]: the fit absorbs part of the error
    history_frames: int = 31  # number of recent good frames that define the usual residual and coverage: about a second
    # Number of recent good frames that define the usual score: fewer than those in which lips close.
    score_frames: int = 7
    # Fraction of the recent score below which a pose is suspect [-]: lips seldom hide so much in a few frames.
    suspect_score: float = 0.6
    # Fraction of the recent median score below which closing lips do not sufficiently explain the drop in score [-].
    alarming_score: float = 0.3
    # Multiple of the recent median residual above which the pose of an arch is suspect [-].
    suspect_residual: float = 1.4
    # Excess of a mask's uncovered fraction over its recent median above which the mask or its arch is suspect [-].
    suspect_coverage: float = 0.04
    # Multiple of the arch's recent median residual above which the mask of one view is suspect [-].
    uneven_residual: float = 1.6
    dead_score: float = 0.03  # fraction of a mask's recent median score below which the mask does not show the arch [-]
    # Matched contour [px] that outweighs one uncovered mask pixel: rejects wrong minima if few edges are visible.
    uncovered_price: float = 0.5
    # Minimum gain in the objective of the other masks, relative to their score, for excluding a mask as wrong [-].
    conflict_gain: float = 0.15
    # Minimum gain in the objective over the first attempt, relative to the score, for marking a frame as recovered [-].
    recovery_gain: float = 0.05
    # Offsets of the starts of the multi-start search [mm, rad]: errors in fast chewing, and after a loss.
    search_rings: tuple[tuple[float, float], ...] = ((2.0, 0.05), (4.0, 0.12))
    # Residual gates of the short trial alignment from every start [px], and number of starts that are refined fully.
    trial_gates_px: tuple[float, ...] = (14.0, 8.0)
    search_finalists: int = 4
    least_matched_px: float = 60.0  # matched contour length below which an arch is lost [px]: 8 mm of tooth edge
    # Multiple of the limit for suspect residuals above which an arch is lost [-]; 1 if the score is low as well.
    lost_residual: float = 1.3
    # Uncovered fraction of a mask above which its arch is lost [-]: good poses leave about 0.01.
    lost_coverage: float = 0.12
    lost_sigma_mm: float = 0.5  # position uncertainty of the crowns above which an arch is lost [mm]
    # Minimum matched fraction of the visible contour in the first frame [-]: correct poses reach 0.15 with nearly
    # closed lips, and 0.07 with scans without gum. Wrong poses can exceed this fraction, but are rejected because they
    # leave masks uncovered.
    first_share: float = 0.05
    # Delay between cameras [frames] and mask bias [px] above which they are corrected and all frames are aligned again;
    # smaller values matter less than the noise of a single frame.
    refine_delay_frames: float = 0.03
    refine_bias_px: float = 0.1
    # Delay corrected before camera poses are tested [frames]: larger than between free-running cameras.
    late_frames: float = 0.6
    # Maximum number of rounds in which all frames are aligned again: each round reduces the remaining delay to a tenth.
    refine_rounds: int = 2
    # Maximum number of such rounds while a camera still has a delay, since matches then converge slowly.
    late_rounds: int = 4
    # Contour shift above which camera poses are corrected [px]: smaller ones are due to annotator bias.
    refine_shift_px: float = 0.15
    # Prior standard deviation of a camera's motion between calibration and take, per axis [rad, mm]: about what an
    # accidental knock causes.
    refine_turn_rad: float = 0.0035
    refine_move_mm: float = 0.5
    # Number of frames on which delays, mask bias and camera poses are iterated before all frames are aligned again;
    # maximum number of iterations; and fraction of the `refine` limits below which the iteration stops.
    settle_frames: int = 40
    settle_rounds: int = 6
    settled_share: float = 0.2

    def gates_after(self, gates_px: tuple[float, ...], moved_mm: float) -> tuple[float, ...]:
        """Return the residual gates that remain after a first step, which moved the arches by `moved_mm`."""
        rest = gates_px[1:]
        if rest and gates_px[0] == rest[-1]:
            return () if moved_mm < self.converged_mm else rest
        return rest[-1:] if moved_mm < self.settled_mm else rest

    def with_gates_scaled(self, factor: float) -> TrackingConfig:
        """Return settings with all residual gates multiplied by a factor, for images with more pixels per mm."""
        return replace(
            self,
            wide_gates_px=tuple(factor * gate for gate in self.wide_gates_px),
            trial_gates_px=tuple(factor * gate for gate in self.trial_gates_px),
            final_gate_px=(factor * self.final_gate_px[0], factor * self.final_gate_px[1]),
            score_gate_px=factor * self.score_gate_px,
            pull_above_px=factor * self.pull_above_px,
        )

    def gates_from(self, reach_px: float) -> tuple[float, ...]:
        """Return residual gates for a start that is off by about `reach_px`; the first is at least `first_gate_px`."""
        return tuple(g for g in self.wide_gates_px if g <= max(reach_px, self.first_gate_px))


#: Settings for takes of several cameras: scans are rendered half as often as by default. Searches with a single camera
#: need the default.
FOR_TAKES = TrackingConfig(redraw_px=2.0)

#: Settings for masks made by jawusd. These masks vary more between frames than hand-drawn ones, and get rougher as lips
#: close, so the limits for lost arches are wider. Their errors are correlated along whole teeth, hence the larger
#: `tile_factor`.
FOR_AUTO_MASKS = replace(FOR_TAKES, suspect_residual=3.0, suspect_score=0.25, tile_factor=20.0)
