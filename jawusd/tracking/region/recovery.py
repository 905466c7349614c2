"""Search for teeth that stay lost, and follow them forwards and backwards until known poses are met."""

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
        """Arches found, shape (2,)."""


P = TypeVar("P", bound=Located)


def recover(known: dict[int, P], frames: range, again: Callable[[range], Mapping[int, P] | None]) -> None:
    """Update poses where the teeth were lost for several frames; without any found poses, nothing is done.

    Args:
        known: poses by frame, updated in place.
        frames: all frames.
        again: searches in lost frames; returns the poses of all frames, or None if it found nothing.
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
    """Return the poses of the frame nearest to a lost run among those with both arches found."""
    return known[min((frame for frame in known if known[frame].found.all()), key=lambda frame: abs(frame - lost.start))]


def both_ways(frame: int, frames: range) -> tuple[range, range]:
    """Return the frames after and before a frame, in the order in which they are followed."""
    return range(frame + 1, frames.stop), range(frame - 1, frames.start - 1, -1)


def replace_poses(
    way: range,
    followed: Iterator[P],
    known: dict[int, P],
    same: Callable[[P, P], bool],
    better: Callable[[P, P], bool],
) -> bool | None:
    """Replace poses by others of the same frames, as long as the two differ and the latter are better.

    Where a tracker recovers or loses the teeth, its poses were wrong before, although each is plausible by itself.

    Args:
        way: frames in tracking order.
        followed: other poses of these frames.
        known: poses by frame, updated in place.
        same, better: compare another pose with a known one.

    Returns:
        True if an equal known pose was met, False if a different one that is not worse, None if the arches were lost
        or the take ended.
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
    """Return whether poses followed both ways, as by `replace_poses`, contradict known poses and agree with none."""
    return False in meetings and True not in meetings
