"""The numbers of the tracker, each with its unit and reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TrackingConfig:
    """Set up the tracker; px are pixels of the working picture unless said otherwise."""

    # Working resolution at the teeth [px/mm]: beyond it masks by hand carry no more detail, and time goes with area.
    working_px_per_mm: float = 7.2
    # Distance of contour samples [px]: mask noise is correlated over more than this, denser sampling gains nothing.
    sample_step_px: float = 3.0
    # Residual gates per iteration [px]. Narrow: wider ones reach lip and gum edges about half a millimetre away.
    gates_px: tuple[float, ...] = (6.0, 4.0, 3.0, 2.5, 2.5, 2.5, 2.5)
    # Gates of the fallback [px], for predictions that are off by a millimetre or more.
    wide_gates_px: tuple[float, ...] = (14.0, 10.0, 8.0, 6.0, 4.0, 3.0, 2.5, 2.5, 2.5, 2.5)
    # Bounds of the last gates [px], which follow the spread of the residuals in between.
    final_gate_px: tuple[float, float] = (1.2, 2.5)
    # Tukey gate in standard deviations: 95 % efficiency for normal noise (Huber & Ronchetti 2009).
    gate_sigmas: float = 4.685
    # Weight of samples deep inside the mask while gates are wide [-]: pulls a model that lies too far inside outwards.
    pull: float = 0.3
    # Gate [px] up to which that pull is off: near the solution it would favour gum counted as tooth.
    pull_above_px: float = 4.0
    # Least cosine between contour and mask normals at a matched edge [-]: lips cross the contour at larger angles.
    normal_cosine: float = 0.7
    # How much nearer a crown surface may lie one pixel inside its own contour [mm]: curvature of a cusp, not a second tooth.
    depth_tolerance_mm: float = 1.2
    # Depth by which one row must lie in front of the other to hide it [mm]: above the error of the poses.
    overlap_tolerance_mm: float = 0.4
    # Update below which iterations stop [mm at the crowns]: a tenth of the accuracy that can be reached.
    converged_mm: float = 0.004
    # Motion after which a scan is drawn again for hidden parts [px]: hidden parts are judged to one pixel.
    redraw_px: float = 0.7
    # Weight of the damping term relative to the diagonal [-]: keeps the first steps of an ill-posed view finite.
    damping: float = 1e-4
