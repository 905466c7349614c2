"""The panel of files: keys in and out, animations out."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import viser

from jawusd.base.errors import FormatError
from jawusd.formats.keys import load_keys, save_keys
from jawusd.formats.poses import read_parameters, write_parameters
from jawusd.viewer.motion import Clip
from jawusd.viewer.motion_panel import MotionPanel
from jawusd.viewer.session import Session
from jawusd.viewer.uploads import limit_uploads, named
from jawusd.viewer.viewed import ViewedActor
from jawusd.viewer.widgets import guarded, say


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
        limit_uploads(client, self.load)

    async def _save(self, _: object) -> None:
        saved = self._session.saved_keys()
        if saved is None:
            raise FormatError("there are no keys to save.", hint='Press "set" under keys.')
        content = _written(lambda path: save_keys(path, saved), "keys.json")
        self._client.send_file_download("keys.json", content, save_immediately=True)

    async def _load(self, _: object) -> None:
        upload = self.load.value
        name, suffix = named(upload, (".json", ".csv"))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"upload{suffix}"
            path.write_bytes(upload.content)
            try:
                if suffix == ".csv":
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
        self._client.send_file_download("d.csv", content, save_immediately=True)

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
