"""The panel of files: keys in and out, animations out."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import viser
from viser import _messages

from jawusd.errors import FormatError
from jawusd.formats.keys import load_keys, save_keys
from jawusd.formats.poses import read_parameters, write_parameters
from jawusd.viewer.motion import Clip
from jawusd.viewer.motion_panel import MotionPanel
from jawusd.viewer.session import Session
from jawusd.viewer.viewed import ViewedActor
from jawusd.viewer.widgets import guarded, say

MOST_BYTES = 8 << 20


class FilePanel:
    """Hold the widgets that read and write files."""

    def __init__(
        self,
        client: viser.ClientHandle,
        session: Session,
        actor: ViewedActor,
        motion: MotionPanel,
        changed: Callable[[], None],
    ) -> None:
        """Make the widgets in the present container; call `changed` after keys were loaded."""
        self._client, self._session, self._actor = client, session, actor
        self._motion, self._changed = motion, changed
        gui = client.gui
        gui.add_button("save keys.json").on_click(guarded(client, self._save))
        self.load = gui.add_upload_button("load keys.json or a CSV of d", mime_type=".json,.csv")
        self.load.on_upload(guarded(client, self._load))
        with gui.add_folder("Animation beside the rig"):
            self.name = gui.add_text("file", "anim_view.usdc")
            self.overwrite = gui.add_checkbox("overwrite", False)
            gui.add_button("write animation").on_click(guarded(client, self._write))
        gui.add_button("save CSV of d").on_click(guarded(client, self._save_csv))
        _limit_uploads(client)

    async def _save(self, _: object) -> None:
        saved = self._session.saved_keys()
        if saved is None:
            raise FormatError("there are no keys to save.", hint='Press "set" under keys.')
        self._client.send_file_download("keys.json", _written(lambda path: save_keys(path, saved), "keys.json"))

    async def _load(self, _: object) -> None:
        upload = self.load.value
        name = Path(upload.name).name
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"upload{Path(name).suffix.lower()}"
            path.write_bytes(upload.content)
            try:
                if path.suffix == ".csv":
                    frames, d = read_parameters(path)
                    self._motion.add_clip(Clip.of(name, frames, d, self._session.work.fps))
                else:
                    self._session.load_keys(load_keys(path))
            except FormatError as error:
                raise FormatError(error.message, path=name, hint=error.hint) from error
        say(self._client, "Loaded", name)
        self._changed()

    async def _write(self, _: object) -> None:
        clip, name, overwrite = self._to_export(), self.name.value, bool(self.overwrite.value)
        path = await asyncio.to_thread(self._actor.save_layer, name, clip, overwrite)
        self._motion.offer_clips()
        outside = int((self._session.rig.margin(clip.d) < -1e-6).sum())
        warning = f" {outside} of its {len(clip.d)} samples lie outside the bound." if outside else ""
        say(self._client, "Written", f"{path}.{warning}")

    async def _save_csv(self, _: object) -> None:
        clip = self._to_export()
        first, last = clip.span
        frames = np.arange(np.ceil(first), np.floor(last) + 1)
        content = _written(lambda path: write_parameters(path, frames.astype(np.int64), clip.at(frames)), "d.csv")
        self._client.send_file_download("d.csv", content)

    def _to_export(self) -> Clip:
        clip = self._motion.clip()
        if clip is None:
            raise FormatError("there is no animation to write.", hint='Press "set" under keys.')
        return clip


def _written(write: Callable[[Path], None], name: str) -> bytes:
    """Return the bytes that a function writes to a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


def _limit_uploads(client: viser.ClientHandle) -> None:
    """Drop uploads larger than `MOST_BYTES` while they arrive, and say so once per file.

    viser keeps the parts of an upload until the last one has arrived, without a limit; its handlers run before these.
    """
    gui = client.gui
    pending = gui._current_file_upload_states

    def drop(transfer: str, size: int) -> None:
        state = pending.pop(transfer, None)
        if state is not None:
            body = f"{state['filename']}: is {size} bytes, at most {MOST_BYTES} are read."
            say(client, "That did not work", body, bad=True)

    async def started(_: int, message: _messages.FileTransferStartUpload) -> None:
        if message.size_bytes > MOST_BYTES:
            drop(message.transfer_uuid, message.size_bytes)

    async def part_received(_: int, message: _messages.FileTransferPart) -> None:
        state = pending.get(message.transfer_uuid)
        # A page may announce less than it sends.
        if state is not None and state["transferred_bytes"] > MOST_BYTES:
            drop(message.transfer_uuid, state["transferred_bytes"])

    gui._websock_interface.register_handler(_messages.FileTransferStartUpload, started)
    gui._websock_interface.register_handler(_messages.FileTransferPart, part_received)
