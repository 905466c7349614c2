"""Timeline panel (keys, curves, playback, seeking) and file panel (load and save keys, export animations)."""

from __future__ import annotations

import asyncio
import html
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import viser

from jawusd.base.errors import FormatError
from jawusd.formats.keys import load_keys, save_keys
from jawusd.formats.poses import read_parameters, write_parameters
from jawusd.viewer.motion import Clip, KeyTrack, Player, with_key, without_key
from jawusd.viewer.plots import Plot, curve_plot, plot_seek
from jawusd.viewer.session import Interpolation, Session
from jawusd.viewer.viewed import Callback, ViewedActor
from jawusd.viewer.widgets import (
    Choice,
    Client,
    assign,
    errors_shown,
    guarded,
    limit_uploads,
    notify,
    small_text,
    upload_name,
)

KEYS = "keys"
_LENGTH = 100
_MOST_THUMBS = 40  # maximum number of keys that are shown in a multi-slider


class Playback:
    """A line with the name and current frame of the motion, and a button that plays and pauses it."""

    def __init__(self, client: Client) -> None:
        self._line = client.gui.add_html("")
        self.button = client.gui.add_button("play", icon=viser.Icon.PLAYER_PLAY)

    def show(self, motion: str, where: str) -> None:
        """Show the motion's name, and its current frame or why it has none."""
        self._line.content = small_text(f"{html.escape(motion)}, {where}", "padding-top:6px")

    def show_playing(self, playing: bool) -> None:
        """Label the button with its effect: play or pause."""
        self.button.label = "pause" if playing else "play"
        self.button.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY


