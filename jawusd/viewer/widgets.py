"""Elements shared by all pages: theme, messages, callbacks with error handling, small text and uploads."""

from __future__ import annotations

import contextlib
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
Client = viser.ClientHandle
#: Event of a button group.
Choice = viser.GuiEvent[viser.GuiButtonGroupHandle]
MOST_BYTES = 8 << 20
_MOST_LETTERS = 80  # maximum length of a file name in messages [characters]


def set_theme(gui: viser.GuiApi, dark: bool = True) -> None:
    """Widen the controls of a page, or of all later pages of a server, and hide viser's logo and share button."""
    gui.configure_theme(control_width="large", show_logo=False, show_share_button=False, dark_mode=dark)


# Set the page title. On screens narrower than viser's phone breakpoint, let the panel fill the width, but at most half
# of the height.
_STYLE = """<style onload="document.title={title}">
@media (max-width: 36em) {{
  .mantine-Paper-root:has(.jawusd-page) {{ width: 100% !important; max-height: 50% !important; }}
  .mantine-Paper-root:has(.jawusd-page) div[style*="20em"] {{ width: 100% !important; }}
}}
</style><span class="jawusd-page"></span>"""


def begin_panel(client: Client, name: str) -> None:
    """Set theme and title of a page, and let its panel fill the width of a phone."""
    set_theme(client.gui)
    client.gui.set_panel_label(name)
    client.gui.add_html(_STYLE.format(title=html.escape(json.dumps(f"{name} - jawusd"))))


def add_dark_checkbox(client: Client) -> None:
    """Add the checkbox for dark mode, which is checked by default."""
    box = client.gui.add_checkbox("dark page", True)

    box.on_update(guarded(client, lambda _: set_theme(client.gui, box.value)))


def assign(widget: viser.GuiInputHandle[Value], value: Value) -> None:
    """Set the value of a widget; viser sends it to the page only if it differs."""
    widget.value = value  # type: ignore[misc]  # mypy does not find viser's setter


class _Widget(Protocol):
    disabled: bool
    visible: bool


def enable(widget: _Widget, on: bool) -> None:
    """Enable or disable a widget; hide button groups, which viser cannot disable."""
    if isinstance(widget, viser.GuiButtonGroupHandle):
        widget.visible = on
    else:
        widget.disabled = not on


def small_text(html: str, style: str = "") -> str:
    """Wrap HTML in a block of small text."""
    return f'<div style="font-size:12px;padding:2px 12px;{style}">{html}</div>'


def notify(client: Client, title: str, body: str, *, bad: bool = False) -> None:
    """Show a message in a page; failures (`bad`) stay until they are closed."""
    client.add_notification(title, body, color="red" if bad else "teal", auto_close_seconds=None if bad else 5.0)


@contextlib.contextmanager
def errors_shown(client: Client) -> Iterator[None]:
    """Show errors in the page instead of raising them, so that they do not stop the server."""
    try:
        yield
    except (JawusdError, ValueError) as error:
        notify(client, "Failed", str(error), bad=True)
    except Exception as error:
        log.exception("unexpected error in the viewer")
        notify(client, "Unexpected error", f"{type(error).__name__}: {error}", bad=True)


def guarded(
    client: Client, action: Callable[[Event], Coroutine[object, None, None] | None]
) -> Callable[[Event], Coroutine[object, None, None]]:
    """Make a callback in the event loop of a function or coroutine for a visitor's events; show its errors in the page.

    Events without a client come from the program itself, which has set a widget, and are ignored.
    """

    async def callback(event: Event) -> None:
        if getattr(event, "client", None) is not None:
            with errors_shown(client):
                running = action(event)
                if running is not None:
                    await running

    return callback


def upload_name(upload: viser.UploadedFile, suffixes: tuple[str, ...]) -> tuple[str, str]:
    """Return the name of an uploaded file, for messages, and its suffix; raises FormatError for other suffixes."""
    name = PurePosixPath(upload.name.replace("\\", "/")).name
    shown = "".join(letter if letter.isprintable() else "?" for letter in name[-_MOST_LETTERS:])
    suffix = next((suffix for suffix in suffixes if name.lower().endswith(suffix)), None)
    if suffix is None:
        raise FormatError(f"is not a {' or '.join(suffixes)} file.", path=shown)
    return shown, suffix


def limit_uploads(client: Client, button: viser.GuiUploadButtonHandle | None) -> None:
    """Abort uploads that are larger than `MOST_BYTES`, concurrent, or not meant for the page's button.

    viser buffers the parts of an upload without a limit, for any widget that the message names. Its own handlers run
    before those installed here.
    """
    gui = client.gui
    pending = gui._current_file_upload_states

    def drop(transfer: str, why: str) -> None:
        state = pending.pop(transfer, None)
        if state is not None:
            notify(client, "Failed", f"{state['filename'][-_MOST_LETTERS:]}: {why}", bad=True)

    async def started(_: int, message: _messages.FileTransferStartUpload) -> None:
        if button is None or message.source_component_uuid != button._impl.uuid:
            drop(message.transfer_uuid, "this page does not accept that file.")
        elif message.size_bytes > MOST_BYTES:
            drop(message.transfer_uuid, f"is {message.size_bytes} bytes; the limit is {MOST_BYTES}.")
        elif len(pending) > 1:
            drop(message.transfer_uuid, "another upload is in progress; wait for it to finish.")

    async def part_received(_: int, message: _messages.FileTransferPart) -> None:
        state = pending.get(message.transfer_uuid)
        # A page may send more bytes than it announced.
        if state is not None and state["transferred_bytes"] > MOST_BYTES:
            drop(message.transfer_uuid, f"is {state['transferred_bytes']} bytes; the limit is {MOST_BYTES}.")

    gui._websock_interface.register_handler(_messages.FileTransferStartUpload, started)
    gui._websock_interface.register_handler(_messages.FileTransferPart, part_received)
