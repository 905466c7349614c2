"""Follow the teeth through a take in both directions, judge poses by later ones, and search where teeth stay lost."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, MutableMapping
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import TrackingError

_SHORTEST_LOSS = 3  # minimum number of successive lost frames in which the teeth are searched for
_SAME_MM = 0.15  # distance of lower teeth below which two poses of a frame count as equal
# Distance of lower teeth above which two poses of a frame contradict one another, since they match different contours:
# in blurred images of fast jaws, correct poses were up to 0.6 mm apart.
_OTHER_MM = 1.0
# Second difference of the motion of lower teeth above which earlier frames are followed again [mm]. Speech and chewing
# reach 1 mm at 24 fps; a false positive costs the time of one frame.
_JUMP_MM = 0.8
_UNCONFIRMED_MM = 0.5  # minimum standard deviation of lower teeth in unconfirmed poses next to a loss


class Located(Protocol):
    """Poses of both arches in one video frame."""

    @property
    def found(self) -> Mask:
        """Whether each arch was found, shape (2,)."""

    @property
    def uncertain(self) -> bool:
        """Whether less of the contour fits than usual, so that the poses may be wrong."""


P = TypeVar("P", bound=Located)


@dataclass(frozen=True, eq=False)
class Begin(Generic[P]):
    """A frame from which a take is followed."""

    frame: int
    pose: P
    #: yields the poses of frames in tracking order, next to a given pose; each call starts with the colours of the
    #: first frame, also while an earlier call is in use
    follow: Callable[[range, P], Iterator[P]]


@dataclass(eq=False)
class TwoWays(Generic[P]):
    """Poses of a take, followed in both directions."""

    frames: range  # all frames
    places: Callable[[P], Array]  # returns points of the lower teeth in the frame of the upper teeth [mm], shape (N, 3)
    fit_px: Callable[[P], float]  # returns the length of the contour that fits a pose [px]
    margin: float = 1.0  # ratio of these lengths above which another pose replaces a trusted one
    #: second difference of the motion of the lower teeth above which earlier frames are followed again [mm]
    jump_mm: float = _JUMP_MM
    at_once: bool = False  # whether earlier frames are followed again at once, while their images are in memory
    patience: int = 1  # number of successive lost frames without a newly found arch after which tracking backwards ends
    #: called with the number of frames followed and the total
    progress: Callable[[int, int], None] = lambda done, total: None
    known: MutableMapping[int, P] = field(default_factory=dict)  # poses by frame

    def follow(self, begin: Begin[P]) -> None:
        """Follow the teeth from one frame to both ends, and backwards from frames before which poses may be wrong.

        Before a frame in which the tracker recovers, poses were wrong, although each is plausible on its own.
        """
        self.known[begin.frame] = begin.pose
        self.progress(1, len(self.frames))
        for way in both_ways(begin.frame, self.frames):
            for k, (frame, pose) in enumerate(zip(way, begin.follow(way, begin.pose), strict=True)):
                self.known[frame] = pose
                self.progress(len(self.known), len(self.frames))
                if self.at_once:
                    self._follow_back(begin, way, k)
            if not self.at_once:
                for k in range(len(way)):
                    self._follow_back(begin, way, k)

    def _follow_back(self, begin: Begin[P], way: range, k: int) -> None:
        """Follow the teeth from frame `way[k]` back to the first one if earlier poses may be wrong."""
        if self._is_turning_point(way, k):
            before = way[:k][::-1]
            self.replace(before, begin.follow(before, self.known[way[k]]))

    def recover(
        self,
        search: Callable[[range, P], Begin[P]],
        follow: Callable[[range, P], Iterator[P]] | None = None,
        fit: Callable[[P], float] | None = None,
    ) -> None:
        """Search for the teeth where they were lost for several frames; do nothing if they were never found.

        Poses that are found are followed in both directions, and discarded if they contradict known poses and agree
        with none.

        Args:
            search: searches in lost frames, given the nearest found pose. Raises TrackingError if it finds nothing.
            follow: as in `Begin`, with colours of a good frame: follows lost frames once more, often blurred or dark
                ones.
            fit: measure by which the better of both poses is chosen, comparable between colours; `fit_px` by default.
        """
        if not any(pose.found.all() for pose in self.known.values()):
            return
        vain: set[int] = set()
        while lost := next((s for s in lost_stretches(self.known, self.frames) if s.start not in vain), None):
            before = dict(self.known)
            try:
                begin = search(lost, nearest_found(self.known, lost))
            except TrackingError:
                vain.update(lost)
                continue
            if not begin.pose.found.all() or not self._joined(begin):
                self.known = before
                vain.update(lost)
            elif follow is not None:
                for way in both_ways(begin.frame, self.frames):
                    self.replace(way, follow(way, begin.pose), lost, fit)

    def _joined(self, begin: Begin[P]) -> bool:
        """Follow from a frame in both directions, and replace poses; return whether these agree with trusted ones."""
        self.known[begin.frame] = begin.pose
        ways = both_ways(begin.frame, self.frames)
        meetings = [self.replace(way, begin.follow(way, begin.pose)) for way in ways]
        return False not in meetings or True in meetings

    def replace(
        self,
        way: range,
        followed: Iterator[P],
        doubted: Container[int] = (),
        fit: Callable[[P], float] | None = None,
    ) -> bool | None:
        """Replace poses with others of the same frames, up to the first trusted pose that agrees or fits better.

        Args:
            way, followed: frames in tracking order, and other poses of these frames.
            doubted: frames whose poses are not trusted.
            fit: measure of the better pose; `fit_px` by default.

        Returns:
            True if a trusted pose is equal, or differs little and fits better; False if a trusted pose fits better and
                contradicts the other; None if an arch was lost and no other arch found, or if the take ended.
        """
        misses, fit = 0, fit or self.fit_px
        for frame, other in zip(way, followed, strict=False):
            old = self.known[frame]
            if not other.found.all() and not gained(other, old):
                misses += 1
                if old.found.all() or misses == self.patience:
                    return None
                continue
            misses = 0
            if trust(old) == 2 and frame not in doubted:
                apart_mm = self._apart_mm(other, old)
                if apart_mm < _SAME_MM or fit(other) <= self.margin * fit(old):
                    return apart_mm < _OTHER_MM
            self.known[frame] = max(other, old, key=lambda pose: (pose.found.sum(), fit(pose)))
        return None

    def unconfirmed(self, follow: Callable[[range, P], Iterator[P]]) -> dict[int, float]:
        """Return minimum standard deviations of the lower teeth [mm] near lost frames and jumps, by frame.

        Just before a tracker loses the teeth, or after it has found them, a pose may be wrong although it fits. The
        take is therefore followed, as in `Begin`, away from each loss until a trusted pose is confirmed. Up to that
        frame, the standard deviation is at least the distance between the known and the new pose; next to the loss, it
        is also at least the second difference of the motion.

        Where the jaw still accelerates implausibly, the take is followed from each side into the other one; where the
        poses of both sides fit about equally well, neither is confirmed.
        """
        least_mm: dict[int, float] = {}
        for lost in lost_stretches(self.known, self.frames, shortest=1):
            for beside, ahead in ((lost.start - 1, 1), (lost.stop, 0)):
                if beside in self.frames:
                    for frame, away_mm in self._doubts(beside, both_ways(beside, self.frames)[ahead], follow):
                        least_mm[frame] = max(away_mm, least_mm.get(frame, _UNCONFIRMED_MM))
        for before in self._jumps():
            for side, ahead in ((before + 1, 1), (before, 0)):
                way = both_ways(side, self.frames)[ahead]
                for frame, away_mm in self._unlike(way, follow(way, self.known[side])):
                    least_mm[frame] = max(away_mm, least_mm.get(frame, _UNCONFIRMED_MM))
        return least_mm

    def _jumps(self) -> list[int]:
        """Return the frames after which the jaw accelerates implausibly although both arches were found."""
        runs = [range(frame - 1, frame + 2) for frame in self.frames[1:-1]]
        found = [run for run in runs if all(self.known[frame].found.all() for frame in run)]
        return [run[1] for run in found if self._bend_mm(run) > self.jump_mm]

    def _doubts(
        self, beside: int, way: range, follow: Callable[[range, P], Iterator[P]]
    ) -> Iterator[tuple[int, float]]:
        """Yield the frames from a loss to the first confirmed pose, and how far their poses may be off [mm]."""
        near = range(beside, beside + 3 * way.step, way.step)
        bent = all(frame in self.frames and self.known[frame].found.all() for frame in near)
        yield beside, self._bend_mm(near) if bent else 0.0
        yield from self._unlike(way, follow(way, self.known[beside]), least_trust=2)

    def _unlike(self, way: range, followed: Iterator[P], least_trust: int = 0) -> Iterator[tuple[int, float]]:
        """Yield the frames up to the first pose that is trusted and confirmed, and how far the poses are apart [mm]."""
        for frame, other in zip(way, followed, strict=False):
            old, away_mm = self.known[frame], self._apart_mm(other, self.known[frame])
            clear = away_mm < _SAME_MM or self.fit_px(old) > self.margin * self.fit_px(other)
            if not (old.found.all() and other.found.all()) or (trust(old) >= least_trust and clear):
                return
            yield frame, away_mm

    def _is_turning_point(self, way: range, k: int) -> bool:
        """Return whether frame `way[k]` is trusted more than the one before, or the jaw accelerates implausibly."""
        if k == 0:
            return False
        pose, last = self.known[way[k]], self.known[way[k - 1]]
        return trust(pose) > trust(last) or (k > 1 and self._bend_mm(way[k - 2 : k + 1]) > self.jump_mm)

    def _apart_mm(self, one: P, other: P) -> float:
        """Return the mean distance between the lower teeth at two poses of a frame [mm]."""
        return float(np.linalg.norm(self.places(one) - self.places(other), axis=-1).mean())

    def _bend_mm(self, frames: range) -> float:
        """Return the mean second difference of the motion of the lower teeth in three successive frames [mm]."""
        places = np.stack([self.places(self.known[frame]) for frame in frames])
        return float(np.linalg.norm(np.diff(places, 2, axis=0), axis=-1).mean())


def trust(pose: Located) -> int:
    """Return the trust in a pose: 0 if the teeth were not found, 1 if it is uncertain, 2 otherwise."""
    return int(pose.found.all()) * (1 if pose.uncertain else 2)


def gained(pose: Located, other: Located) -> bool:
    """Return whether an arch was found that was not found with another pose."""
    return bool((pose.found & ~other.found).any())


def lost_stretches(known: Mapping[int, P], frames: range, shortest: int = _SHORTEST_LOSS) -> list[range]:
    """Return the runs of successive frames on which an arch was not found, except very short ones."""
    lost = np.array([not known[frame].found.all() for frame in frames])
    return [frames[first:stop] for first, stop in true_runs(lost) if stop - first >= shortest]


def true_runs(mask: Mask) -> list[tuple[int, int]]:
    """Return the first index of every run of true values, shape (N,), and the index after its last one."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(first, stop) for first, stop in edges.reshape(-1, 2).tolist()]


def nearest_found(known: Mapping[int, P], lost: range) -> P:
    """Return the poses of the frame nearest to a run of lost frames, among the frames with both arches found."""
    return known[min((frame for frame in known if known[frame].found.all()), key=lambda frame: abs(frame - lost.start))]


def both_ways(frame: int, frames: range) -> tuple[range, range]:
    """Return the frames after and before a frame, each in the order in which they are tracked."""
    return range(frame + 1, frames.stop), range(frame - 1, frames.start - 1, -1)
