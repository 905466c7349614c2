"""Shared by all pages: theme, messages, guarded callbacks, small text and uploads."""

from __future__ import annotations

import contextlib
import functools
import html
import json
import logging
from collections.abc import Callable, Coroutine, Iterator
from pathlib import PurePosixPath
from typing import Protocol, TypeVar

import viser
from viser import _messages

from jawusd.base.errors import FormatError, JawusdError

log = logging.getLogger(__name__)

Event = TypeVar("Event")
Value = TypeVar("Value")
#: The event of a button group.
Choice = viser.GuiEvent[viser.GuiButtonGroupHandle]
MOST_BYTES = 8 << 20
_MOST_LETTERS = 80  # of a name in messages


def set_theme(gui: viser.GuiApi, dark: bool = False) -> None:
    """Widen the controls of a page, or of all later pages of a server, and hide viser's logo and share button."""
    gui.configure_theme(control_width="large", show_logo=False, show_share_button=False, dark_mode=dark)


# viser's page has no title of its own, and on phones (its breakpoint) a narrow panel that hides half of the picture.
_STYLE = """<style onload="document.title={title}">
@media (max-width: 36em) {{
  .mantine-Paper-root:has(.jawusd-page) {{ width: 100% !important; max-height: 50% !important; }}
  .mantine-Paper-root:has(.jawusd-page) div[style*="20em"] {{ width: 100% !important; }}
}}
</style><span class="jawusd-page"></span>"""


def begin_panel(client: viser.ClientHandle, name: str) -> None:
    """Set the theme, name a page after what it shows, and let its panel fill the width of a phone."""
    set_theme(client.gui)
    client.gui.set_panel_label(name)
    client.gui.add_html(_STYLE.format(title=html.escape(json.dumps(f"{name} - jawusd"))))


def add_dark_checkbox(client: viser.ClientHandle) -> None:
    """Add the checkbox that makes the page dark."""
    box = client.gui.add_checkbox("dark page", False)

    async def darken(_: object) -> None:
        set_theme(client.gui, box.value)

    box.on_update(guarded(client, darken))


def assign(widget: viser.GuiInputHandle[Value], value: Value) -> None:
    """Set the value of a widget where it differs, which saves a message to the page."""
    if widget.value != value:
        widget.value = value  # type: ignore[misc]  # viser's setter is not next to its getter, so mypy misses it


class _Widget(Protocol):
    disabled: bool
    visible: bool


def enable(widget: _Widget, on: bool) -> None:
    """Let a widget be used, or show that it does not apply now: groups of buttons, which viser cannot disable, go."""
    if isinstance(widget, viser.GuiButtonGroupHandle):
        if widget.visible != on:
            widget.visible = on
    elif widget.disabled == on:
        widget.disabled = not on


def small_text(html: str, style: str = "") -> str:
    """Return HTML as a block of small text."""
    return f'<div style="font-size:12px;padding:2px 12px;{style}">{html}</div>'


def say(client: viser.ClientHandle, title: str, body: str, *, bad: bool = False) -> None:
    """Show a message in a page; one of a failure (`bad`) stays until it is closed."""
    client.add_notification(title, body, color="red" if bad else "teal", auto_close_seconds=None if bad else 5.0)


@contextlib.contextmanager
def errors_shown(client: viser.ClientHandle) -> Iterator[None]:
    """Show errors in the page instead of raising them, so that one page's error does not stop the server."""
    try:
        yield
    except (JawusdError, ValueError) as error:
        say(client, "That did not work", str(error), bad=True)
    except Exception as error:
        log.exception("unexpected error in the viewer")
        say(client, "Unexpected error", f"{type(error).__name__}: {error}", bad=True)


def guarded(
    client: viser.ClientHandle, action: Callable[[Event], Coroutine[object, None, None]]
) -> Callable[[Event], Coroutine[object, None, None]]:
    """Return a callback for a visitor's events that shows errors in the page.

    Events without a client come from the program itself (a slider that was set) and are ignored.
    """

    @functools.wraps(action)
    async def callback(event: Event) -> None:
        if getattr(event, "client", None) is not None:
            with errors_shown(client):
                await action(event)

    return callback


def named(upload: viser.UploadedFile, suffixes: tuple[str, ...]) -> tuple[str, str]:
    """Return the name of an upload, for messages, and which of the suffixes it has.

    Raises:
        FormatError: it has none of them.
    """
    name = PurePosixPath(upload.name.replace("\\", "/")).name
    shown = "".join(letter if letter.isprintable() else "?" for letter in name[-_MOST_LETTERS:])
    suffix = next((suffix for suffix in suffixes if name.lower().endswith(suffix)), None)
    if suffix is None:
        raise FormatError(f"is none of {', '.join(suffixes)}.", path=shown)
    return shown, suffix


def limit_uploads(client: viser.ClientHandle, button: viser.GuiUploadButtonHandle | None) -> None:
    """Drop uploads while they arrive that are larger than `MOST_BYTES`, more than one, or not for the page's button.

    viser keeps the parts of an upload until the last one has arrived, without a limit, for any widget that is named;
    its handlers run before these.
    """
    gui = client.gui
    pending = gui._current_file_upload_states

    def drop(transfer: str, why: str) -> None:
        state = pending.pop(transfer, None)
        if state is not None:
            say(client, "That did not work", f"{state['filename'][-_MOST_LETTERS:]}: {why}", bad=True)

    async def started(_: int, message: _messages.FileTransferStartUpload) -> None:
        if button is None or message.source_component_uuid != button._impl.uuid:
            drop(message.transfer_uuid, "this page takes no such files.")
        elif message.size_bytes > MOST_BYTES:
            drop(message.transfer_uuid, f"is {message.size_bytes} bytes, at most {MOST_BYTES} are read.")
        elif len(pending) > 1:
            drop(message.transfer_uuid, "another file is on its way; wait for it.")

    async def part_received(_: int, message: _messages.FileTransferPart) -> None:
        state = pending.get(message.transfer_uuid)
        # A page may announce less than it sends.
        if state is not None and state["transferred_bytes"] > MOST_BYTES:
            drop(message.transfer_uuid, f"is {state['transferred_bytes']} bytes, at most {MOST_BYTES} are read.")

    gui._websock_interface.register_handler(_messages.FileTransferStartUpload, started)
    gui._websock_interface.register_handler(_messages.FileTransferPart, part_received)
