"""Tell the visitor what went wrong, and go on."""

from __future__ import annotations

import functools
import logging
from collections.abc import Awaitable, Callable
from typing import Any

import viser

from jawusd.errors import JawusdError

log = logging.getLogger(__name__)


def say(client: viser.ClientHandle, title: str, body: str, *, bad: bool = False) -> None:
    """Show a message in a page.

    Args:
        client: the page.
        title: a few words.
        body: the sentence.
        bad: something failed; the message then stays until it is closed.
    """
    client.add_notification(title, body, color="red" if bad else "teal", auto_close_seconds=None if bad else 5.0)


def guarded(client: viser.ClientHandle, action: Callable[[Any], Awaitable[None]]) -> Callable[[Any], Awaitable[None]]:
    """Return a callback for the events a visitor makes, whose errors become messages in the page.

    Events that have no client come from the program itself (a slider that was set), and are left out.
    """

    @functools.wraps(action)
    async def callback(event: Any) -> None:
        if getattr(event, "client", None) is None:
            return
        try:
            await action(event)
        except (JawusdError, ValueError) as error:
            say(client, "That did not work", str(error), bad=True)
        except Exception as error:  # the page says it, the log has the details, the server lives on
            log.exception("unexpected error in the viewer")
            say(client, "Unexpected error", f"{type(error).__name__}: {error}", bad=True)

    return callback
