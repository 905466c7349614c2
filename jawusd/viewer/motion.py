"""Motion on a timeline: jaw parameters over frames, key frames, and playback."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError
from jawusd.formats.keys import Key

#: Keys of an animation, in the order of their frames.
KeyTrack = tuple[Key, ...]

_MOST_PER_S = 30.0  # maximum updates per second, to limit network load


@dataclass(frozen=True, eq=False)
class Clip:
    """Jaw parameters at increasing frame numbers, linearly interpolated."""

    name: str
    frames: Array  # frame numbers, shape (F,)
    d: Array  # parameters [mm], shape (F, 3); finite
    fps: float

    @classmethod
    def of(cls, name: str, frames: ArrayLike, d: ArrayLike, fps: float) -> Clip:
        """Build a clip from frame numbers (F,) and parameters (F, 3) [mm]; interpolate lost frames (NaN).

        Raises FormatError if no frame has parameters, or if the frames do not increase.
        """
        frames, d = np.asarray(frames, dtype=np.float64), np.asarray(d, dtype=np.float64)
        known = np.all(np.isfinite(d), axis=1)
        if not known.any():
            raise FormatError("no frame has parameters; there is nothing to play.", path=name)
        if (np.diff(frames[known]) <= 0).any():
            raise FormatError("the frame numbers do not increase.", path=name)
        return cls(name, frames[known], d[known], float(fps))

    @property
    def span(self) -> tuple[float, float]:
        """Return the first and the last frame."""
        return float(self.frames[0]), float(self.frames[-1])

    def at(self, frames: ArrayLike) -> Array:
        """Return the parameters [mm] (..., 3) at frames (...), constant before the first and after the last frame."""
        at = np.asarray(frames, dtype=np.float64)
        return np.stack([np.interp(at, self.frames, column) for column in self.d.T], axis=-1)


def with_key(keys: KeyTrack, frame: float, d: tuple[float, float, float]) -> KeyTrack:
    """Return the keys with the key at a frame added or replaced."""
    added = Key(frame=float(frame), d=d)
    return tuple(sorted([*(key for key in keys if key.frame != frame), added], key=lambda key: key.frame))


def without_key(keys: KeyTrack, frame: float) -> KeyTrack:
    """Return the keys without the key at a frame; raises FormatError if there is none."""
    kept = tuple(key for key in keys if key.frame != frame)
    if len(kept) == len(keys):
        known = ", ".join(f"{key.frame:g}" for key in keys) or "none"
        raise FormatError(f"there is no key at frame {frame:g}; keys are at: {known}.")
    return kept


def at_frames(keys: KeyTrack, frames: Sequence[float]) -> KeyTrack:
    """Return the keys at other frames, in the same order; raises FormatError unless each key has its own frame."""
    if len(frames) != len(keys) or len(set(frames)) != len(keys):
        raise FormatError(f"{len(keys)} keys at {len(set(frames))} different frames; every key needs its own frame.")
    return tuple(
        key.model_copy(update={"frame": float(frame)}) for key, frame in zip(keys, sorted(frames), strict=True)
    )


def frame_after(frame: float, elapsed_s: float, fps: float, span: tuple[float, float], loop: bool) -> float | None:
    """Return the frame to show `elapsed_s` seconds after `frame`; None past the end if playback does not loop.

    If `frame` lies outside the span (first and last frame), playback starts at the first frame.
    """
    first, last = span
    if not first <= frame < last:
        frame = first
    frame += elapsed_s * fps
    if frame <= last:
        return frame
    # The last frame is shown for its full duration before playback wraps around.
    return min(first + (frame - first) % (last - first + 1), last) if loop else None


class Player:
    """Playback of a motion in the asyncio event loop."""

    def __init__(self, show: Callable[[float], None], ended: Callable[[], None]) -> None:
        """Store the callbacks `show`, called with every frame number, and `ended`, called on any stop but `close`."""
        self._show, self._ended = show, ended
        self._task: asyncio.Task[None] | None = None

    @property
    def playing(self) -> bool:
        """Return whether playback is running."""
        return self._task is not None

    def start(self, frame: float, fps: float, span: tuple[float, float], loop: Callable[[], bool]) -> None:
        """Start playback at a frame; `loop` is evaluated at every step."""
        self.stop()
        self._task = asyncio.get_running_loop().create_task(self._run(frame, fps, span, loop))

    def stop(self) -> None:
        """Stop playback, if it is running."""
        if self.playing:
            self.close()
            self._ended()

    def close(self) -> None:
        """Stop playback without calling `ended`, for a page that was closed."""
        if self._task is not None:
            self._task.cancel()
            self._task = None

    async def _run(self, frame: float, fps: float, span: tuple[float, float], loop: Callable[[], bool]) -> None:
        began = time.monotonic()
        try:
            while True:
                now = frame_after(frame, time.monotonic() - began, fps, span, loop())
                self._show(span[1] if now is None else now)
                if now is None:
                    break
                await asyncio.sleep(1.0 / min(fps, _MOST_PER_S))
        finally:
            if self._task is asyncio.current_task():  # after `stop`, `ended` has already been called
                self._task = None
                self._ended()
