"""Start a take without picks: choose frames that show the teeth well and search their poses there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jawusd.errors import CaptureError, TrackingError
from jawusd.geometry import transform_point
from jawusd.geometry.arrays import Array
from jawusd.tracking.first import first_record
from jawusd.tracking.footage import Footage, Start
from jawusd.tracking.mixups import all_rows_exchanged, likely_mixup, possible_mixups
from jawusd.tracking.start_search import Found, StartSearch

_ROWS = (0, 1)
_SURVEYED = 24  # frames looked at: two seconds of reading, and every exercise of a usual take is met
_FRAMES_TRIED = 5
_MIXUPS_TRIED = 12  # all of them with four cameras; every one costs a search
# Fit that leaves no doubt [-]. Wrong poses of a hundred searches stayed below 0.1 in one of the rows, right ones
# exceed 0.35 where much of the teeth shows, and 0.1 with lips nearly closed or cameras 0.1 degrees off.
_CLEAR_FIT = 0.3


def search_start(search: StartSearch, footage: Footage) -> Start:
    """Find a frame on which both rows of teeth can be aligned, and their poses there.

    The first frame that fits beyond doubt is taken, or else the one that fits best.

    Raises:
        TrackingError: no frame of those tried could be aligned; the message says what happened on each, or which
            exchange of masks would let it succeed.
    """
    frames = footage.survey(None, _SURVEYED).promising(_FRAMES_TRIED).tolist()
    failed: dict[int, str] = {}
    accused: set[str] = set()
    best: tuple[int, Found] | None = None
    for frame in frames:
        try:
            found = search.at(footage, frame)
            # Most masks being right, the poses are, and show which ones are not. Poor poses may accuse any.
            mixup = likely_mixup(footage, search.solver, found.poses, frame)
            if mixup is None:
                found = replace(found, poses=_aligned(search, footage, found.poses, frame))
        except TrackingError as error:
            failed[frame] = error.message.removeprefix(f"frame {frame}: ")
            continue
        if mixup is not None:
            if found.fit >= _CLEAR_FIT:
                raise mixup.refusal(frame)
            failed[frame] = mixup.finding
            accused.add(mixup.hint)
            continue
        if best is None or found.fit > best[1].fit:
            best = frame, found
        if found.fit >= _CLEAR_FIT:
            break
    if best is None:
        _name_mixup(search, footage, frames[0], accused)
        raise TrackingError(
            f"there are no [bootstrap] picks, and searching the teeth failed on all {len(frames)} frames tried. "
            + " ".join(f"Frame {frame}: {message}." for frame, message in failed.items()),
            hint="Give [bootstrap] picks, three or more per row of teeth, each seen by two cameras; and check the "
            "masks, the calibration and the time offsets.",
        )
    frame, found = best
    _check_upright(search, footage, frame, found)
    notes = {"by": "search", "frame": frame, "worth_px": found.worth_px, "fit": found.fit}
    return Start(frame, found.poses, {**notes, "failed": {str(f): m for f, m in failed.items()}})


def search_around(search: StartSearch, footage: Footage, frame: int, poses: Array) -> Found:
    """Find the poses near given ones; if none fits beyond doubt, the best ones of all.

    Raises:
        TrackingError: no pair of poses that a jaw can take.
    """
    near = search.near(footage, frame, poses)
    if near.fit >= _CLEAR_FIT:
        return near
    try:
        anywhere = search.at(footage, frame)
    except TrackingError:
        return near
    return max(near, anywhere, key=lambda found: found.worth_px)


def _aligned(search: StartSearch, footage: Footage, poses: Array, frame: int) -> Array:
    """Return the poses as aligned by the solver if they pass the checks of a first frame, shape (2, 4, 4)."""
    solver = search.solver
    centre = np.mean([transform_point(poses[r], solver.scans[r].centre) for r in _ROWS], axis=0)
    with footage.views(centre, solver.config.working_px_per_mm) as masks:
        return first_record(solver, solver.config, poses, masks, frame).solution.poses


def _check_upright(search: StartSearch, footage: Footage, frame: int, found: Found) -> None:
    """Refuse masks that fit better with the rows exchanged everywhere: turned over, an upper row resembles a lower."""
    mixup = all_rows_exchanged(footage.sources)
    try:
        other = search.at(replace(footage, sources=mixup.sources), frame)
    except TrackingError:
        return
    if other.worth_px > found.worth_px:
        raise TrackingError(
            f"frame {frame}: {mixup.finding}: {other.worth_px:.0f} px of contour fit after exchanging them, "
            f"{found.worth_px:.0f} px as they are named",
            hint=mixup.hint,
        )


def _name_mixup(search: StartSearch, footage: Footage, frame: int, accused: set[str]) -> None:
    """Refuse masks with which the search succeeds after an exchange, those first that were accused by their hints."""
    explained: list[tuple[float, TrackingError]] = []
    mixups = sorted(possible_mixups(footage.sources), key=lambda m: m.hint not in accused)
    for mixup in mixups[:_MIXUPS_TRIED]:
        try:
            righted = replace(footage, sources=mixup.sources)
            found = search.at(righted, frame)
            _aligned(search, righted, found.poses, frame)
        except (TrackingError, CaptureError):
            continue  # this exchange explains nothing
        why = f"{mixup.finding}: the teeth are found only after exchanging them"
        explained.append((found.fit, replace(mixup, finding=why).refusal(frame)))
    if explained:
        raise max(explained, key=lambda e: e[0])[1]