class MotionPanel:
    """Timeline of one page, with the current frame."""

    def __init__(
        self, client: Client, session: Session, actor: ViewedActor, playback: Playback, changed: Callback
    ) -> None:
        """Add the widgets to the current container; call `changed` after every change of pose or keys."""
        self._client, self._session, self._actor, self._changed = client, session, actor, changed
        self._loaded: dict[str, Clip] = {}
        self._copied: tuple[float, float, float] | None = None
        self._drawn: tuple[str, Clip | None, KeyTrack, Interpolation, float] | None = None
        self.player = Player(self.show, lambda: playback.show_playing(False))
        self._playback, self.play = playback, playback.button
        self.play.on_click(guarded(client, self._toggle))
        gui = client.gui
        self.source = gui.add_dropdown("motion", (KEYS, *actor.clip_names()))
        self.source.on_update(guarded(client, self._choose))
        self.frame_slider = gui.add_slider("frame", 0.0, float(_LENGTH), 1.0, 0.0)
        self.frame_slider.on_update(guarded(client, self._scrub))
        self.loop = gui.add_checkbox("loop", True)
        gui.add_button_group("keys", ("set", "delete", "copy", "paste")).on_click(guarded(client, self._edit))
        gui.add_button_group("go to", ("previous", "next")).on_click(guarded(client, self._jump))
        self._curves = gui.add_html("")
        self._playhead = gui.add_html("")
        self.thumbs = gui.add_multi_slider("move keys", 0, _LENGTH, 1, (0,), visible=False)
        self.thumbs.on_update(guarded(client, self._drag_keys))
        self.between = gui.add_dropdown("between keys", get_args(Interpolation))
        self.between.on_update(guarded(client, self._interpolate))
        self.fps = gui.add_number("frames per second", session.work.fps, min=1.0, max=1000.0, step=1.0)
        self.fps.on_update(guarded(client, self._rate))
        self._plot: Plot = curve_plot(None, (), (0.0, float(_LENGTH)))
        self.frame = 0.0
        self._reading = False  # whether the take is being read

    def clip(self) -> Clip | None:
        """Return the selected motion; None if it has no keys, or while its file is being read."""
        return self._session.key_clip() if self.source.value == KEYS else self._loaded.get(self.source.value)

    def add_clip(self, clip: Clip) -> None:
        """Add a motion from an uploaded file and select it."""
        self._loaded[clip.name] = clip
        self.source.options = tuple(dict.fromkeys((*self.source.options, clip.name)))
        assign(self.source, clip.name)
        self._begin(clip)

    def offer_clips(self) -> None:
        """Add motions whose files have appeared in the rig's folder."""
        self.source.options = tuple(dict.fromkeys((*self.source.options, *self._actor.clip_names())))

    def show(self, frame: float) -> None:
        """Show the selected motion at a frame."""
        self.frame = frame
        clip = self.clip()
        if clip is not None:
            self._session.show(clip.at(frame))
        self._changed()

    def refresh(self) -> None:
        """Update the widgets from the session and the current frame."""
        work = self._session.work
        chosen = self.source.value
        drawn = (chosen, self._loaded.get(chosen), work.keys, work.interpolation, work.fps)
        if drawn != self._drawn:
            self._drawn = drawn
            clip = self.clip()
            span = self._set_ends(clip)
            self._plot = curve_plot(clip, work.keys if chosen == KEYS else (), span)
            self._curves.content = self._plot.definition()
            self._set_thumbs()
            assign(self.between, work.interpolation)
            assign(self.fps, work.fps)
        self._playhead.content = plot_seek(self._plot, self.frame, self.frame_slider._impl.uuid)
        assign(self.frame_slider, float(round(self.frame)))
        self._playback.show(*self._where())

    def _where(self) -> tuple[str, str]:
        """Return the motion that the play button plays, and its current frame or why it has none."""
        clip, chosen, take = self.clip(), self.source.value, self._actor.take
        if clip is not None:
            return chosen, f"frame {self.frame:.0f} of {clip.span[0]:.0f} to {clip.span[1]:.0f}"
        if chosen != KEYS:
            return chosen, "being read"
        if take is None:
            return chosen, "nothing to play"
        return take, "being read" if self._reading else "ready to play"

    def _set_ends(self, clip: Clip | None) -> tuple[float, float]:
        """Set the range of the timeline to a motion; return its first and last frame."""
        first, last = (0.0, 0.0) if clip is None else clip.span
        if self.source.value == KEYS:
            first, last = min(first, 0.0), max(last + 25.0, float(_LENGTH))
        self.frame_slider.min, self.frame_slider.max = first, last
        self.frame = min(max(self.frame, first), last)
        return first, last

    def _set_thumbs(self) -> None:
        frames = tuple(key.frame for key in self._session.work.keys)
        whole = all(frame == int(frame) for frame in frames)
        visible = 0 < len(frames) <= _MOST_THUMBS and whole and self.source.value == KEYS
        if visible:
            self.thumbs.min, self.thumbs.max = int(self.frame_slider.min), int(self.frame_slider.max)
            assign(self.thumbs, tuple(int(frame) for frame in frames))
        self.thumbs.visible = visible

    async def play_take(self) -> None:
        """Play the captured take, if there is one, unless the visitor used the page while the take was being read."""
        take, source, work = self._actor.take, self.source.value, self._session.work
        if take is None or self._reading:
            return
        self._reading = True
        self._changed()
        try:
            with errors_shown(self._client):
                clip = self._loaded[take] = await asyncio.to_thread(self._actor.load_clip, take)
                if self.source.value == source and self._session.work is work:
                    assign(self.source, take)
                    self._begin(clip)
                    self._start(clip)
        finally:
            self._reading = False
        self._changed()

    async def _choose(self, _: object) -> None:
        self.player.stop()
        name = self.source.value
        if name != KEYS and name not in self._loaded:
            try:
                self._loaded[name] = await asyncio.to_thread(self._actor.load_clip, name)
            except Exception:
                assign(self.source, KEYS)
                raise
        if self.source.value == name:  # another motion may have been selected while the file was read
            self._begin(self.clip())

    def _begin(self, clip: Clip | None) -> None:
        self._drawn = None
        if clip is None:
            self._changed()
        else:
            self.show(clip.span[0])

    def _scrub(self, _: object) -> None:
        self.player.stop()
        self.show(float(self.frame_slider.value))

    async def _toggle(self, _: object) -> None:
        if self.player.playing:
            self.player.stop()
            return
        clip = self.clip()
        if clip is not None:
            self._start(clip)
        elif self.source.value == KEYS and self._actor.take is not None:
            await self.play_take()
        else:
            raise FormatError("there is nothing to play.", hint="Set keys, or select another motion.")

    def _start(self, clip: Clip) -> None:
        self._playback.show_playing(True)
        fps = self._session.work.fps if self.source.value == KEYS else clip.fps
        self.player.start(self.frame, fps, clip.span, lambda: bool(self.loop.value))

    def _edit(self, event: Choice) -> None:
        session, frame = self._session, float(round(self.frame))
        self.player.stop()
        if event.target.value == "set":
            session.add_key(frame)
        elif event.target.value == "delete":
            session.set_keys(without_key(session.work.keys, frame))
        elif event.target.value == "copy":
            self._copied = session.work.d
        elif self._copied is None:
            raise FormatError("nothing has been copied.", hint='Go to a frame and press "copy".')
        else:
            session.set_keys(with_key(session.work.keys, frame, self._copied))
            session.show(self._copied)
        assign(self.source, KEYS)
        self.frame = frame
        self._changed()

    def _jump(self, event: Choice) -> None:
        self.player.stop()
        frames = [key.frame for key in self._session.work.keys]
        if event.target.value == "next":
            reached = min((frame for frame in frames if frame > self.frame), default=None)
        else:
            reached = max((frame for frame in frames if frame < self.frame), default=None)
        if reached is not None:
            self.show(reached)

    def _drag_keys(self, _: object) -> None:
        self._session.move_keys(self.thumbs.value, self.frame)
        self._changed()

    def _interpolate(self, _: object) -> None:
        self._session.set_interpolation(self.between.value)
        self.show(self.frame)

    def _rate(self, _: object) -> None:
        self._session.set_fps(float(self.fps.value))
        self._changed()


