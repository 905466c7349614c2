"""Checks of both teeth scans together: whether they form a possible bite, and what is unusual about it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.finding import Finding
from jawusd.geometry import anatomical_frame
from jawusd.tracking.contour.scan import ARCH_NAMES, Scan
from jawusd.tracking.initialization.occlusion import Occlusion, measure_occlusion

# The limits lie outside the range of all valid bites measured (docs/explanation/constants.md). Limits beyond which a
# bite is impossible: distance between the arches, fraction of the bite in which the arches interpenetrate, fraction of
# coinciding surface, minimum fraction of opposed crown surface, rotation about the normal of the occlusal plane,
# maximum and minimum width of an arch.
_APART_MM = 4.0
_THROUGH_SHARE = 0.5
_SAME_SHARE = 0.5
_BESIDE_SHARE = 0.35
_FACING_BACK_RAD = np.pi / 2
_WIDEST_MM, _NARROWEST_MM = 100.0, 20.0
# Limits of usual bites: gap, overlap, difference between the gaps of both sides, distance of the midlines, maximum and
# minimum width, range of width ratios, distance of the lower front teeth in front of the upper ones, tilt of the given
# axes.
_LOOSE_MM = 0.8
_TIGHT_MM = 1.3
_ONE_SIDED_MM = 1.0
_MIDLINES_MM = 4.0
_WIDE_MM, _NARROW_MM = 80.0, 32.0
_RATIOS = (0.88, 1.36)
_LOWER_AHEAD_MM = 0.5
_AXES_OFF_DEG = 30.0

_EXPORT = "Export both scans in one coordinate frame, with the teeth in occlusion (closed bite)."
_UNITS = "Check units and scale of both scan files: lengths must be in mm."
_LOOK = "View both scans together, and correct them if this is not the subject's bite."


def check_occlusion(scans: Sequence[Scan], T_anatomical_scan: ArrayLike | None) -> tuple[Array, list[Finding]]:
    """Check that both scans share a coordinate frame and are in occlusion; return T_anatomical_scan and warnings.

    `T_anatomical_scan` (4, 4) maps the scan frame to (left, up, front) axes; None derives it from the scans.

    Raises:
        TrackingError: the scans cannot form a bite: they are apart, beside or inside one another, upside down,
            identical, or not of the size of teeth.
    """
    T, findings = occlusion_findings(scans, T_anatomical_scan)
    for finding in findings:
        if finding.severity == "error":
            raise TrackingError(finding.message, hint=finding.hint)
    return T, findings


def occlusion_findings(scans: Sequence[Scan], T_anatomical_scan: ArrayLike | None) -> tuple[Array, list[Finding]]:
    """Return T_anatomical_scan (4, 4), given or derived, and findings about two scans in a common scan frame.

    Only impossible bites are errors; with an error, warnings are omitted, since they would be its consequences.
    """
    derived = anatomical_frame(*(scan.crown_vertices(6000) for scan in scans))
    found = measure_occlusion(scans, derived)
    errors = list(_impossible(found))
    findings = errors[:1] or list(_unusual(found))
    if T_anatomical_scan is None:
        return derived, findings
    T = np.array(T_anatomical_scan, np.float64)
    tilt_deg = float(np.degrees(np.arccos(np.clip(T[1, :3] @ derived[1, :3], -1.0, 1.0))))
    if tilt_deg > _AXES_OFF_DEG and not errors:
        message = f"the up axis of [anatomy] T_anatomical_skull is {tilt_deg:.0f} degrees off the normal of the "
        message += f"occlusal plane; up to {_AXES_OFF_DEG:g} degrees is usual"
        hint = "Correct or remove T_anatomical_skull: without it the axes are derived from the scans."
        findings.append(Finding("anatomical_axes_off", "warning", message, tilt_deg, _AXES_OFF_DEG, hint=hint))
    return T, findings


def _impossible(found: Occlusion) -> Iterator[Finding]:
    """Yield errors about scans that cannot form a bite, causes before consequences."""

    def error(kind: str, message: str, value: float, limit: float, hint: str = _EXPORT) -> Finding:
        return Finding(kind, "error", message, value, limit, hint=hint)

    for name, width in zip(ARCH_NAMES, found.widths_mm):
        if not _NARROWEST_MM <= width <= _WIDEST_MM:
            message = f"the {name} arch is {width:.0f} mm wide; arches are {_NARROWEST_MM:g} to {_WIDEST_MM:g} mm wide"
            yield error("scans_size", message, width, _WIDEST_MM, _UNITS)
    off = "the upper and lower teeth scans are not in occlusion: "
    if found.same > _SAME_SHARE:
        message = f"the upper and lower teeth scans are the same arch: {found.same:.0%} of their surfaces coincide"
        yield error("scans_same", message, found.same, _SAME_SHARE, "Specify the other arch's file in [scans].")
    if found.opposite < _BESIDE_SHARE and found.turn_rad < _FACING_BACK_RAD:
        message = f"{off}the arches are {found.aside_mm:.0f} mm apart sideways; only {found.opposite:.0%} of the "
        message += f"smaller one overlaps the other in the occlusal plane; at least {_BESIDE_SHARE:.0%} is needed"
        yield error("scans_beside", message, found.opposite, _BESIDE_SHARE)
    if found.gap_mm > _APART_MM:
        message = f"{off}they are {found.gap_mm:.1f} mm apart at the closest point; at most {_APART_MM:g} mm is "
        yield error("scans_apart", message + "allowed", found.gap_mm, _APART_MM)
    if found.turn_rad > _FACING_BACK_RAD:
        turn_deg = float(np.degrees(found.turn_rad))
        message = f"{off}one arch is rotated by {turn_deg:.0f} degrees relative to the other, front to back"
        yield error("scans_turned", message, turn_deg, float(np.degrees(_FACING_BACK_RAD)))
    over = [k for k in (0, 1) if found.turned_over[k]]
    if len(over) == 1:
        message = f"{off}the {ARCH_NAMES[over[0]]} arch is upside down: its gum lies between the teeth of both arches"
        yield error("scan_upside_down", message, 1.0, 0.0)
    elif over:
        message = f"{off}the gum of both arches lies between them: they were moved through one another"
        yield error("scans_passed", message, 1.0, 0.0)
    if found.through > _THROUGH_SHARE:
        message = f"{off}the arches are inside one another: the lower crowns end more than 2 mm above the upper ones "
        message += f"over {found.through:.0%} of the bite; at most {_THROUGH_SHARE:.0%} is possible"
        yield error("scans_inside", message, found.through, _THROUGH_SHARE)


def _unusual(found: Occlusion) -> Iterator[Finding]:
    """Yield warnings about a possible but unusual bite."""

    def warning(kind: str, message: str, value: float, limit: float, hint: str = _LOOK) -> Finding:
        return Finding(kind, "warning", message, value, limit, hint=hint)

    if found.gap_mm > _LOOSE_MM:
        message = f"the teeth scans do not touch: they are {found.gap_mm:.1f} mm apart at the closest point; up to "
        yield warning("scans_open", f"{message}{_LOOSE_MM:g} mm is usual", found.gap_mm, _LOOSE_MM, _EXPORT)
    if found.depth_mm > _TIGHT_MM:
        message = f"the crowns of the scans overlap by {found.depth_mm:.1f} mm; up to {_TIGHT_MM:g} mm is "
        bare = [name for name, over in zip(ARCH_NAMES, found.turned_over) if over is None]
        turned = f" Without gum, an upside-down scan ({' or '.join(bare)}) looks the same." if bare else ""
        yield warning("scans_overlap", message + "usual", found.depth_mm, _TIGHT_MM, _EXPORT + turned)
    left, right = found.side_gaps_mm
    if abs(left - right) > _ONE_SIDED_MM:
        tight, loose = ("right", "left") if left > right else ("left", "right")
        message = f"the bite is tilted: the teeth are {abs(left - right):.1f} mm farther apart on the {loose} side "
        message += f"than on the {tight} side; up to {_ONE_SIDED_MM:g} mm is usual"
        yield warning("bite_tilted", message, abs(left - right), _ONE_SIDED_MM)
    if found.midlines_mm > _MIDLINES_MM:
        message = f"the midlines of the two arches are {found.midlines_mm:.1f} mm apart; up to "
        yield warning("midlines_apart", f"{message}{_MIDLINES_MM:g} mm is usual", found.midlines_mm, _MIDLINES_MM)
    for name, width in zip(ARCH_NAMES, found.widths_mm):
        if not _NARROW_MM <= width <= _WIDE_MM:
            message = f"the {name} arch is {width:.0f} mm wide; {_NARROW_MM:g} to {_WIDE_MM:g} mm is usual"
            yield warning("scan_size", message, width, _WIDE_MM, _UNITS)
    if not _RATIOS[0] <= found.width_ratio <= _RATIOS[1] and np.isfinite(found.width_ratio):
        message = f"the upper arch is {found.width_ratio:.2f} times as wide as the lower one ({_RATIOS[0]:g} "
        message += f"to {_RATIOS[1]:g} is usual): a crossbite, or scans of different scale"
        yield warning("arch_widths", message, found.width_ratio, _RATIOS[found.width_ratio > 1.0])
    if found.lower_ahead_mm > _LOWER_AHEAD_MM:
        message = f"the lower front teeth are {found.lower_ahead_mm:.1f} mm in front of the upper ones: an underbite, "
        hint = "Check that the upper and the lower file in [scans] are not exchanged."
        yield warning("underbite", message + "or exchanged scan files", found.lower_ahead_mm, _LOWER_AHEAD_MM, hint)
    for k, name in enumerate(ARCH_NAMES):
        if found.opens_towards[k] and found.turned_over[k] is None:
            message = f"the open side of the {name} scan faces the other arch: it is upside down, or its faces are "
            yield warning("scan_inside_out", message + "wound inwards", 1.0, 0.0, _LOOK)
