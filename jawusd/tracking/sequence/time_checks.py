"""Synchronisation errors found in a tracked take: late or early cameras, and dropped or repeated frames.

Where the jaw moves fast, the linear equations of `TakeEquations` fail for delays of a whole frame. With masks,
neighbouring frames of each camera are therefore compared with the pose estimated from the other cameras. Without masks,
a step in the delay is fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.formats.finding import Finding
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.frame_record import FrameRecord, whole_frames
from jawusd.tracking.contour.quality import penalised_score_px
from jawusd.tracking.contour.scan import CROWN
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews, View, present_masks
from jawusd.tracking.sequence.extrinsics import Extrinsics
from jawusd.tracking.sequence.nuisance import Nuisances, TakeEquations
from jawusd.tracking.sequence.results import outline_variance

SHIFTS = (-1, 0, 1)  # time shifts of the compared masks [frames]
_CHECKED_FRAMES = 18  # number of frames checked per take; each takes 0.1 s
_FEWEST = 3  # minimum number of conclusive frames on either side of a step, since two successive masks may be wrong
# Minimum margin by which a shift fits better than all others, and upper limit to which margins are clipped, both as
# fractions of the visible contour [-].
_LEAST_LEAD, _MOST_LEAD = 0.1, 0.5
# Minimum fit of a camera's masks at the best shift [-]: below it, something other than the time offset is wrong.
# False-alarm rate: at most 4 %.
_LEAST_FIT = -0.1
# Minimum margin over the best fit of the other cameras [-]; sufficient if the other cameras fit badly, for example when
# the jaw was lost after a dropped frame.
_BETTER_FIT = 0.15


class Shift(NamedTuple):
    """A camera whose masks are shifted in time."""

    camera: int  # index of the camera
    frames: int  # number of frames by which the camera is late; negative if it is early
    frame: int | None  # first frame with the shift; None for the whole take


@dataclass(frozen=True, eq=False)
class FrameShifts:
    """Fit of each camera's masks of neighbouring frames to the poses estimated from the other cameras."""

    frames: NDArray[np.int_]  # the frames checked, shape (F,)
    #: matched contour less the penalty for uncovered mask, relative to the visible contour, for each frame, camera and
    #: shift, shape (F, C, 3); NaN if the camera or all others have no mask
    fit: Array

    def clearest(self) -> Shift | None:
        """Return the most significant shift; None if the masks of all cameras are synchronous.

        The shift of one camera biases the poses with which the other cameras are compared, so these seem to be shifted
        as well.
        """
        found = [shift for c in range(self.fit.shape[1]) for shift in self._shifts_of(c)]
        return max(found, key=lambda entry: entry[0])[1] if found else None

    def is_timely(self, camera: int) -> bool:
        """Return whether a camera's masks are clearly synchronous."""
        return _agree(self._conclusive(camera)[1][:, SHIFTS.index(0)])

    def _conclusive(self, c: int) -> tuple[NDArray[np.int_], Array]:
        """Return the indices of frames conclusive for a camera, and the margin of each shift in them, shape (n, 3)."""
        leads = _leads(self.fit[:, c])
        rows = np.flatnonzero(np.isfinite(leads).all(1))
        return rows, np.clip(leads[rows], -_MOST_LEAD, _MOST_LEAD)

    def _others_at_best(self, c: int, rows: NDArray[np.int_]) -> Array:
        """Return the median best fit of the other cameras' masks, shape (n,); inf if no other camera has a mask."""
        others = np.delete(self.fit[rows], c, axis=1).max(2)
        usual = np.full(len(rows), np.inf)
        seen = np.isfinite(others).any(1)
        usual[seen] = np.nanmedian(others[seen], axis=1)
        return usual

    def _shifts_of(self, c: int) -> Iterator[tuple[float, Shift]]:
        """Yield the evidence for each possible shift of a camera, and the shift."""
        rows, leads = self._conclusive(c)
        above = self.fit[rows, c] - np.minimum(_LEAST_FIT, self._others_at_best(c, rows) + _BETTER_FIT)[:, None]
        for k, shift in enumerate(SHIFTS):
            if shift != 0 and _agree(leads[:, k], above[:, k]):
                yield float(leads[:, k].sum()), Shift(c, -shift, None)
        for k in range(_FEWEST, len(rows) - _FEWEST + 1):
            before, after = leads[:k], leads[k:]
            a, b = int(np.median(before, axis=0).argmax()), int(np.median(after, axis=0).argmax())
            if a != b and _agree(before[:, a], above[:k, a]) and _agree(after[:, b], above[k:, b]):
                evidence = float(before[:, a].sum() + after[:, b].sum())
                yield evidence, Shift(c, SHIFTS[a] - SHIFTS[b], int(self.frames[rows[k]]))


