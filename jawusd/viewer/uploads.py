"""Files that pages send: which are taken, how large, one at a time."""

from __future__ import annotations

from pathlib import PurePosixPath

import viser
from viser import _messages

from jawusd.base.errors import FormatError
from jawusd.viewer.widgets import say

MOST_BYTES = 8 << 20
_MOST_LETTERS = 80  # of a name in messages


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
