"""The colour pictures of all cameras, instant after instant."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeAlias

from jawusd.media.clip import Clip
from jawusd.media.pixels import ColourPicture

_CHUNK = 16  # instants held at once when going backwards: 50 MB per full HD camera

Pictures: TypeAlias = "dict[str, ColourPicture | None]"
_Frames = range  # inside the class below, `range` is its method


class ColourFootage:
    """Read the pictures of one instant in all cameras, in either direction."""

    def __init__(self, videos: Mapping[str, Clip], offsets: Mapping[str, int]) -> None:
        """Take the videos and, by the same names, reference frame minus own frame number."""
        self._videos, self._offsets = dict(videos), dict(offsets)

    def own(self, name: str, frame: int) -> int | None:
        """Return the picture of a camera at a frame of the reference camera; None where it has none."""
        return self._videos[name].timeline.picture(frame - self._offsets[name])

    def number(self, name: str, frame: int) -> int | None:
        """Return the number in its files of a camera's picture at a frame of the reference camera, as masks have it."""
        return self._videos[name].timeline.number(frame - self._offsets[name])

    def range(self) -> tuple[int, int]:
        """Return the first frame that two cameras show, and one past the last."""
        starts = sorted(self._offsets[name] for name in self._videos)
        stops = sorted(self._offsets[name] + video.timeline.count for name, video in self._videos.items())
        return max(0, starts[min(1, len(starts) - 1)]), stops[-min(2, len(stops))]

    def at(self, frame: int) -> Pictures:
        """Return the RGB pictures (H, W, 3) of one frame of the reference camera, None where there is none."""
        return next(self.walk(range(frame, frame + 1)))[1]

    def walk(self, frames: _Frames) -> Iterator[tuple[int, Pictures]]:
        """Yield frames with their pictures; a range that runs backwards is read forwards in parts.

        Raises:
            CaptureError: a picture cannot be decoded.
        """
        if frames.step > 0:
            yield from self._forwards(frames)
            return
        for start in range(0, len(frames), _CHUNK):
            part = frames[start : start + _CHUNK]
            held = list(self._forwards(part[::-1]))
            while held:
                yield held.pop()

    def _forwards(self, frames: _Frames) -> Iterator[tuple[int, Pictures]]:
        wanted = {name: [self.own(name, frame) for frame in frames] for name in self._videos}
        readers = {name: self._videos[name].colour_pictures(own) for name, own in wanted.items()}
        for frame in frames:
            yield frame, {name: next(reader) for name, reader in readers.items()}
