"""A page of the viewer whose browser takes every message and says nothing: for tests and timings without a browser."""

import asyncio
import time

import numpy as np
import viser
from viser.infra._infra import AsyncMessageBuffer, WebsockClientConnection, _ClientHandleState

from jawusd.viewer.page import Page, begin_page


class QuietPage:
    """Hold a page that no browser shows.

    Attributes:
        page: the page.
        made_s: how long making it took.
        notices: titles and bodies of the messages shown.
    """

    def __init__(self, viewer, number=0):
        self.loop = viewer._server.get_event_loop()
        state = _ClientHandleState(AsyncMessageBuffer(self.loop, persistent_messages=False), self.loop)
        self.client = viser.ClientHandle(WebsockClientConnection(number, state), viewer._server)
        self.notices = []
        self.downloads = {}
        self.client.add_notification = lambda title, body, **_: self.notices.append((title, body))
        self.client.send_file_download = lambda name, content, **_: self.downloads.update({name: content})

        # A page is made once the visitor's camera is known.
        state = self.client.camera._state
        state.update_timestamp, state.image_width, state.image_height, state.fov = 1.0, 900, 700, 0.35
        state.wxyz, state.position, state.look_at = np.array([1.0, 0, 0, 0]), np.zeros(3), np.array([0, 0, 1.0])
        state.up_direction, state.near, state.far = np.array([0, -1.0, 0]), 1.0, 1e4

        def make():
            began = time.perf_counter()
            return self.make_page(viewer), time.perf_counter() - began

        self.page, self.made_s = self.call(make)

    def make_page(self, viewer):
        """Return the page of a rig."""
        return Page(self.client, begin_page(self.client, viewer._actor), viewer._actor, viewer._static)

    def call(self, action):
        """Run a function where events of visitors run, and return what it returns."""

        async def run():
            return action()

        return asyncio.run_coroutine_threadsafe(run(), self.loop).result(60)

    def enter(self, handle, value):
        """Do what a visitor's change of a widget does: set its value, then call its callbacks in order."""

        async def run():
            handle._impl.value = value
            event = viser.GuiEvent(client=self.client, client_id=self.client.client_id, target=handle)
            for callback in handle._impl.update_cb:
                await callback(event)

        asyncio.run_coroutine_threadsafe(run(), self.loop).result(60)

    def trigger(self, command):
        """Do what a key does, and what the palette of commands does."""

        async def run():
            event = viser.CommandEvent(client=self.client, client_id=self.client.client_id, target=command)
            for callback in command._impl.trigger_cb:
                await callback(event)

        asyncio.run_coroutine_threadsafe(run(), self.loop).result(60)

    def drag(self, grip, phase, start, end, modifier=None):
        """Do what a visitor's pointer does to a mesh: places in the page's world [mm], and the key that is held."""
        event = viser.SceneNodeDragEvent(
            self.client, self.client.client_id, grip, phase, None, tuple(start), (0.5, 0.5), tuple(end), (0.5, 0.5),
            "left", modifier,
        )  # fmt: skip

        async def run():
            for entry in grip._impl.drag_cb:
                if entry.modifier == modifier:
                    await entry.callback(event)

        asyncio.run_coroutine_threadsafe(run(), self.loop).result(60)