def _leads(fit: Array) -> Array:
    """Return the margin by which each shift fits better than the best other shift, shape (F, 3)."""
    return np.stack([fit[:, k] - np.delete(fit, k, axis=1).max(1) for k in range(fit.shape[1])], axis=1)


def _agree(leads: Array, above: Array | None = None) -> bool:
    """Return whether a shift fits best in enough frames and in the majority, and well enough where it fits best."""
    leading = leads > _LEAST_LEAD
    clear = leading.sum() >= _FEWEST and np.median(leads) > _LEAST_LEAD
    return bool(clear and (above is None or np.median(above[leading]) > 0.0))


def frame_shifts(records: Mapping[int, FrameRecord], masks: MaskViews, solver: ContourSolver) -> FrameShifts:
    """Compare the masks of frames with fast jaw motion with the masks of neighbouring frames.

    If all masks are in sync at both ends of the take, the frames between are skipped: a delay there would have to
    appear and vanish again, which is unlikely.
    """
    frames = _fast_frames(records)
    fit = np.full((len(frames), len(masks.cameras), len(SHIFTS)), np.nan)
    ends = [k for k in range(len(frames)) if min(k, len(frames) - 1 - k) < _FEWEST]
    between = [k for k in range(len(frames)) if k not in ends]
    for part in (ends, between):
        for k in part:
            fit[k] = _fits(records[frames[k]], masks.around(frames[k], SHIFTS[-1]), solver.thin or solver)
        own = np.stack([_leads(fit[ends, c]) for c in range(len(masks.cameras))])[..., SHIFTS.index(0)]
        if (own > _LEAST_LEAD).all():
            break
    return FrameShifts(np.array(frames, int), fit)


def _fits(record: FrameRecord, around: Sequence[Sequence[View]], solver: ContourSolver) -> Array:
    """Return the fit of every camera's masks, at every shift, to poses from the other cameras only, shape (C, 3)."""
    config, poses, views = solver.config, record.solution.poses, around[SHIFTS.index(0)]
    rendering = solver.rendering(views)
    out = np.full((len(views), len(SHIFTS)), np.nan)
    for c, view in enumerate(views):
        use = present_masks(views)
        use[:, c] = False
        shown = np.logical_and.reduce([now[c].present for now in around]) & use.any(1)  # shape (2,)
        if shown.any():
            apart = solver.solve(poses, views, config.gates_from(0.0), use, rendering=rendering).poses
            masks = [_in_window(view, now[c]) for now in around]
            out[c] = _judged(apart, view, masks, shown, solver)
    return out


def _judged(poses: Array, view: View, masks: Sequence[NDArray[np.uint8]], shown: Mask, solver: ContourSolver) -> Array:
    """Return the fit of several pairs of masks (2, h, w) of a view to poses, shape (n,) [-]."""
    rendering, out = solver.rendering([view]), np.empty(len(masks))
    for k, pair in enumerate(masks):
        found = solver.solve(poses, [replace(view, masks=pair)], (), shown[:, None], rendering=rendering)
        uncovered = ((pair > 127) & (rendering.labels[0] != CROWN)).sum((1, 2))
        fits = penalised_score_px(found, uncovered[:, None], solver.config.uncovered_price)[:, 0]
        out[k] = fits[shown].sum() / max(float(found.visible_px[shown].sum()), 1.0)
    return out


