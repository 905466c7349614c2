"""Which frames of a take fit their masks worst: one rule for the report and the viewer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.formats.tracks import Tracks

_APART_S = 0.5  # neighbours show the same trouble


def used_coverage(tracks: Tracks) -> Array:
    """Return the share of each mask left uncovered, NaN where it is missing or took no part, shape (F, 2, C)."""
    return np.where(tracks.masks_used, tracks.coverage_error, np.nan)


def uncovered_percent(tracks: Tracks) -> Array:
    """Return the mask area left uncovered per frame and arch [%], mean over the masks used, shape (F, 2); NaN: none."""
    value = used_coverage(tracks)
    known = np.isfinite(value)
    total = np.where(known, value, 0.0).sum(axis=2)
    return 100 * np.divide(total, known.sum(axis=2), out=np.full(total.shape, np.nan), where=known.any(axis=2))


def worst_frames(
    badness: Array, frames: NDArray[np.int64], fps: float, most: int, taken: Sequence[int] = ()
) -> list[int]:
    """Return indices of the frames with the highest badness, the worst first, no two within half a second.

    Args:
        badness: shape (F,); frames with NaN are never chosen.
        frames: frame numbers, shape (F,).
        most: how many at most.
        taken: indices of frames chosen before, to keep away from.
    """
    apart = max(round(_APART_S * fps), 1)
    found: list[int] = []
    for index in np.argsort(-badness, kind="stable").tolist():
        if len(found) == most or np.isnan(badness[index]):
            break
        if all(abs(int(frames[index] - frames[other])) >= apart for other in (*taken, *found)):
            found.append(index)
    return found
