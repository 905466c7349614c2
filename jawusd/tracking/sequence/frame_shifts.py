"""Which instant each camera shows: its masks of neighbouring frames compared with the teeth as other cameras see them.

Delays of a part of a frame are estimated by linear equations (`TakeEquations`). A whole frame is too much for these
where the jaw is fast: masks of the wrong instant are then left out, or draw the jaw to them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import score_px
from jawusd.tracking.contour.scan import CROWN
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews, View, present_masks

SHIFTS = (-1, 0, 1)  # frames
_LOOKED_AT = 18  # frames of a take: a tenth of a second each
_FEWEST = 3  # frames that tell, on either side of a step: two masks in a row may be wrong
# By how much a shift must fit better than others to tell, as a share of the visible contour, and how much of it counts.
_LEAST_LEAD, _MOST_LEAD = 0.1, 0.5
# How well the masks of the right instant fit at least: otherwise it is not the instant that is wrong. Chosen on persons
# 9300-9316 of `tests/benchmarks/population.py`: every camera of ten that dropped a frame was found, with fits of -0.02
# and more; wrong focal lengths and masks drawn 6 px too wide had -0.2 and less. False alarms: none of 69 others
# (9330-9399), at most 4 % (95 %).
_LEAST_FIT = -0.1
# Where all fit worse, as when the jaw was lost after a dropped frame: how much better than those of the other cameras
# at their best. Chosen on the one of 17 takes with a dropped frame that was missed without it (9516, better by 0.6);
# nothing changes in the other 16, in 13 takes with other faults, and in 30 valid ones (9500-9529).
_BETTER_FIT = 0.15


class Shift(NamedTuple):
    """Name a camera that shows a later instant than it should by so many frames.

    Attributes:
        camera: its number.
        frames: by how many; negative for an earlier instant.
        frame: of the take, from which on; None if it does all over the take.
    """

    camera: int
    frames: int
    frame: int | None


@dataclass(frozen=True, eq=False)
class FrameShifts:
    """Hold how well each camera's masks of neighbouring frames fit the teeth as the others see them.

    Attributes:
        frames: that were looked at, shape (F,).
        fit: contour that fits less the price of uncovered mask, per frame, camera and shift, as a share of what is
            visible, shape (F, C, 3); NaN where the camera has no mask or the others see nothing.
    """

    frames: NDArray[np.int_]
    fit: Array

    def clearest(self) -> Shift | None:
        """Return the camera that shows another instant most clearly, None if all show the right one.

        One camera's shift draws the poses that others are compared with, so that these seem to shift as well.
        """
        found = [shift for c in range(self.fit.shape[1]) for shift in self._shifts_of(c)]
        return max(found, key=lambda entry: entry[0])[1] if found else None

    def is_timely(self, camera: int) -> bool:
        """Tell whether a camera shows the right instant, clearly so."""
        return _agree(self._told(camera)[1][:, SHIFTS.index(0)])

    def _told(self, c: int) -> tuple[NDArray[np.int_], Array]:
        """Return the rows of the frames that tell of a camera, and by how much each shift leads there, shape (n, 3)."""
        leads = _leads(self.fit[:, c])
        rows = np.flatnonzero(np.isfinite(leads).all(1))
        return rows, np.clip(leads[rows], -_MOST_LEAD, _MOST_LEAD)

    def _others_at_best(self, c: int, rows: NDArray[np.int_]) -> Array:
        """Return how well the other cameras' masks fit at the shift that suits each, inf where none is seen, (n,)."""
        others = np.delete(self.fit[rows], c, axis=1).max(2)
        usual = np.full(len(rows), np.inf)
        seen = np.isfinite(others).any(1)
        usual[seen] = np.nanmedian(others[seen], axis=1)
        return usual

    def _shifts_of(self, c: int) -> Iterator[tuple[float, Shift]]:
        """Yield what a camera's masks may show, each after its evidence."""
        rows, told = self._told(c)
        above = self.fit[rows, c] - np.minimum(_LEAST_FIT, self._others_at_best(c, rows) + _BETTER_FIT)[:, None]
        for k, shift in enumerate(SHIFTS):
            if shift != 0 and _agree(told[:, k], above[:, k]):
                yield float(told[:, k].sum()), Shift(c, -shift, None)
        for k in range(_FEWEST, len(rows) - _FEWEST + 1):
            before, after = told[:k], told[k:]
            a, b = int(np.median(before, axis=0).argmax()), int(np.median(after, axis=0).argmax())
            if a != b and _agree(before[:, a], above[:k, a]) and _agree(after[:, b], above[k:, b]):
                evidence = float(before[:, a].sum() + after[:, b].sum())
                yield evidence, Shift(c, SHIFTS[a] - SHIFTS[b], int(self.frames[rows[k]]))


