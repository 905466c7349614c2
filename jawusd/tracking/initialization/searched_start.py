"""Where a take's tracking begins if a search finds it: the frame, the poses there, and why there are none."""

from __future__ import annotations

import contextlib
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.finding import Finding
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.mixups import all_arches_exchanged, likely_mixup
from jawusd.tracking.initialization.start_causes import CLEAR_FIT, EXPLAINS, MOST_PICTURES, aligned, refuse_by_cause
from jawusd.tracking.initialization.start_search import Found, StartSearch

#: Frames surveyed: two seconds of reading, and every exercise of a usual take is met.
SURVEYED = 24
#: Frames on which the teeth are searched.
FRAMES_TRIED = 5


@dataclass(frozen=True, eq=False)
class Start:
    """Say where tracking begins."""

    frame: int  # reference camera frame
    poses: Array  # T_world_upper, T_world_lower, shape (2, 4, 4)
    notes: dict[str, object]  # how it was found, for the meta data of the tracks
    findings: tuple[Finding, ...] = ()  # what is doubtful about the scans
    T_anatomical_scan: Array = field(default_factory=lambda: np.eye(4))  # scan frame to (left, up, front) axes


def search_start(search: StartSearch, footage: Footage, doubts: Collection[str] = (), explain: bool = True) -> Start:
    """Find a frame on which both arches can be aligned, and their poses there.

    The first frame that fits beyond doubt is taken, or else the one that fits best. Where neither arch fits there as
    right poses do, but both fit beyond doubt with a mistake undone, that mistake is refused.

    Args:
        search: of the scans.
        footage: gives the masks.
        doubts: hints of mistakes that the scans themselves suggest.
        explain: whether to search for the mistake where no frame fits, which takes several times as long.

    Raises:
        TrackingError: no frame of those tried could be aligned; the message says what happened on each, or which
            mistake undone would let it succeed.
    """
    most = max(1, min(FRAMES_TRIED, MOST_PICTURES // len(footage.sources)))
    frames = footage.survey(None, SURVEYED).promising(most).tolist()
    failed: dict[int, str] = {}
    accused = set(doubts)
    best: tuple[int, Found] | None = None
    fits: dict[int, Array] = {}
    for frame in frames:
        try:
            found = search.at(footage, frame)
            fits[frame] = found.fits
            # Most masks being right, the poses are, and show which ones are not. Poor poses may accuse any.
            mixup = likely_mixup(footage, search.solver, found.poses, frame)
            if mixup is None:
                found = replace(found, poses=aligned(search, footage, found.poses, frame))
        except TrackingError as error:
            failed[frame] = error.message
            continue
        if mixup is not None:
            if found.fit >= CLEAR_FIT:
                raise mixup.refusal(frame)
            failed[frame] = mixup.finding
            accused.add(mixup.hint)
            continue
        if best is None or found.fit > best[1].fit:
            best = frame, found
        if found.fit >= CLEAR_FIT:
            break
    if best is None:
        tried = refuse_by_cause(search, footage, frames, fits, accused) if explain else ""
        raise TrackingError(
            f"there are no [bootstrap] picks, and searching the teeth failed on all {len(frames)} frames tried. "
            + " ".join([*(f"Frame {frame}: {message}." for frame, message in failed.items()), tried]),
            hint="Give [bootstrap] picks, three or more per row of teeth, each seen by two cameras; and check the "
            "masks, the calibration and the time offsets.",
        )
    frame, found = best
    if explain and found.fits.max() < EXPLAINS:
        refuse_by_cause(search, footage, [frame], {}, accused, beyond_doubt=True)
    _check_upright(search, footage, frame, found)
    notes = {"by": "search", "frame": frame, "worth_px": found.objective_px, "fit": found.fit}
    return Start(frame, found.poses, {**notes, "failed": {str(f): m for f, m in failed.items()}})


def search_around(search: StartSearch, footage: Footage, frame: int, poses: Array) -> Found:
    """Find the poses near given ones; if none fits beyond doubt, the best ones of all.

    Raises:
        TrackingError: no pair of poses that a jaw can take.
    """
    near = search.near(footage, frame, poses)
    if near.fit >= CLEAR_FIT:
        return near
    try:
        anywhere = search.at(footage, frame)
    except TrackingError:
        return near
    return max(near, anywhere, key=lambda found: found.objective_px)


def around_without_a_camera(
    search: StartSearch, footage: Footage, frame: int, poses: Array, found: Found
) -> tuple[str, Found] | None:
    """Return a camera whose masks bias the poses, and the poses without it; None if all masks agree.

    A camera is left out only if the others then fit beyond doubt.
    """
    if len(footage.sources) < 3:
        return None
    try:
        aligned(search, footage, found.poses, frame)
    except TrackingError:
        pass
    else:
        return None
    better = []
    for source in footage.sources:
        others = replace(footage, sources=[other for other in footage.sources if other is not source])
        with contextlib.suppress(TrackingError):
            near = search.near(others, frame, poses)
            if near.fit >= CLEAR_FIT:
                aligned(search, others, near.poses, frame)
                better.append((source.name, near))
    return max(better, key=lambda one: one[1].fit, default=None)


def _check_upright(search: StartSearch, footage: Footage, frame: int, found: Found) -> None:
    """Refuse masks that fit better with the arches exchanged: turned over, an upper arch resembles a lower one."""
    mixup = all_arches_exchanged(footage.sources)
    try:
        other = search.at(replace(footage, sources=mixup.sources), frame)
    except TrackingError:
        return
    if other.objective_px > found.objective_px:
        raise TrackingError(
            f"{mixup.finding}: {other.objective_px:.0f} px of contour fit after exchanging them, "
            f"{found.objective_px:.0f} px as they are named",
            frame=frame,
            hint=mixup.hint,
        )
