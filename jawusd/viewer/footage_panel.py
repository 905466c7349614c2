"""The panel for camera and frame, with a plot of how well the poses cover the masks."""

from __future__ import annotations

from collections.abc import Callable

import viser

from jawusd.formats.tracks import Tracks
from jawusd.viewer.coverage import CoveragePlot, frame_words, frames_to_inspect
from jawusd.viewer.motion import Player
from jawusd.viewer.plots import plot_seek
from jawusd.viewer.solve_plot import SolvePlot
from jawusd.viewer.viewed import Look, ViewedCapture
from jawusd.viewer.widgets import Choice, add_dark_checkbox, assign, guarded, small_text

SPACE, ALL = "3-D", "all cameras"
_LOOKS: dict[str, Look] = {"outlines of the teeth": "outlines", "tinted teeth": "tinted", "footage alone": "footage"}
_STEPS = {"-10": -10, "-1": -1, "+1": 1, "+10": 10}


class FootagePanel:
    """Hold the widgets of camera and frame.

    Attributes:
        view: name of the camera shown, or `SPACE`, or `ALL` of them side by side.
        frame: frame of the reference camera.
        player: plays the footage.
        worst: frames to inspect, the worst first.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        capture: ViewedCapture,
        turned: Callable[[], None],
        changed: Callable[[], None],
    ) -> None:
        """Make the widgets in the present container; call `turned` for another view, `changed` for other changes."""
        self._client, self._capture, self._turned, self._changed = client, capture, turned, changed
        self._loading = False
        self.view = next(iter(capture.sizes_px))
        self.frame = capture.picks.frame if capture.tracks is None and capture.picks else capture.frames[0]
        self.frame = min(max(self.frame, capture.frames[0]), capture.frames[1])
        self.worst = [] if capture.tracks is None else frames_to_inspect(capture.tracks, capture.fps)
        gui = client.gui
        views = (
            *capture.sizes_px,
            *([ALL] if len(capture.sizes_px) > 1 else []),
            *([SPACE] if capture.cameras else []),
        )
        self.player = Player(self._play_to, self._stopped)
        self.views = gui.add_button_group("view", views)
        self.views.on_click(guarded(client, self._choose))
        self._look = gui.add_dropdown("draw", tuple(_LOOKS))
        self._look.on_update(guarded(client, self._redraw))
        if capture.tracks is not None:
            self._plot = self._draw_plot(capture.tracks)
            gui.add_html(self._plot.definition)
        self._playhead = gui.add_html("")
        first, last = capture.frames
        self.slider = gui.add_slider("frame", first, max(last, first + 1), 1, self.frame)  # viser needs two values
        self.slider.on_update(guarded(client, self._slide))
        self.play = gui.add_button("play", icon=viser.Icon.PLAYER_PLAY)
        self.play.on_click(guarded(client, self._toggle))
        self.loop = gui.add_checkbox("loop", True)
        self.steps = gui.add_button_group("step", tuple(_STEPS))
        self.steps.on_click(guarded(client, self._step))
        if self.worst:
            self.jumps = gui.add_button_group("worst", ("first", "next worse", "previous"))
            self.jumps.on_click(guarded(client, self._jump))
        self._words = gui.add_html("")
        add_dark_checkbox(client)
        self.refresh()

    @property
    def in_space(self) -> bool:
        """Return whether the view shows the cameras from outside."""
        return self.view == SPACE

    @property
    def on_wall(self) -> bool:
        """Return whether the view shows all cameras side by side."""
        return self.view == ALL

    @property
    def look(self) -> Look:
        """Return what is drawn into the pictures."""
        return _LOOKS[self._look.value]

    def _draw_plot(self, tracks: Tracks) -> CoveragePlot | SolvePlot:
        if tracks.solved is not None:
            return SolvePlot(tracks, tracks.solved, self._capture.frames)
        return CoveragePlot(tracks, self._capture.frames, self.worst)

    def go_to(self, frame: int) -> None:
        """Show another frame, and play no further."""
        self.player.stop()
        first, last = self._capture.frames
        self.frame = min(max(int(frame), first), last)
        self.refresh()
        self._changed()

    def refresh(self) -> None:
        """Update the widgets from view and frame."""
        self._show(self.frame)

    def say_loading(self, loading: bool) -> None:
        """Say that a picture is being decoded, or no longer."""
        if loading != self._loading:
            self._loading = loading
            self.refresh()

    def follow(self, frame: int) -> None:
        """Update the widgets to a frame that was drawn, if it plays: they are never ahead of the picture."""
        if self.player.playing:
            self._show(frame)

    def _show(self, frame: int) -> None:
        assign(self.slider, frame)
        capture = self._capture
        lines = [f"<b>{self.view}</b>, frame {frame}, {frame / capture.fps:.2f} s"]
        if self.view in capture.offsets and (own := frame - capture.offsets[self.view]) != frame:
            lines[0] += f" (its own frame {own})"
        if capture.tracks is not None:
            drawn = self._plot.with_playhead(frame)
            self._playhead.content = plot_seek(drawn, capture.frames, self._plot.across, self.slider._impl.uuid)
            lines.append(frame_words(capture.tracks, frame))
        else:
            lines.append("no poses: name the folder of a build, or what a solve wrote, with --tracks")
        if self._loading:
            lines.append("<b>loading the pictures of this frame</b>")
        if frame in self.worst:
            lines.append(f"number {self.worst.index(frame) + 1} of the {len(self.worst)} frames to look at")
        self._words.content = small_text("<br>".join(lines), "padding-bottom:6px")

    async def _choose(self, event: Choice) -> None:
        self.view = event.target.value
        self.refresh()
        self._turned()

    async def _redraw(self, _: object) -> None:
        self._changed()

    async def _toggle(self, _: object) -> None:
        if self.player.playing:
            self.player.stop()
            return
        self.play.label, self.play.icon = "pause", viser.Icon.PLAYER_PAUSE
        first, last = self._capture.frames
        span = float(first), float(max(last, first + 1))
        self.player.start(float(self.frame), self._capture.fps, span, lambda: bool(self.loop.value))

    def _play_to(self, frame: float) -> None:
        """Show the frame that is on at a time; the page draws as many of them as it can."""
        shown = min(int(frame), self._capture.frames[1])
        if shown != self.frame:
            self.frame = shown
            self._changed()

    def _stopped(self) -> None:
        self.play.label, self.play.icon = "play", viser.Icon.PLAYER_PLAY
        self.refresh()
        self._changed()

    async def _slide(self, _: object) -> None:
        self.go_to(self.slider.value)

    async def _step(self, event: Choice) -> None:
        self.go_to(self.frame + _STEPS[event.target.value])

    async def _jump(self, event: Choice) -> None:
        here = self.worst.index(self.frame) if self.frame in self.worst else None
        if event.target.value == "first" or here is None:
            target = 0
        else:
            target = (here + (1 if event.target.value == "next worse" else -1)) % len(self.worst)
        self.go_to(self.worst[target])
