"""Search for the teeth in video frames with a visible gap between the upper and lower arch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.capture import Bootstrap
from jawusd.geometry import Camera, se3_inverse
from jawusd.media.masks import FrameMasks
from jawusd.pipeline.state import Progress
from jawusd.segmentation.picture import ColourFootage, Pictures
from jawusd.segmentation.rows import Rows, tooth_rows

# Number of frames per part of the take, maximum stride of the search [frames], and minimum number of frames searched in
# a long part.
_PART, _EVERY, _FEWEST = 240, 8, 8
# Number of starts tried per part of the take for each of the four camera orientations.
_TRIED = 3
# Maximum number of starts tried. If no start from three parts of the take fits, the scans, the cameras or the detection
# are wrong. The limit is a number, not a duration, so that results do not depend on the machine.
_MOST_TRIED = 36
# Maximum fraction of the dividing line between the arches that may cross teeth for the arches to count as apart. In 64
# images of eight mouths with smaller fractions, the arches were always separated correctly.
_MOST_BRIDGED = 0.1
# Minimum length of the head's unit up vector projected to the image plane; a shorter one does not determine how the
# image is turned.
_SHORTEST_UP = 0.5
# Fractions of the contour in sight that must match the colours, with several cameras and with one: minimum for a
# searched start, and value at which the search ends; and minimum for picks. See docs/explanation/constants.md.
_LEAST_FIT, _CLEAR_FIT, _LEAST_PICKED_FIT = (0.38, 0.4), (0.5, 0.6), 0.3
# With several cameras, fraction from which no other start of the same orientation is tried: arches that are shifted by
# a tooth fit images from the sides up to 0.65.
_CERTAIN_FIT = 0.7

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class StartInFrame(Protocol[T_co]):
    """An estimate of the pose in one frame; see `tracking.region.picture_start`."""

    def at(
        self, masks: Sequence[FrameMasks], cameras: Mapping[str, Camera], offsets: Mapping[str, int], frame: int
    ) -> T_co | None:
        """Return the most likely pose in a frame with rough masks, or None if there is none or cameras are too few."""

    def picked(self, bootstrap: Bootstrap, cameras: Mapping[str, Camera]) -> T_co:
        """Return the pose from picks in two or more cameras."""


@dataclass(frozen=True, eq=False)
class Start(Generic[T]):
    """A start of tracking: frame, pose, fraction of the contour in sight that fits, and how it was found."""

    frame: int
    pose: T
    fit: float
    by: str


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Arches detected in all cameras' images of one frame."""

    frame: int
    rows: Mapping[str, Rows]

    @property
    def rank(self) -> tuple[int, float]:
        """Sort key, smaller for more promising frames: more cameras, then more visible teeth of both arches.

        With one camera, in 27 views of 13 rendered subjects, 25 starts in the first frame by this key are right, and 14
        of 20 in the next ones.
        """
        smaller = [(rows.masks > 127).mean(axis=(1, 2)).min() for rows in self.rows.values()]
        return -len(self.rows), -float(sum(smaller))