class FilePanel:
    """Widgets that load and save files."""

    def __init__(
        self, client: Client, session: Session, actor: ViewedActor, motion: MotionPanel, changed: Callback
    ) -> None:
        """Add the widgets to the current container; call `changed` after keys have been loaded."""
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

    def _save(self, _: object) -> None:
        saved = self._session.saved_keys()
        if saved is None:
            raise FormatError("there are no keys to save.", hint='Press "set" under "keys".')
        content = _written(lambda path: save_keys(path, saved), "keys.json")
        self._client.send_file_download("keys.json", content, save_immediately=True)

    def _load(self, _: object) -> None:
        upload = self.load.value
        name, suffix = upload_name(upload, (".json", ".csv"))
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
        notify(self._client, "Loaded", name)
        self._changed()

    async def _write(self, _: object) -> None:
        clip, name, overwrite = self._to_export(), self.name.value, bool(self.overwrite.value)
        path = await asyncio.to_thread(self._actor.save_layer, name, clip, overwrite)
        self._motion.offer_clips()
        outside = int((self._session.rig.margin(clip.d) < -1e-6).sum())
        warning = f" {outside} of its {len(clip.d)} samples lie outside the bound." if outside else ""
        notify(self._client, "Written", f"{path}.{warning}")

    def _save_csv(self, _: object) -> None:
        clip = self._to_export()
        first, last = clip.span
        frames = np.arange(np.ceil(first), np.floor(last) + 1)
        content = _written(lambda path: write_parameters(path, frames.astype(np.int64), clip.at(frames)), "d.csv")
        self._client.send_file_download("d.csv", content, save_immediately=True)

    def _to_export(self) -> Clip:
        clip = self._motion.clip()
        if clip is None:
            raise FormatError("there is no animation to write.", hint='Press "set" under "keys".')
        return clip


def _written(write: Callable[[Path], None], name: str) -> bytes:
    """Return the bytes that a function writes to a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()
