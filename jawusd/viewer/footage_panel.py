"""Panel of a rig's page that shows one camera's footage of the captured take at the current frame."""

from __future__ import annotations

import asyncio

import numpy as np
import viser
from numpy.typing import NDArray

from jawusd.viewer.scene import PHONE
from jawusd.viewer.viewed import ViewedFootage
from jawusd.viewer.widgets import assign, errors_shown, guarded

#: Entry of the menu with which no footage is shown.
OFF = "off"
_EMPTY: NDArray[np.uint8] = np.full((3, 4, 3), 255, np.uint8)


class TakeFootagePanel:
    """Menu of the cameras, and the image of the selected camera; frames outside the take show no image.

    Images are decoded outside the event loop. During playback, frames that would arrive late are left out.

    Attributes:
        camera: menu of the cameras.
        drawn: camera and frame of the displayed image; None without one.
    """

    def __init__(self, client: viser.ClientHandle, footage: ViewedFootage) -> None:
        """Add the widgets to the current container; phones start without footage."""
        self._client, self._footage = client, footage
        self._loop = asyncio.get_running_loop()
        self._frame = 0
        self._drawing: asyncio.Task[None] | None = None
        self.drawn: tuple[str, int] | None = None
        phone = client.camera.image_width < PHONE * client.camera.image_height
        choices = (OFF, *footage.cameras)
        self.camera = client.gui.add_dropdown("footage", choices, initial_value=choices[0 if phone else 1])
        self.camera.on_update(guarded(client, self._choose))
        self._image = client.gui.add_image(_EMPTY, format="jpeg", visible=False)

    def show(self, frame: float) -> None:
        """Show the image of the nearest whole frame as soon as it is decoded; any thread may call this."""
        self._loop.call_soon_threadsafe(self._start, round(frame))

    async def _choose(self, _: object) -> None:
        self._start(self._frame)

    def _start(self, frame: int) -> None:
        self._frame = frame
        if self._drawing is None or self._drawing.done():
            self._drawing = self._loop.create_task(self._draw())

    def _wanted(self) -> tuple[str, int] | None:
        first, last = self._footage.frames
        if self.camera.value == OFF or not first <= self._frame <= last:
            return None
        return self.camera.value, self._frame

    async def _draw(self) -> None:
        """Draw until the image is the wanted one; an error is shown once, and turns the footage off."""
        while (wanted := self._wanted()) != self.drawn:
            if wanted is not None:
                image = None
                with errors_shown(self._client):
                    image = await asyncio.to_thread(self._footage.picture, *wanted)
                if image is None:
                    assign(self.camera, OFF)
                    wanted = None
                else:
                    self._image.image = image
            self.drawn = wanted
            self._image.visible = wanted is not None

    def close(self) -> None:
        """Stop drawing."""
        if self._drawing is not None:
            self._drawing.cancel()
