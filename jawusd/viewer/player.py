"""Play a motion in the time of a clock."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from jawusd.viewer.clip import frame_after

# No screen shows more, and the network has a rest.
_MOST_PER_S = 30.0


class Player:
    """Step through the frames of a motion in the event loop, one task at a time."""

    def __init__(self, show: Callable[[float], None], ended: Callable[[], None]) -> None:
        """Make a player.

        Args:
            show: called with every frame number that is shown.
            ended: called when it stops, by itself or not.
        """
        self._show, self._ended = show, ended
        self._task: asyncio.Task[None] | None = None

    @property
    def playing(self) -> bool:
        """Return whether it plays."""
        return self._task is not None

    def start(self, frame: float, fps: float, span: tuple[float, float], loop: Callable[[], bool]) -> None:
        """Play from a frame on.

        Args:
            frame: where to begin.
            fps: frames per second.
            span: first and last frame.
            loop: asked at every step whether to begin again after the end.
        """
        self.stop()
        self._task = asyncio.get_running_loop().create_task(self._run(frame, fps, span, loop))

    def stop(self) -> None:
        """Stop; does nothing when it does not play."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
            self._ended()

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
            if self._task is asyncio.current_task():  # else `stop` has said so already
                self._task = None
                self._ended()
