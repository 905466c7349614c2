"""The panel for camera and frame, with a plot of how well the poses cover the masks."""

from __future__ import annotations

from collections.abc import Callable

import viser

from jawusd.viewer.coverage import CoveragePlot, frame_words, frames_to_inspect
from jawusd.viewer.plots import plot_seek
from jawusd.viewer.viewed import Look, ViewedCapture
from jawusd.viewer.widgets import Choice, add_dark_checkbox, assign, guarded, small_text

SPACE = "3-D"
_LOOKS: dict[str, Look] = {"outlines of the teeth": "outlines", "tinted teeth": "tinted", "footage alone": "footage"}
_STEPS = {"-10": -10, "-1": -1, "+1": 1, "+10": 10}


class FootagePanel:
    """Hold the widgets of camera and frame.

    Attributes:
        view: name of the camera shown, or `SPACE`.
        frame: frame of the reference camera.
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
        self.view = next(iter(capture.sizes_px))
        self.frame = capture.picks.frame if capture.tracks is None and capture.picks else capture.frames[0]
        self.frame = min(max(self.frame, capture.frames[0]), capture.frames[1])
        self.worst = [] if capture.tracks is None else frames_to_inspect(capture.tracks, capture.fps)
        gui = client.gui
        views = (*capture.sizes_px, *([SPACE] if capture.cameras else []))
        self.views = gui.add_button_group("view", views)
        self.views.on_click(guarded(client, self._choose))
        self._look = gui.add_dropdown("draw", tuple(_LOOKS))
        self._look.on_update(guarded(client, self._redraw))
        if capture.tracks is not None:
            self._plot = CoveragePlot(capture.tracks, capture.frames, self.worst)
            gui.add_html(self._plot.definition)
        self._playhead = gui.add_html("")
        first, last = capture.frames
        self.slider = gui.add_slider("frame", first, max(last, first + 1), 1, self.frame)  # viser needs two values
        self.slider.on_update(guarded(client, self._slide))
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
    def look(self) -> Look:
        """Return what is drawn into the pictures."""
        return _LOOKS[self._look.value]

    def go_to(self, frame: int) -> None:
        """Show another frame."""
        first, last = self._capture.frames
        self.frame = min(max(int(frame), first), last)
        self.refresh()
        self._changed()

    def refresh(self) -> None:
        """Update the widgets from view and frame."""
        assign(self.slider, self.frame)
        capture = self._capture
        lines = [f"<b>{self.view}</b>, frame {self.frame}"]
        if not self.in_space and (own := self.frame - capture.offsets[self.view]) != self.frame:
            lines[0] += f" (its own frame {own})"
        if capture.tracks is not None:
            drawn = self._plot.with_playhead(self.frame)
            self._playhead.content = plot_seek(drawn, capture.frames, self._plot.across, self.slider._impl.uuid)
            lines.append(frame_words(capture.tracks, self.frame))
        else:
            lines.append("no tracked poses: build the rig, then name its folder with --tracks")
        if self.frame in self.worst:
            lines.append(f"number {self.worst.index(self.frame) + 1} of the {len(self.worst)} frames to look at")
        self._words.content = small_text("<br>".join(lines), "padding-bottom:6px")

    async def _choose(self, event: Choice) -> None:
        self.view = event.target.value
        self.refresh()
        self._turned()

    async def _redraw(self, _: object) -> None:
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
