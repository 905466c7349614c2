"""A page of a capture that no browser shows."""

import asyncio
from types import SimpleNamespace

import numpy as np
from quiet_page import QuietPage

from jawusd.viewer.capture_page import CapturePage


class QuietCapturePage(QuietPage):
    """A page of a capture that no browser shows."""

    def make_page(self, viewer):
        """Return the page of a capture."""
        return CapturePage(self.client, viewer._capture)

    def settle(self):
        """Wait until everything is drawn."""

        async def wait():
            await asyncio.wait_for(self.page._drawing, 100)

        asyncio.run_coroutine_threadsafe(wait(), self.loop).result(120)

    def press(self, group, option):
        """Press a button of a group, and wait."""
        self.enter(group, option)
        self.settle()

    def click(self, place):
        """Click where a place of the page (3,) is seen, and wait."""
        eye = np.array(self.client.camera.position)
        event = SimpleNamespace(client=self.client, ray_origin=tuple(eye), ray_direction=tuple(place - eye))

        async def run():
            for entry in self.client.scene._scene_pointer_cb:
                await entry.callback(event)

        asyncio.run_coroutine_threadsafe(run(), self.loop).result(60)
        self.settle()