def _leads(fit: Array) -> Array:
    """Return by how much each shift (F, 3) fits better than the best other one, same shape."""
    return np.stack([fit[:, k] - np.delete(fit, k, axis=1).max(1) for k in range(fit.shape[1])], axis=1)


def _agree(leads: Array, above: Array | None = None) -> bool:
    """Tell whether a shift leads in enough frames, and in most, and fits better there than it must by so much."""
    leading = leads > _LEAST_LEAD
    clear = leading.sum() >= _FEWEST and np.median(leads) > _LEAST_LEAD
    return bool(clear and (above is None or np.median(above[leading]) > 0.0))


def frame_shifts(records: Mapping[int, FrameRecord], masks: MaskViews, solver: ContourSolver) -> FrameShifts:
    """Compare the masks of some frames, those in which the jaw is fastest, with those before and after.

    Where all cameras show the right instant at both ends of the take, what lies between is not looked at: one step
    there would have to be followed by its opposite.

    Args:
        records: of all frames of the take.
        masks: of the take.
        solver: of its scans.
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
    """Return the fit of all cameras' masks of every shift, at poses that the other cameras alone give, shape (C, 3)."""
    config, poses, views = solver.config, record.solution.poses, around[SHIFTS.index(0)]
    rendering = solver.rendering(views)
    out = np.full((len(views), len(SHIFTS)), np.nan)
    for c, view in enumerate(views):
        use = present_masks(views)
        use[:, c] = False
        shown = np.logical_and.reduce([now[c].present for now in around]) & use.any(1)  # (2,)
        if shown.any():
            apart = solver.solve(poses, views, config.gates_from(0.0), use, rendering=rendering).poses
            masks = [_in_window(view, now[c]) for now in around]
            out[c] = _judged(apart, view, masks, shown, solver)
    return out


def _judged(poses: Array, view: View, masks: Sequence[NDArray[np.uint8]], shown: Mask, solver: ContourSolver) -> Array:
    """Return how well each of several pairs of masks (2, h, w) of a view fits poses, shape (n,) [-]."""
    rendering, out = solver.rendering([view]), np.empty(len(masks))
    for k, pair in enumerate(masks):
        found = solver.solve(poses, [replace(view, masks=pair)], (), shown[:, None], rendering=rendering)
        uncovered = ((pair > 127) & (rendering.labels[0] != CROWN)).sum((1, 2))
        fits = score_px(found)[:, 0] - solver.config.uncovered_price * uncovered
        out[k] = fits[shown].sum() / max(float(found.visible_px[shown].sum()), 1.0)
    return out


def _in_window(view: View, other: View) -> NDArray[np.uint8]:
    """Return the masks of another instant of the same camera in the window of a view, shape (2, h, w)."""
    # Windows differ by whole pixels: cutting off x columns takes x times row 2 of the matrix from row 0.
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
    """Return frames all over the take, of every part the one in which the lower arch moves most between neighbours."""
    centres = {frame: records[frame].solution.centres[1] for frame in sorted(records)}
    inner = [frame for frame in centres if frame - 1 in centres and frame + 1 in centres]
    if not inner:
        return []
    moved = [float(np.linalg.norm(centres[frame + 1] - centres[frame - 1])) for frame in inner]
    parts = np.array_split(np.arange(len(inner)), min(_LOOKED_AT, len(inner)))
    return [inner[max(part, key=lambda i: moved[i])] for part in parts]
