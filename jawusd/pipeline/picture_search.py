"""Search where the teeth are in footage, on frames on which both rows of teeth are apart."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from jawusd.base.errors import TrackingError
from jawusd.formats.capture import CameraSource, Capture
from jawusd.pipeline.segment_record import with_masks
from jawusd.pipeline.state import Progress

if TYPE_CHECKING:
    from jawusd.segmentation.picture import ColourFootage
    from jawusd.segmentation.rows import Rows

# Frames looked at for rows that are apart: every so-many-th, in parts of the take; starts tried in a part.
_EVERY, _PART, _TRIED = 8, 240, 4
# Starts tried in all. One takes some ten seconds of processor time; where six parts of a take in which rows seem apart
# have none that fits, scans, cameras or what was taken for teeth are wrong, and the other parts are like them. Work is
# counted, not time: what is found does not depend on the machine.
_MOST_TRIED = 24
#: How much rows of teeth may be bridged to count as apart: of 64 pictures of eight mouths, those below were all parted
#: rightly.
MOST_BRIDGED = 0.1
#: Share of the contour in sight that fits colours, below which a start is none: of 20 starts found in one take, all but
#: one within half a millimetre, it was 0.19 to 0.48. From the others on, with several cameras and with one, whose depth
#: may be wrong, it is taken at once.
LEAST_FIT, _CLEAR_FIT, _CLEAR_FIT_SINGLE = 0.15, 0.25, 0.4

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Begin(Generic[T]):
    """Say where to begin, how much of the contour fits there, and how it was found."""

    frame: int
    pose: T
    fit: float
    by: str


@dataclass(frozen=True, eq=False)
class _Look:
    """Hold the rows of teeth that the cameras show on a frame."""

    frame: int
    rows: Mapping[str, Rows]

    @property
    def bridged(self) -> float:
        """The worst camera's share of line between the rows that is no gap."""
        return max(rows.bridged for rows in self.rows.values())


@dataclass(frozen=True, eq=False)
class PictureSearch(Generic[T]):
    """Search the teeth.

    Attributes:
        capture, footage: pictures of the cameras that have a video.
        cameras: how many those are.
        near: returns a pose on a frame by cameras with rough masks, None if there is none.
        judged: returns a better pose near one on a frame, and the share of the contour in sight that fits, 0 .. 1.
    """

    capture: Capture
    footage: ColourFootage
    cameras: int
    near: Callable[[Sequence[CameraSource], int], T | None]
    judged: Callable[[int, T], tuple[T, float]]

    def run(self, frames: range, progress: Progress) -> Begin[T]:
        """Return the first start that fits clearly, or the best one of a part of the take.

        Raises:
            TrackingError: none of those tried fits.
            CaptureError: a picture cannot be decoded.
        """
        best: Begin[T] | None = None
        tried: list[int] = []
        seen = 0
        for part in (frames[k : k + _PART] for k in range(0, len(frames), _PART)):
            seen += len(part)
            looks = sorted(self._looks(part, progress), key=lambda look: look.bridged)
            for look in looks[:_TRIED]:
                tried.append(look.frame)
                found = self._at(look)
                if found is not None and (best is None or found.fit > best.fit):
                    best = found
                if best is not None and best.fit >= (_CLEAR_FIT if self.cameras > 1 else _CLEAR_FIT_SINGLE):
                    return best
            if best is not None and best.fit >= LEAST_FIT:
                return best
            if len(tried) >= _MOST_TRIED:
                break
        raise TrackingError(
            _tried(tried, best, frames[seen:]),
            hint="Check that scans, or rig, are of this person; let the footage show both rows of teeth apart and "
            "upright for a moment, pick teeth in two cameras ([bootstrap]), or draw masks.",
        )

    def _looks(self, part: range, progress: Progress) -> list[_Look]:
        """Return the frames of a part of the take on which enough cameras show the rows apart."""
        from jawusd.segmentation.rows import tooth_rows

        out, chosen = [], part[::_EVERY]
        for done, (frame, pictures) in enumerate(self.footage.walk(chosen), start=1):
            rows = {name: tooth_rows(np.asarray(image)) for name, image in pictures.items() if image is not None}
            apart = {name: row for name, row in rows.items() if row is not None and row.bridged <= MOST_BRIDGED}
            if len(apart) >= min(2, self.cameras):
                out.append(_Look(frame, apart))
            progress("start", done, len(chosen))
        return out

    def _at(self, look: _Look) -> Begin[T] | None:
        known = {name: self.footage.number(name, look.frame) for name in look.rows}
        numbers = {name: number for name, number in known.items() if number is not None}
        with tempfile.TemporaryDirectory() as folder:
            masked = masked_cameras(self.capture, look.rows, numbers, Path(folder))
            near = self.near(masked, look.frame)
        return None if near is None else Begin(look.frame, *self.judged(look.frame, near), "search")


def _tried(tried: Sequence[int], best: Begin[T] | None, left: range) -> str:
    """Return on which frames starts were tried, what came of it, and which frames are left."""
    found = f"the teeth were not found on {len(tried)} frames that show both rows apart"
    if tried:
        found += f" ({', '.join(map(str, sorted(tried)))})"
    if best is not None:
        found += f"; at best {best.fit:.0%} of the contour in sight fits, {LEAST_FIT:.0%} is needed"
    if left:
        found += f"; frames {left[0]} to {left[-1]} were not searched, as {_MOST_TRIED} are tried at most"
    return found


def masked_cameras(
    capture: Capture, rows: Mapping[str, Rows], numbers: Mapping[str, int], folder: Path
) -> list[CameraSource]:
    """Return cameras with rows of teeth as masks, which are written to a folder under the cameras' own numbers.

    Raises:
        OutputError: a mask cannot be written.
    """
    from jawusd.segmentation.files import ARCHES, mask_path, write_mask

    for name, found in rows.items():
        for arch, mask in zip(ARCHES, found.masks, strict=True):
            write_mask(mask_path(folder, name, arch, numbers[name]), mask)
    return [camera for camera in with_masks(capture, folder).cameras if camera.name in rows]


def unseen_picks(frame: int, fit: float, least: float = LEAST_FIT) -> TrackingError:
    """Return the error that picks deserve on a frame where too small a share of the contour in sight fits, 0 .. 1."""
    return TrackingError(
        f"the teeth are not seen where they are picked: {fit:.0%} of the contour in sight fits the colours, at least "
        f"{least:.0%} is needed",
        frame=frame,
        hint="Check the picks, and that scans, rig and calibration are those of this person and these cameras.",
    )


def outside(frame: int, frames: range) -> TrackingError:
    """Return the error that picks on a frame outside of those to be tracked deserve."""
    return TrackingError(f"bootstrap.frame is {frame}, frames run from {frames[0]} to {frames[-1]}")
