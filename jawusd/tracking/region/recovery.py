"""Search for teeth that stay lost, and track them forwards and backwards until their poses agree with known ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Protocol, TypeVar

import numpy as np

from jawusd.base.arrays import Mask

_SHORTEST_LOSS = 3  # minimum number of successive lost frames in which the teeth are searched for


class Located(Protocol):
    """Poses of both arches in one video frame."""

    @property
    def found(self) -> Mask:
        """Whether each arch was found, shape (2,)."""


P = TypeVar("P", bound=Located)


def recover(known: dict[int, P], frames: range, again: Callable[[range], Mapping[int, P] | None]) -> None:
    """Update poses where the teeth were lost for several frames; without any found poses, nothing is done.

    Args:
        known: poses by frame, updated in place.
        frames: all frames.
        again: function that searches in lost frames; returns the poses of all frames, or None if nothing was found.
    """
    if not any(pose.found.all() for pose in known.values()):
        return
    vain: set[int] = set()
    while lost := next((s for s in lost_stretches(known, frames) if s.start not in vain), None):
        found = again(lost)
        if found is None:
            vain.update(lost)
        else:
            known.update(found)


def lost_stretches(known: Mapping[int, P], frames: range) -> list[range]:
    """Return the runs of successive frames on which an arch was not found, except very short ones."""
    found = np.array([known[frame].found.all() for frame in frames])
    edges = np.flatnonzero(np.diff(np.concatenate([[True], found, [True]]).astype(int))).reshape(-1, 2).tolist()
    return [frames[first:stop] for first, stop in edges if stop - first >= _SHORTEST_LOSS]


def nearest_found(known: Mapping[int, P], lost: range) -> P:
    """Return the poses of the frame nearest to a run of lost frames, among the frames with both arches found."""
    return known[min((frame for frame in known if known[frame].found.all()), key=lambda frame: abs(frame - lost.start))]


def both_ways(frame: int, frames: range) -> tuple[range, range]:
    """Return the frames after and before a frame, each in the order in which they are tracked."""
    return range(frame + 1, frames.stop), range(frame - 1, frames.start - 1, -1)


def replace_poses(
    way: range,
    followed: Iterator[P],
    known: dict[int, P],
    same: Callable[[P, P], bool],
    better: Callable[[P, P], bool],
) -> bool | None:
    """Replace known poses by newly tracked ones, frame by frame, while the new ones differ and are better.

    Before a tracker recovers or loses the teeth, its poses may be wrong although each is plausible by itself.

    Args:
        way: frames in tracking order.
        followed: newly tracked poses of these frames.
        known: poses by frame, updated in place.
        same, better: functions that compare a new pose with a known one.

    Returns:
        True if a known pose agrees with the new one, False if a known pose differs and is not worse, None if the arches
        were lost or the take ended first.
    """
    for frame, other in zip(way, followed, strict=False):
        if not other.found.all():
            return None
        if known[frame].found.all():
            if same(other, known[frame]):
                return True
            if not better(other, known[frame]):
                return False
        known[frame] = other
    return None


def contradicts(meetings: list[bool | None]) -> bool:
    """Return whether the results of `replace_poses` in both directions include a contradiction but no agreement."""
    return False in meetings and True not in meetings