@dataclass(frozen=True, eq=False)
class PictureSearch(Generic[T]):
    """A search for the teeth in footage without masks, everywhere or at picks."""

    footage: ColourFootage  # the images of the cameras that have a video
    cameras: Mapping[str, Camera]  # the calibrated cameras that have a video, by name
    offsets: Mapping[str, int]  # frame offset by camera
    near: StartInFrame[T]  # estimates the pose in a frame from rough masks or picks
    #: refines a pose in a frame; returns the pose and the fraction (0 .. 1) of the contour in sight that fits
    judged: Callable[[int, T], tuple[T, float]]

    def run(self, frames: range, progress: Progress, up_world: Array | None = None) -> Start[T]:
        """Return the first start that fits certainly, or else the best one among some frames.

        A start of several cameras that fits clearly, but not certainly, is compared with those in the other frames of
        its orientation.

        Without `up_world`, the up direction of the head in the world (3,), four camera orientations are tried and, if
        no start of several cameras fits clearly, starts of single cameras in the frame with the best one. If it is
        known from other frames, only one orientation is tried and, with several cameras, the first start that fits is
        returned, because it can be compared with those frames.

        Raises:
            TrackingError: no start fits.
            CaptureError: an image cannot be decoded.
        """
        single = len(self.cameras) == 1
        least = least_fit(len(self.cameras))
        clear = _CLEAR_FIT[single] if single or up_world is None else least
        certain = clear if single or up_world is not None else _CERTAIN_FIT
        hypotheses = orientations(self.cameras) if up_world is None else [upright_turns(self.cameras, up_world)]
        best: Start[T] | None = None
        nearest: _Candidate | None = None
        tried: list[int] = []
        seen = 0
        for part in (frames[k : k + _PART] for k in range(0, len(frames), _PART)):
            seen += len(part)
            for turns in hypotheses:
                apart = self._candidates(part, turns, progress)
                candidates = sorted(apart, key=lambda candidate: candidate.rank)[:_TRIED]
                for done, candidate in enumerate(candidates, start=1):
                    tried.append(candidate.frame)
                    found = self._at(candidate)
                    progress("try starts", done, len(candidates))
                    if found is not None and (best is None or found.fit > best.fit):
                        best, nearest = found, candidate
                    if best is not None and best.fit >= certain:
                        return best
                if best is not None and best.fit >= clear:
                    return best
            if len(tried) >= _MOST_TRIED or (best is not None and best.fit >= least):
                break
        if up_world is None:
            best = max(filter(None, [best, *self._alone(nearest)]), key=lambda start: start.fit, default=None)
        if best is not None and best.fit >= least:
            return best
        raise TrackingError(
            _describe_failure(tried, best, least, frames[seen:]),
            hint="Check that the scans or the rig belong to this subject. Otherwise, film with the mouth open "
            "so that both arches are visible, pick teeth in two cameras ([bootstrap]), or draw masks.",
        )

    def _candidates(self, part: range, turns: Mapping[str, int], progress: Progress) -> list[_Candidate]:
        """Return the frames of a part of the take in which the arches are visibly apart in enough cameras."""
        out, chosen = [], part[:: min(_EVERY, max(1, len(part) // _FEWEST))]
        for done, (frame, pictures) in enumerate(self.footage.walk(chosen), start=1):
            apart = arches_apart(pictures, turns)
            if len(apart) >= min(2, len(self.cameras)):
                out.append(_Candidate(frame, apart))
            progress("search", done, len(chosen))
        return out

    def _at(self, candidate: _Candidate) -> Start[T] | None:
        masks = rough_masks(candidate.rows, self.offsets, candidate.frame)
        near = self.near.at(masks, self.cameras, self.offsets, candidate.frame)
        return None if near is None else Start(candidate.frame, *self.judged(candidate.frame, near), "search")

    def _alone(self, candidate: _Candidate | None) -> Iterator[Start[T] | None]:
        """Yield starts that the masks of single cameras give, judged in all cameras."""
        if candidate is not None and len(candidate.rows) > 1:
            for name, rows in candidate.rows.items():
                yield self._at(replace(candidate, rows={name: rows}))

    def picked(self, picks: Bootstrap, frames: range) -> Start[T]:
        """Return a start from picks in the frames to be tracked.

        Raises TrackingError if the picks lie outside these frames, are inconsistent or do not match the images.
        """
        if picks.frame not in frames:
            raise picks_outside(picks.frame, frames)
        pose, fit = self.judged(picks.frame, self.near.picked(picks, self.cameras))
        if fit < _LEAST_PICKED_FIT:
            raise TrackingError(
                f"the picks do not match the images: {fit:.0%} of the contour in sight agrees with the image "
                f"colours; at least {_LEAST_PICKED_FIT:.0%} is needed",
                frame=picks.frame,
                hint="Check the picks, and that scans, rig and calibration belong to this subject and these cameras.",
            )
        return Start(picks.frame, pose, fit, "picks")


def least_fit(cameras: int) -> float:
    """Return the minimum fraction of the contour in sight that must fit for a start with that many cameras."""
    return _LEAST_FIT[cameras == 1]


def upright_turns(cameras: Mapping[str, Camera], up_world: Array) -> dict[str, int]:
    """Return the number of counter-clockwise quarter turns that make each camera's image upright.

    Cameras that look along `up_world`, the up direction of the head in the world (3,), are left out.
    """
    turns = {}
    for name, camera in cameras.items():
        x, y, _ = camera.T_cam_world[:3, :3] @ up_world
        if np.hypot(x, y) > _SHORTEST_UP:
            turns[name] = round(np.arctan2(x, -y) / (np.pi / 2)) % 4
    return turns


def orientations(cameras: Mapping[str, Camera]) -> list[dict[str, int]]:
    """Return four hypotheses of how the cameras are turned about their optical axes, as in `upright_turns`.

    By the calibration, only the turn of the first camera is unknown. The hypothesis with the most upright cameras comes
    first.
    """
    T_world_first = se3_inverse(next(iter(cameras.values())).T_cam_world)
    ups = [np.array([np.sin(angle), -np.cos(angle), 0.0]) for angle in np.pi / 2 * np.array([0, 1, 3, 2])]
    found = [upright_turns(cameras, T_world_first[:3, :3] @ up) for up in ups]
    return sorted(found, key=lambda turns: -sum(turn == 0 for turn in turns.values()))


def arches_apart(pictures: Pictures, turns: Mapping[str, int]) -> dict[str, Rows]:
    """Return the arches in the images in which they are visibly apart, by camera; `turns` as in `upright_turns`."""
    images = {name: image for name, image in pictures.items() if image is not None and name in turns}
    rows = {name: tooth_rows(np.asarray(image), turns[name]) for name, image in images.items()}
    return {name: row for name, row in rows.items() if row is not None and row.bridged <= _MOST_BRIDGED}


def _describe_failure(tried: Sequence[int], best: Start[T] | None, least: float, left: range) -> str:
    """Return a message about a failed search: the frames tried, the best fit, and the frames not searched."""
    frames = sorted(set(tried))
    found = f"the teeth were not found in {len(frames)} frames with a visible gap between the arches"
    if frames:
        found += f" ({', '.join(map(str, frames))})"
    if best is not None:
        found += f"; at best {best.fit:.0%} of the contour in sight fits; at least {least:.0%} is needed"
    if left:
        found += f"; frames {left[0]} to {left[-1]} were not searched, because at most {_MOST_TRIED} starts are tried"
    return found


def rough_masks(rows: Mapping[str, Rows], offsets: Mapping[str, int], frame: int) -> list[FrameMasks]:
    """Return the arches that were detected in the images of a frame as masks, by camera."""
    return [FrameMasks(name, frame - offsets[name], found.masks) for name, found in rows.items()]


def picks_outside(frame: int, frames: range) -> TrackingError:
    """Return the error for picks on a frame outside the range to be tracked."""
    return TrackingError(f"bootstrap.frame is {frame}; frames run from {frames[0]} to {frames[-1]}")