def _in_window(view: View, other: View) -> NDArray[np.uint8]:
    """Return the masks of another frame of the same camera, cropped to the window of a view, shape (2, h, w)."""
    # The windows are offset by whole pixels: cropping x columns subtracts x times row 2 of the matrix from row 0.
    axis = view.matrix[2]
    moved = np.rint((other.matrix[:2] - view.matrix[:2]) @ axis / (axis @ axis)).astype(int)
    out = np.zeros_like(view.masks)
    into, start = [], []
    for shift, size, whole in zip(-moved[::-1], other.masks.shape[1:], out.shape[1:], strict=True):
        first, last = max(int(shift), 0), min(int(shift) + size, whole)
        into.append(slice(first, max(first, last)))
        start.append(slice(first - int(shift), max(first, last) - int(shift)))
    out[:, into[0], into[1]] = other.masks[:, start[0], start[1]]
    return out


def _fast_frames(records: Mapping[int, FrameRecord]) -> list[int]:
    """Return frames spread over the take: the frame with the fastest motion of the lower arch in every part."""
    centres = {frame: records[frame].solution.centres[1] for frame in sorted(records)}
    inner = [frame for frame in centres if frame - 1 in centres and frame + 1 in centres]
    if not inner:
        return []
    moved = [float(np.linalg.norm(centres[frame + 1] - centres[frame - 1])) for frame in inner]
    parts = np.array_split(np.arange(len(inner)), min(_CHECKED_FRAMES, len(inner)))
    return [inner[max(part, key=lambda i: moved[i])] for part in parts]


_PRIOR_FRAMES = 1.0  # prior standard deviation of a step in the delay
_LEAST_FRAMES = 2  # minimum number of frames on either side of a step


@dataclass(frozen=True)
class DelayStep:
    """The most significant step in a camera's delay: size, standard deviation [frames], and first frame after it."""

    step: float
    sigma: float
    frame: int


def delay_steps(
    records: Mapping[int, FrameRecord], variance_px3: Array, extrinsics: Extrinsics, frames: list[int]
) -> list[DelayStep]:
    """Return the most significant step in every camera's delay; an empty list with too few frames.

    For every camera and frame in turn, an additional delay from that frame on is added to the unknowns of
    `TakeEquations`, and all others are eliminated. `frames` are those with both arches, in ascending order.
    """
    if len(frames) < 2 * _LEAST_FRAMES:
        return []
    cameras = len(extrinsics.twists)
    S, right = TakeEquations(records, variance_px3, extrinsics, []).normal_equations()
    # Delay terms of each frame, then their sums from each frame to the last, computed in place: tens of megabytes for
    # long takes.
    after_S = np.empty((len(frames), len(right), cameras))
    after_r = np.empty((len(frames), cameras))
    for k, frame in enumerate(frames):
        own_S, own_right = TakeEquations(records, variance_px3, extrinsics, [frame]).normal_equations()
        S, right = S + own_S, right + own_right
        after_S[k], after_r[k] = own_S[:, :cameras], own_right[:cameras]
    for table in (after_S, after_r):
        np.cumsum(table[::-1], axis=0, out=table[::-1])
    prior = np.linalg.pinv(TakeEquations(records, variance_px3, extrinsics, []).prior_covariance())
    fixed = len(right) - 6 * cameras  # camera motions are assumed to be known
    keep = np.arange(1, fixed)
    A = np.linalg.inv((S + prior)[np.ix_(keep, keep)])
    out = []
    for c in range(cameras):
        best = DelayStep(0.0, 1.0, frames[0])
        for k in range(_LEAST_FRAMES, len(frames) - _LEAST_FRAMES + 1):
            b = after_S[k][keep, c]
            precision = float(after_S[k][c, c] - b @ A @ b) + _PRIOR_FRAMES**-2
            step = float(after_r[k][c] - b @ A @ right[keep]) / precision
            sigma = precision**-0.5
            if abs(step) / sigma > abs(best.step) / best.sigma:
                best = DelayStep(step, sigma, frames[k])
        out.append(best)
    return out


