"""Findings about the inputs of a tracked take (calibration, scans, masks, cameras), and about skipped searches.

False-alarm rates come from `tests/benchmarks/population.py`; docs/explanation/constants.md lists them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.finding import Finding
from jawusd.formats.tracks import LOST
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.frame_record import FrameRecord, whole_frames
from jawusd.tracking.contour.quality import fitting_share, residual_px, score_px
from jawusd.tracking.contour.scan import ARCH_NAMES, Scan, mirrored
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.initialization.bootstrap import SIZE_HINT, than
from jawusd.tracking.initialization.magnification import Instant, Magnification
from jawusd.tracking.sequence.extrinsics import Extrinsics
from jawusd.tracking.sequence.history import SearchBudget


@dataclass(frozen=True)
class LensLimits:
    """Limits on the magnification of cameras, beyond which a warning is given."""

    scale: float  # magnification error of one camera relative to the others [-]
    common: float  # magnification error of all cameras [-]
    bend: float  # change of magnification over 25 mm at the teeth [-]
    bias_px: float  # outline bias of a camera relative to the others [px]
    clear: float  # minimum significance of `scale` and `common` [standard deviations]
    knock: float  # motion of a camera relative to the others [standard deviations]


#: Limits for drawn masks. Standard deviations of magnifications include possible camera motion along the optical axis.
OF_MASKS = LensLimits(0.02, 0.015, 0.002, 1.2, 3.0, 8.0)
#: Limits for tracking by colour, in which standard deviations are larger and lens distortion cannot be detected.
OF_COLOURS = LensLimits(0.03, 0.015, np.inf, np.inf, 1.6, np.inf)
# Maximum change of magnification by lens distortion [-], reached by an uncalibrated lens with k1 = -0.4 at a distance
# of 130 mm: larger changes are due to wrong masks of side teeth.
_MOST_BEND = 0.015
# Rotation and motion of a camera since its calibration above which a warning is given, although both are corrected.
_TURN_DEG, _MOVE_MM = 0.25, 0.7
_KNOCKED_MORE = 1.5  # minimum ratio of a knocked camera's motion to that of any other camera
_TELLING_CAMERAS = 3  # minimum number of cameras for identifying a wrong one: if two differ, either may be wrong
# Minimum matched fraction of the visible contour, and maximum residual, both relative to the other scan: a scan that
# violates both belongs to another subject. Last value: minimum number of frames for the decision. False-alarm rate: at
# most 14 %.
_FITS_LESS, _FITS_ROUGHER, _TELLING_FRAMES = 0.35, 1.5, 3
_CLEARLY = 4.0  # minimum significance for a warning [standard deviations]


def lens_findings(names: Sequence[str], found: Magnification, limits: LensLimits = OF_MASKS) -> list[Finding]:
    """Return findings about scans, focal lengths, lenses and masks from the magnification of the cameras.

    Kinds and units: "scan_size" [%], "focal_length" [%], "camera_moved" [degrees], "lens_distortion" [%], "side_teeth"
    [%], "masks_wide" [px].
    """
    out = []
    knocked = _knocked(found, limits)
    common = found.common
    sigma = float(np.sqrt(np.mean(found.sigma_scale**2) / len(found.scale)))  # motions of cameras are independent
    if abs(common) > max(limits.common, limits.clear * sigma) and (np.sign(found.scale) == np.sign(common)).all():
        message = f"every camera shows the teeth {than(common)} than the scans: the scale of the scans or of the "
        message += f"calibration is wrong; a difference of at most {limits.common:.1%} is usual."
        out.append(_percent("scan_size", message, common, limits.common, SIZE_HINT))
    for c, name in enumerate(names):
        own, wide = float(found.scale[c] - common), _wide(name, c, found, limits)
        if len(names) >= _TELLING_CAMERAS and abs(own) > max(limits.scale, limits.clear * found.sigma_scale[c]):
            message = f"this camera shows the teeth {than(own)} than expected from its calibration and the others; "
            message += f"at most {limits.scale:.0%} is usual. Its focal length or its distance is wrong."
            hint = "Calibrate this camera again with the lens, zoom and focus of the recording."
            out.append(_percent("focal_length", message, own, limits.scale, hint, name))
        elif c == knocked:
            turn_deg = float(np.rad2deg(found.turn_rad[c]))
            message = f"this camera seems to have turned, relative to the others, by {turn_deg:.2f} degrees and moved "
            message += f"by {found.move_mm[c]:.1f} mm since its calibration, {found.motion_clear[c]:.0f} times the "
            message += f"uncertainty; up to {OF_MASKS.knock:g} times is usual."
            hint = "The camera was knocked, or its calibration is wrong: calibrate it again, or exclude it."
            out.append(_camera_moved(name, turn_deg, message, hint))
        elif not wide and abs(found.bend[c]) > max(limits.bend, _CLEARLY * found.sigma_bend[c]):
            out.append(_bent(name, float(found.bend[c]), limits))
        out += wide
    return out


def _knocked(found: Magnification, limits: LensLimits) -> int | None:
    """Return the camera that moved most significantly relative to the others; None if no camera did."""
    if len(found.motion_clear) < _TELLING_CAMERAS:
        return None
    *_, second, worst = np.argsort(found.motion_clear).tolist()
    least = max(limits.knock, _KNOCKED_MORE * float(found.motion_clear[second]))
    return worst if found.motion_clear[worst] > least else None


def _percent(kind: str, message: str, value: float, limit: float, hint: str, camera: str | None = None) -> Finding:
    """Return a warning about a fraction and its limit, both reported in percent."""
    return Finding(kind, "warning", message, round(100 * value, 2), 100 * limit, camera=camera, hint=hint)


def _camera_moved(name: str, turn_deg: float, message: str, hint: str) -> Finding:
    return Finding("camera_moved", "warning", message, round(turn_deg, 3), _TURN_DEG, camera=name, hint=hint)


def _bent(name: str, bend: float, limits: LensLimits) -> Finding:
    """Return a warning about a camera whose magnification changes with the distance from the optical axis."""
    if abs(bend) > _MOST_BEND:
        message = f"this camera's masks show the teeth {than(bend)} at 25 mm from the optical axis than in the centre; "
        message += f"no lens distorts by more than {_MOST_BEND:.1%} there. The masks of the side teeth are wrong."
        hint = "Check the masks at the corners of the mouth: they often end too early in the shadow, or include it."
        return _percent("side_teeth", message, bend, _MOST_BEND, hint, name)
    message = f"this camera shows the teeth {than(bend)} at 25 mm from the optical axis than its calibration predicts; "
    message += f"at most {limits.bend:.1%} is usual. Its lens distortion is wrong."
    hint = "Check the signs and the order of the distortion coefficients, or calibrate the camera again."
    return _percent("lens_distortion", message, bend, limits.bend, hint, name)


def _wide(name: str, c: int, found: Magnification, limits: LensLimits) -> list[Finding]:
    """Return a warning if the mask outlines of a camera lie far outside or inside those of the others."""
    own = found.bias_px[c] - np.median(found.bias_px, axis=0)
    bias, least = float(own.mean()), max(limits.bias_px, _CLEARLY * float(found.sigma_bias_px[c].max()))
    if len(found.bias_px) < _TELLING_CAMERAS or np.abs(own).min() < least or own.min() * own.max() < 0:
        return []
    message = f"the mask outlines lie {abs(bias):.1f} px {'outside' if bias > 0 else 'inside'} those of the other "
    message += f"cameras at working resolution; at most {limits.bias_px} px is usual."
    hint = "Draw these masks again, or exclude this camera."
    return [Finding("masks_wide", "warning", message, round(bias, 2), limits.bias_px, camera=name, hint=hint)]


def motion_findings(names: Sequence[str], extrinsics: Extrinsics) -> list[Finding]:
    """Return a warning "camera_moved" [degrees] for each camera that moved significantly since its calibration."""
    out = []
    for name, twist, sigma in zip(names, extrinsics.twists, extrinsics.sigma, strict=True):
        turn, move = float(np.rad2deg(np.linalg.norm(twist[:3]))), float(np.linalg.norm(twist[3:]))
        clear = (np.abs(twist) > _CLEARLY * sigma).any()
        if clear and (turn > _TURN_DEG or move > _MOVE_MM):
            message = (
                f"this camera has turned by {turn:.2f} degrees and moved by {move:.1f} mm since its calibration "
                f"(up to {_TURN_DEG:g} degrees and {_MOVE_MM:g} mm is usual); corrected."
            )
            out.append(_camera_moved(name, turn, message, "The camera was knocked: calibrate it again to be sure."))
    return out


def misfit_findings(records: Mapping[int, FrameRecord]) -> list[Finding]:
    """Return a warning "scan_misfit" [% of the visible contour] for a scan that barely fits its own masks."""
    whole = [records[frame].solution for frame in whole_frames(records)]
    if len(whole) < _TELLING_FRAMES:
        return []
    share = np.median([fitting_share(s) for s in whole], axis=0)
    rough = np.nanmedian([residual_px(s) for s in whole], axis=0)
    out = []
    for r, other in ((0, 1), (1, 0)):
        if share[r] < _FITS_LESS * share[other] and rough[r] > _FITS_ROUGHER * rough[other]:
            name = ARCH_NAMES[r]
            message = f"the {name} scan barely fits its own masks: {share[r]:.0%} of its visible contour matches, with "
            message += f"residuals of {rough[r]:.1f} px; for the {ARCH_NAMES[other]} scan, it is {share[other]:.0%}, "
            message += f"with residuals of {rough[other]:.1f} px. The poses of the {name} scan are unreliable."
            hint = f"Check that the {name} scan is a recent one of this subject, and that its masks show the {name} "
            value, limit = 100 * float(share[r]), 100 * _FITS_LESS * float(share[other])
            out.append(
                Finding("scan_misfit", "warning", message, round(value, 1), round(limit, 1), hint=hint + "teeth.")
            )
    return out


def search_findings(searches: SearchBudget, records: Mapping[int, FrameRecord]) -> list[Finding]:
    """Return a warning "searches_left_out" [frames] if frames stay lost without a search as the budget was used up."""
    lost = [f for f in sorted(searches.left_out) if ((records[f].status == LOST) & records[f].used.any(1)).any()]
    if not lost:
        return []
    message = f"{searches.fruitless} searches for lost teeth failed; for a take of this length, the limit is "
    message += f"{searches.most} more failures than successes. Lost teeth were not searched for in {len(lost)} frames, "
    message += "beginning with this one."
    hint = "Check the masks of the lost frames: arches or cameras may be exchanged there."
    return [Finding("searches_left_out", "warning", message, len(lost), searches.most, frame=lost[0], hint=hint)]


_HALF = 0.5  # minimum fraction of a camera's masks that are used; with fewer, it mostly contradicts the others


def use_of_cameras(names: tuple[str, ...], records: Mapping[int, FrameRecord]) -> list[Finding]:
    """Return a warning "camera_not_used" or "camera_rarely_used" [fraction of masks used] for each such camera."""
    frames = sorted(records)
    present = np.array([np.isfinite(records[frame].coverage) for frame in frames])  # mask exists, shape (F, 2, C)
    used = np.array([records[frame].used for frame in frames])
    out = []
    for c, name in enumerate(names):
        seen, taken = present[..., c], used[..., c]
        with_masks, with_use = int(seen.any(1).sum()), int(taken.any(1).sum())
        if not with_masks:
            message = f"used in 0 of {len(frames)} frames: it has no masks from frame {frames[0]} to {frames[-1]}."
            hint = "Check `frames`, the frame numbers of the camera's masks, and its time offset."
            out.append(Finding("camera_not_used", "warning", message, 0, camera=name, hint=hint))
        elif not with_use or taken.sum() < _HALF * seen.sum():
            kind = "camera_rarely_used" if with_use else "camera_not_used"
            message = f"used in {with_use} of {len(frames)} frames: {int((seen & ~taken).sum())} of its "
            message += f"{int(seen.sum())} masks fit neither the scans nor the other cameras' masks."
            hint = "Check that the masks belong to this camera, and check its calibration and time offset."
            value = round(float(taken.sum() / seen.sum()), 3)
            out.append(Finding(kind, "warning", message, value, _HALF, camera=name, hint=hint))
    return out


_FRAMES = 4  # number of frames aligned with scans and mirrored scans, which takes one or two seconds
# Minimum ratio of the contour matched by mirrored scans to that matched by the given scans for a warning [-]; correct
# scans reach at most 0.98.
_LEAST_RATIO = 1.15


def mirror_findings(
    scans: Sequence[Scan], left: Array, instants: Iterable[Instant], config: TrackingConfig
) -> list[Finding]:
    """Return a warning "scans_mirrored" if mirrored scans (left and right exchanged) match more contour.

    `left` is the unit vector to the left in scan coordinates, shape (3,); `instants` are some aligned frames.
    """
    middle = np.mean([scan.centre for scan in scans], axis=0)
    pair = [ContourSolver(own, config) for own in (scans, [mirrored(scan, middle, left) for scan in scans])]
    shares = []
    chosen = list(instants)
    for k in np.unique(np.linspace(0, len(chosen) - 1, _FRAMES).astype(int)) if chosen else ():
        poses, views, use = chosen[k]
        found = [solver.solve(poses, views, config.wide_gates_px, use) for solver in pair]
        shares.append([score_px(one).sum() / max(one.visible_px.sum(), 1.0) for one in found])
    given, other = np.median(shares, axis=0).tolist() if shares else (0.0, 0.0)
    ratio = other / given if given > 0 else 0.0
    if not ratio > _LEAST_RATIO:
        return []
    message = f"mirrored scans match {ratio:.2f} times as much of the outlines: left and right are exchanged"
    hint = "Export the scans again without mirroring; one axis may have been negated."
    return [Finding("scans_mirrored", "warning", message, round(ratio, 2), _LEAST_RATIO, hint=hint)]
