"""Search for the teeth in frames with masks in which they were lost."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, partial

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.initialization.first_frame import CLEAR_FIT
from jawusd.tracking.initialization.footage import Footage, MaskSurvey
from jawusd.tracking.initialization.start import SURVEYED
from jawusd.tracking.initialization.start_search import SearchResult, StartSearch

_TRIED = 3  # maximum number of frames of a lost stretch in which the teeth are searched for


class LostSearch:
    """Searches for both arches in the masks of frames in which a tracker lost them, without using its predictions."""

    def __init__(self, make_search: Callable[[], StartSearch], footage: Footage) -> None:
        # preparing a search takes time, and is rarely needed
        self._make_search, self._footage = make_search, footage

    def frames(self, lost: range, records: Mapping[int, FrameRecord]) -> list[int]:
        """Return the most promising frames of a lost stretch, those in which one arch was found first.

        Raises:
            TrackingError: no frame has masks of both arches in enough cameras.
            CaptureError: a mask cannot be read.
        """
        found = {frame: int(records[frame].found.sum()) for frame in lost}
        best = max(found.values())
        usual_px = self._usual_px(records)
        ranked = self._footage.survey((lost.start, lost.stop), SURVEYED).promising(len(lost), usual_px).tolist()
        ranked.sort(key=lambda frame: found[frame] != best)
        return ranked[:_TRIED]

    def at(self, frame: int, poses: Array, *, everywhere: bool) -> Array | None:
        """Return T_world_upper and T_world_lower in a frame, shape (2, 4, 4), or None if the teeth do not fit clearly.

        The teeth are searched for near the given poses (2, 4, 4) and, if `everywhere`, then everywhere, which takes
        longer. Raises CaptureError if a mask cannot be read.
        """
        near = self._clear(partial(self._search.near, self._footage, frame, poses))
        if near is None and everywhere:
            return self._clear(partial(self._search.at, self._footage, frame))
        return near

    @staticmethod
    def _clear(attempt: Callable[[], SearchResult]) -> Array | None:
        """Return the poses that a search finds, shape (2, 4, 4), or None if they do not fit clearly."""
        try:
            found = attempt()
        except TrackingError:
            return None
        return found.poses if found.fit >= CLEAR_FIT else None

    @cached_property
    def _search(self) -> StartSearch:
        return self._make_search()

    @cached_property
    def _survey(self) -> MaskSurvey:
        return self._footage.survey(None, SURVEYED)

    def _usual_px(self, records: Mapping[int, FrameRecord]) -> Array | None:
        """Return the largest areas of the masks in frames in which both arches were found [px], shape (2, C)."""
        frames = self._survey.frames.tolist()
        found = np.array([frame in records and bool(records[frame].found.all()) for frame in frames])
        return self._survey.areas_px[found].max(0) if found.any() else None