_CLEARLY = 4.0  # minimum significance of a delay or step [standard deviations]
_LATE_FRAMES = 0.7  # minimum delay for a warning: free-running cameras differ by up to half a frame
# Smallest step in a camera's delay that triggers a warning, in a take without masks [frames]. Steps are missed where
# the jaw moves fast.
_STEP_FRAMES = 0.5


def time_findings(
    names: Sequence[str],
    records: Mapping[int, FrameRecord],
    nuisances: Nuisances,
    extrinsics: Extrinsics,
    config: TrackingConfig,
    shifts: FrameShifts | None = None,
) -> list[Finding]:
    """Return warnings "camera_late" [frames] and "frame_dropped" [frames] about cameras that are late or early.

    `shifts` is None without masks; steps are then found from delays shorter than a frame.
    """
    limits = np.maximum(_LATE_FRAMES, _CLEARLY * nuisances.sigma_delays)
    late = {k: float(nuisances.delays[k]) for k in np.flatnonzero(np.abs(nuisances.delays) > limits).tolist()}
    if shifts is None:
        return [*_late(names, late), *_step_of_delay(names, records, extrinsics, config)]
    late = {camera: frames for camera, frames in late.items() if not shifts.is_timely(camera)}
    shift = shifts.clearest()
    if shift is None:
        return _late(names, late)
    if shift.frame is None:
        return _late(names, late or {shift.camera: float(shift.frames)})
    return [*_late(names, late), _dropped(names[shift.camera], shift.frames, shift.frame)]


def _late(names: Sequence[str], frames: Mapping[int, float]) -> list[Finding]:
    """Return warnings about cameras that are late by some frames."""
    out = []
    for camera, late in frames.items():
        message = f"the images of this camera are {abs(late):.1f} frames {'later' if late > 0 else 'earlier'} than its "
        message += f"time offset implies; less than {_LATE_FRAMES} frames is usual."
        hint = f"Check this camera's offset in [sync]: {round(late):+d} frames would fit better."
        value = round(late, 2)
        out.append(Finding("camera_late", "warning", message, value, _LATE_FRAMES, camera=names[camera], hint=hint))
    return out


def _step_of_delay(
    names: Sequence[str], records: Mapping[int, FrameRecord], extrinsics: Extrinsics, config: TrackingConfig
) -> list[Finding]:
    """Return a warning if the delay of a camera changes within the take."""
    steps = delay_steps(records, outline_variance(records, config), extrinsics, whole_frames(records))
    # The poses partly follow the camera with the step in its delay, so the other cameras seem to have an opposite step;
    # the true step is the most significant one.
    clearest = max(range(len(steps)), key=lambda c: abs(steps[c].step) / steps[c].sigma, default=None)
    if clearest is None:
        return []
    found = steps[clearest]
    if abs(found.step) <= max(_STEP_FRAMES, _CLEARLY * found.sigma):
        return []
    return [_dropped(names[clearest], found.step, found.frame)]


def _dropped(name: str, step: float, frame: int) -> Finding:
    message = (
        f"the delay of this camera changes by {step:+.1f} frames near here: a frame was dropped or repeated; less "
    )
    message += f"than {_STEP_FRAMES} frames is usual."
    hint = "Export the clip again at a constant frame rate, or split the take there."
    value = round(step, 2)
    return Finding("frame_dropped", "warning", message, value, _STEP_FRAMES, camera=name, frame=frame, hint=hint)
