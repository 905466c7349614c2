"""Motion that a timeline plays: parameters over frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import FormatError
from jawusd.geometry.arrays import Array


@dataclass(frozen=True, eq=False)
class Clip:
    """Hold parameters at rising frames, linear in between.

    Attributes:
        name: what people call it.
        frames: frame numbers, shape (F,).
        d: parameters [mm], shape (F, 3); finite.
        fps: frames per second.
    """

    name: str
    frames: Array
    d: Array
    fps: float

    @classmethod
    def of(cls, name: str, frames: NDArray, d: Array, fps: float) -> Clip:
        """Make a clip of the frames that have parameters; lost ones (NaN) are bridged.

        Args:
            name: what people call it.
            frames: frame numbers, shape (F,).
            d: parameters [mm], shape (F, 3).
            fps: frames per second.

        Raises:
            FormatError: no frame has parameters, or the frames do not rise.
        """
        known = np.isfinite(d).all(axis=1)
        if not known.any():
            raise FormatError("no frame has parameters; there is nothing to play.", path=name)
        frames = np.asarray(frames, dtype=np.float64)[known]
        if (np.diff(frames) <= 0).any():
            raise FormatError("its frame numbers do not rise.", path=name)
        return cls(name, frames, np.asarray(d, dtype=np.float64)[known], float(fps))

    @property
    def span(self) -> tuple[float, float]:
        """Return the first and the last frame."""
        return float(self.frames[0]), float(self.frames[-1])

    def at(self, frames: NDArray) -> Array:
        """Return parameters [mm] (..., 3) at frames (...); the first and last one hold outside."""
        frames = np.asarray(frames, dtype=np.float64)
        return np.stack([np.interp(frames, self.frames, column) for column in self.d.T], axis=-1)


def frame_after(frame: float, elapsed_s: float, fps: float, span: tuple[float, float], loop: bool) -> float | None:
    """Return the frame that plays `elapsed_s` seconds after `frame` did.

    Args:
        frame: the frame at the start; outside the span playing starts at its beginning.
        elapsed_s: time since then.
        fps: frames per second.
        span: first and last frame.
        loop: go on at the beginning after the end.

    Returns:
        The frame, or None when the end is passed and nothing loops.
    """
    first, last = span
    if not first <= frame < last:
        frame = first
    frame += elapsed_s * fps
    if frame <= last:
        return frame
    # The last frame is shown for its own duration before the first one follows.
    return min(first + (frame - first) % (last - first + 1), last) if loop else None
