"""Serve the viewer to browsers, by default only on this machine."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol
from urllib.parse import urlsplit

import viser

from jawusd.base.arrays import Array
from jawusd.viewer.address import FirstPage, check_address, is_loopback, url_of
from jawusd.viewer.page import Page, StaticPlots, begin_page
from jawusd.viewer.readouts import rest_places
from jawusd.viewer.scene import add_jaw, set_first_view
from jawusd.viewer.viewed import ViewedActor
from jawusd.viewer.widgets import Client, set_theme

log = logging.getLogger(__name__)

# Number of requests that a browser must answer, and time to wait for each answer: a browser answers one request per
# animation frame, at most two frames before the scene is drawn. Panels are sent afterwards, since building them blocks
# a browser without a GPU for almost a second. Hidden pages draw no frames.
_ANSWERS, _PATIENCE_S = 4, 3.0
_SHOW_EVERY_S = 0.1  # minimum interval between live poses that are drawn


class _WithoutTraceback(logging.Filter):
    """Log failed connections in one line without traceback, since any program may send invalid bytes."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Replace the traceback with the name of the error; keep every record."""
        if record.exc_info and record.exc_info[1] is not None:
            log.debug("a connection failed", exc_info=record.exc_info)
            record.msg, record.args = (
                "disconnected a page that sent an invalid message (%s)",
                (_words(record.exc_info[1]),),
            )
            record.exc_info = record.exc_text = None
        return True


_WITHOUT_TRACEBACK = _WithoutTraceback()


def _report_task(loop: asyncio.AbstractEventLoop, context: dict[str, object]) -> None:
    """Log in one line that a message from a page could not be processed."""
    error = context.get("exception")
    log.warning("a message from a page could not be processed (%s)", _words(error or context.get("message")))
    if isinstance(error, BaseException):
        log.debug("error of that message", exc_info=error)


def _words(error: object) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text:.100}" if isinstance(error, BaseException) else f"{text:.100}"


class _LocalServer(viser.ViserServer):
    """A viser server that never opens a public tunnel; with viser's own server, any page can request one."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Reject requests to share the page through viser's relay."""
        log.warning("refused a page's request for a public address")
        return None


class _Closable(Protocol):
    def close(self) -> None:
        """Stop the tasks of this page."""


class PageServer(ABC):
    """Server with one page per visitor; `pages` are the open pages by client number; `url` is the address to open."""

    def __init__(self, name: str, host: str, port: int, first: FirstPage | None = None) -> None:
        """Start serving on a port, or on that of `first`, which has served the page so far.

        Port 0 selects any free port; instead of a port in use, the next free one is taken. Raises OutputError if the
        address does not belong to this machine.
        """
        self._host = host
        self.pages: dict[int, _Closable] = {}
        check_address(host)
        with contextlib.redirect_stdout(sys.stderr):  # viser prints a greeting, but stdout is for results
            port = port if first is None else first.release()
            self._server = _LocalServer(host=host, port=port, label=name, verbose=False)
        logging.getLogger("websockets.server").addFilter(_WITHOUT_TRACEBACK)  # a filter is added only once
        self._server.get_event_loop().set_exception_handler(_report_task)
        set_theme(self._server.gui)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)
        self.url = url_of(host, self._server.get_port())
        if first is not None:
            if first.url != self.url:
                log.warning("another program has taken that port; open %s instead", self.url)
            first.close()

    async def _connected(self, client: Client) -> None:
        if not self._trusted(client):
            log.warning("refused a page of another site")
            return
        page = await self._page(client)
        if client.client_id in self._server.get_clients():
            self.pages[client.client_id] = page
        else:  # the visitor disconnected before the page was complete
            page.close()

    @abstractmethod
    async def _page(self, client: Client) -> _Closable:
        """Build the page of a visitor."""

    async def _disconnected(self, client: Client) -> None:
        page = self.pages.pop(client.client_id, None)
        if page is not None:
            page.close()

    def _trusted(self, client: Client) -> bool:
        """Return whether the page came from this server, since browsers let pages of any site connect to localhost."""
        request = self._server._websock_server._live_connections[client.client_id].request
        if request is None:
            return False
        return is_own_page(request.headers.get("Host", ""), request.headers.get("Origin"), is_loopback(self._host))

    def wait(self) -> None:
        """Serve until interrupted."""
        self._server.sleep_forever()

    def stop(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(sys.stderr):
            self._server.stop()


class Viewer(PageServer):
    """Server of a rig."""

    def __init__(
        self,
        load: Callable[[], ViewedActor],
        host: str,
        port: int,
        *,
        play: bool = True,
        first: FirstPage | None = None,
    ) -> None:
        """Start serving an actor; see `PageServer`. With `play`, a new page plays the captured take.

        `load` is called once the server accepts visitors, who wait for it; after an error of it, nothing is served.
        """
        self._play = play
        self._shown_s = -math.inf
        self._loaded: Future[None] = Future()
        super().__init__("jawusd", host, port, first)
        try:
            self._actor = load()
            set_first_view(self._server, rest_places(self._actor.rig))
            add_jaw(self._server.scene, self._actor)  # pages have it before their own scene, which replaces it
            self._static = StaticPlots(self._actor.rig)
            self._loaded.set_result(None)
        except BaseException:
            self._loaded.cancel()
            self.stop()
            raise

    def show(self, d: Array) -> None:
        """Show the jaw at parameters (3,) [mm] on all open pages; drop poses that arrive too fast to be drawn."""
        now = time.monotonic()
        if now - self._shown_s < _SHOW_EVERY_S:
            return
        self._shown_s = now
        for page in list(self.pages.values()):
            if isinstance(page, Page):
                page.session.show(d)
                page.refresh()

    async def _page(self, client: Client) -> Page:
        await asyncio.shield(asyncio.wrap_future(self._loaded))
        scene = begin_page(client, self._actor)
        await asyncio.to_thread(wait_until_drawn, client)
        with client.atomic():
            page = Page(client, scene, self._actor, self._static)
        if self._play:
            page.play_take()
        return page


def wait_until_drawn(client: Client) -> None:
    """Wait until a page has drawn what it was sent, has been closed, or has not answered in time."""
    with contextlib.suppress(TimeoutError, RuntimeError):  # a page without local storage answers with an error
        for _ in range(_ANSWERS):
            client.local_storage.get_item("drawn", _PATIENCE_S)


def is_own_page(host: str, origin: str | None, local: bool) -> bool:
    """Return whether a connection comes from a page of this server, by its Host header and its Origin header, if any.

    If the server listens on a loopback address (`local`), any other name in `host` indicates DNS rebinding.
    """
    name = urlsplit(f"//{host}").hostname or ""
    if local and not is_loopback(name):
        return False
    return origin is None or urlsplit(origin).netloc == host
