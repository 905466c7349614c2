"""Files that a page sends: at most so many bytes, and never more of them in memory."""

from __future__ import annotations

from collections.abc import Callable

import viser
from viser import _messages

MOST_BYTES = 8 << 20


def limit_uploads(client: viser.ClientHandle, refuse: Callable[[str, int], None]) -> None:
    """Drop what a client uploads beyond `MOST_BYTES`, while it arrives.

    viser keeps the parts of an upload until the last one is there and knows no limit; its handlers run before these.

    Args:
        client: the page.
        refuse: called once per dropped file with its name and the bytes announced or received.
    """
    gui = client.gui
    pending = gui._current_file_upload_states

    def drop(transfer: str, size: int) -> None:
        state = pending.pop(transfer, None)
        if state is not None:
            refuse(state["filename"], size)

    async def started(_: int, message: _messages.FileTransferStartUpload) -> None:
        if message.size_bytes > MOST_BYTES:
            drop(message.transfer_uuid, message.size_bytes)

    async def part_came(_: int, message: _messages.FileTransferPart) -> None:
        state = pending.get(message.transfer_uuid)
        # A page may announce less than it sends.
        if state is not None and state["transferred_bytes"] > MOST_BYTES:
            drop(message.transfer_uuid, state["transferred_bytes"])

    gui._websock_interface.register_handler(_messages.FileTransferStartUpload, started)
    gui._websock_interface.register_handler(_messages.FileTransferPart, part_came)
