"""Which instant each camera shows: its masks of neighbouring frames compared with the teeth as other cameras see them.

Delays of a part of a frame are estimated by linear equations (`TakeEquations`). A whole frame is too much for these
where the jaw is fast: masks of the wrong instant are then left out, or draw the jaw to them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jawusd.geometry.arrays import Array
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import score_px, uncovered_px
from jawusd.tracking.contour.rendering import Rendering
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews, View, present_masks

SHIFTS = (-1, 0, 1)  # frames
_LOOKED_AT = 18  # frames of a take: a tenth of a second each
_FEWEST = 3  # frames that tell, on either side of a step: two masks in a row may be wrong
# By how much a shift must fit better than others to tell, as a share of the visible contour, and how much of it counts.
_LEAST_LEAD, _MOST_LEAD = 0.1, 0.5


class Shift(NamedTuple):
    """Name a camera that shows a later instant than it should by so many frames, from a frame of the take on."""

    camera: int
    frames: int
    frame: int


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

    def step(self) -> Shift | None:
        """Return where a camera changes from one shift to another: the clearest one, None without any."""
        found = [step for c in range(self.fit.shape[1]) if (step := self._step_of(c)) is not None]
        return max(found)[1] if found else None

    def late(self) -> Shift | None:
        """Return the camera that shows another instant all over the take, the clearest one; None without any."""
        found = []
        for c in range(self.fit.shape[1]):
            leads = _leads(self.fit[:, c])
            told = leads[np.isfinite(leads).all(1)]
            for k in (0, 2):
                if _agree(told[:, k]):
                    found.append((float(np.median(told[:, k])), Shift(c, -SHIFTS[k], int(self.frames[0]))))
        return max(found)[1] if found else None

    def _step_of(self, c: int) -> tuple[float, Shift] | None:
        """Return a camera's clearest step after its evidence."""
        leads = _leads(self.fit[:, c])
        rows = np.flatnonzero(np.isfinite(leads).all(1))
        told = np.clip(leads[rows], -_MOST_LEAD, _MOST_LEAD)
        best: tuple[float, Shift] | None = None
        for k in range(_FEWEST, len(rows) - _FEWEST + 1):
            before, after = told[:k], told[k:]
            a, b = int(np.median(before, axis=0).argmax()), int(np.median(after, axis=0).argmax())
            if a == b or not (_agree(before[:, a]) and _agree(after[:, b])):
                continue
            evidence = float(before[:, a].sum() + after[:, b].sum())
            if best is None or evidence > best[0]:
                best = evidence, Shift(c, SHIFTS[a] - SHIFTS[b], int(self.frames[rows[k]]))
        return best


def _leads(fit: Array) -> Array:
    """Return by how much each shift (F, 3) fits better than the best other one, same shape."""
    return np.stack([fit[:, k] - np.delete(fit, k, axis=1).max(1) for k in range(fit.shape[1])], axis=1)


def _agree(leads: Array) -> bool:
    """Tell whether a shift leads in enough frames, and in most."""
    return bool((leads > _LEAST_LEAD).sum() >= _FEWEST and np.median(leads) > _LEAST_LEAD)


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
            fit[k] = _fits(records[frames[k]], [masks.at(frames[k] + shift) for shift in SHIFTS], solver.thin or solver)
        own = np.stack([_leads(fit[ends, c]) for c in range(len(masks.cameras))])[..., SHIFTS.index(0)]
        if (own > _LEAST_LEAD).all():
            break
    return FrameShifts(np.array(frames, int), fit)


def _fits(record: FrameRecord, around: Sequence[Sequence[View]], solver: ContourSolver) -> Array:
    """Return the fit of all cameras' masks of every shift, at poses that the other cameras alone give, shape (C, 3)."""
    config, poses, views = solver.config, record.solution.poses, around[SHIFTS.index(0)]
    rendering = Rendering(solver, views)
    out = np.full((len(views), len(SHIFTS)), np.nan)
    for c in range(len(views)):
        own = [now[c] for now in around]
        use = present_masks(views)
        use[:, c] = False
        shown = np.logical_and.reduce([view.present for view in own]) & use.any(1)  # (2,)
        if not shown.any():
            continue
        apart = solver.solve(poses, views, config.gates_from(0.0), use, rendering=rendering).poses
        seen = np.repeat(shown[:, None], len(SHIFTS), axis=1)
        judged = solver.solve(apart, own, (), seen)
        uncovered, _ = uncovered_px(solver.scans, apart, own)
        fits = np.where(seen, score_px(judged) - config.uncovered_price * uncovered, 0.0).sum(0)
        out[c] = fits / max(float(judged.visible_px[seen].sum()) / len(SHIFTS), 1.0)
    return out


def _fast_frames(records: Mapping[int, FrameRecord]) -> list[int]:
    """Return frames all over the take, of every part the one in which the lower arch moves most between neighbours."""
    inner = [frame for frame in sorted(records) if frame - 1 in records and frame + 1 in records]
    if not inner:
        return []
    moved = [
        float(np.linalg.norm(records[f + 1].solution.centres[1] - records[f - 1].solution.centres[1])) for f in inner
    ]
    parts = np.array_split(np.arange(len(inner)), min(_LOOKED_AT, len(inner)))
    return [inner[max(part, key=lambda i: moved[i])] for part in parts]
