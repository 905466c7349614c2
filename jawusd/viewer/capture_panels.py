"""Panels of a capture: camera and frame, and the picks that initialise tracking."""

from __future__ import annotations

import asyncio

import viser

from jawusd.viewer.motion import Player
from jawusd.viewer.picking import SIDES, PickBook
from jawusd.viewer.plots import coverage_plot, frame_html, frames_to_inspect, plot_seek, solve_plot
from jawusd.viewer.viewed import Callback, Look, ViewedCapture
from jawusd.viewer.widgets import Choice, Client, add_dark_checkbox, assign, enable, guarded, notify, small_text

SPACE, ALL = "3-D", "all cameras"
_LOOKS: dict[str, Look] = {"outlines of the teeth": "outlines", "tinted teeth": "tinted", "footage alone": "footage"}
_STEPS = {"-10": -10, "-1": -1, "+1": 1, "+10": 10}
_NONE = "none"
_PICKING_HINT = "Works in the image of a single camera and on the scans in 3-D, not with all cameras side by side."
_HELP = (
    "Click a vertex on a scan, then the same point in the images of at least two cameras at the same frame. Set at "
    "least three picks per arch, spread over the front teeth and both sides. Wheel: zoom; right button: pan."
)


class FootagePanel:
    """Widgets that choose camera and frame.

    `view` is the name of the camera shown, `SPACE` for the 3-D view, or `ALL` for all cameras side by side; `worst` are
    the frames to inspect, worst first.
    """

    def __init__(self, client: Client, capture: ViewedCapture, turned: Callback, changed: Callback) -> None:
        """Add the widgets to the current container; call `turned` if the view changes, else `changed`."""
        self._client, self._capture, self._turned, self._changed = client, capture, turned, changed
        self._loading = False
        self.view = next(iter(capture.sizes_px))
        picks = capture.source.bootstrap
        self.frame = picks.frame if capture.tracks is None and picks else capture.frames[0]
        self.frame = min(max(self.frame, capture.frames[0]), capture.frames[1])
        self.worst = [] if capture.tracks is None else frames_to_inspect(capture.tracks, capture.source.fps)
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
        self._look.on_update(guarded(client, lambda _: changed()))
        if capture.tracks is not None:
            solved = capture.tracks.solved
            self._plot = (
                coverage_plot(capture.tracks, capture.frames, self.worst)
                if solved is None
                else solve_plot(capture.tracks, solved, capture.frames)
            )
            gui.add_html(self._plot.definition())
        self._playhead = gui.add_html("")
        first, last = capture.frames
        self.slider = gui.add_slider("frame", first, max(last, first + 1), 1, self.frame)  # ends must differ
        self.slider.on_update(guarded(client, lambda _: self.go_to(self.slider.value)))
        self.play = gui.add_button("play", icon=viser.Icon.PLAYER_PLAY)
        self.play.on_click(guarded(client, self._toggle))
        self.loop = gui.add_checkbox("loop", True)
        self.steps = gui.add_button_group("step", tuple(_STEPS))
        self.steps.on_click(guarded(client, lambda event: self.go_to(self.frame + _STEPS[event.target.value])))
        if self.worst:
            self.jumps = gui.add_button_group("worst", ("first", "next worse", "previous"))
            self.jumps.on_click(guarded(client, self._jump))
        self._words = gui.add_html("")
        add_dark_checkbox(client)
        self.refresh()

    @property
    def in_space(self) -> bool:
        """Return whether the view is the 3-D view of the cameras."""
        return self.view == SPACE

    @property
    def on_wall(self) -> bool:
        """Return whether the view shows all cameras side by side."""
        return self.view == ALL

    @property
    def look(self) -> Look:
        """Return the options for drawing the scans into the images."""
        return _LOOKS[self._look.value]

    def go_to(self, frame: int) -> None:
        """Stop playback and show a frame."""
        self.player.stop()
        first, last = self._capture.frames
        self.frame = min(max(int(frame), first), last)
        self.refresh()
        self._changed()

    def refresh(self) -> None:
        """Update the widgets from the current view and frame."""
        self._show(self.frame)

    def show_loading(self, loading: bool) -> None:
        """Show or hide the note that an image is being decoded."""
        if loading != self._loading:
            self._loading = loading
            self.refresh()

    def follow(self, frame: int) -> None:
        """Set the widgets to the frame just drawn during playback, so that they are never ahead of the image."""
        if self.player.playing:
            self._show(frame)

    def _show(self, frame: int) -> None:
        assign(self.slider, frame)
        capture = self._capture
        lines = [f"<b>{self.view}</b>, frame {frame}, {frame / capture.source.fps:.2f} s"]
        if self.view in capture.offsets and (own := frame - capture.offsets[self.view]) != frame:
            lines[0] += f" (frame {own} of this camera)"
        if capture.tracks is not None:
            self._playhead.content = plot_seek(self._plot, frame, self.slider._impl.uuid)
            lines.append(frame_html(capture.tracks, frame))
        else:
            lines.append("no poses; pass the folder of a build or the file of a solve with --tracks")
        if self._loading:
            lines.append("<b>loading this frame</b>")
        if frame in self.worst:
            lines.append(f"number {self.worst.index(frame) + 1} of {len(self.worst)} frames to inspect")
        self._words.content = small_text("<br>".join(lines), "padding-bottom:6px")

    def _choose(self, event: Choice) -> None:
        self.view = event.target.value
        self.refresh()
        self._turned()

    def _toggle(self, _: object) -> None:
        if self.player.playing:
            self.player.stop()
            return
        self.play.label, self.play.icon = "pause", viser.Icon.PLAYER_PAUSE
        first, last = self._capture.frames
        span = float(first), float(max(last, first + 1))
        self.player.start(float(self.frame), self._capture.source.fps, span, lambda: bool(self.loop.value))

    def _play_to(self, frame: float) -> None:
        """Show the frame at a playback time; if the page cannot draw every frame, some are skipped."""
        shown = min(int(frame), self._capture.frames[1])
        if shown != self.frame:
            self.frame = shown
            self._changed()

    def _stopped(self) -> None:
        self.play.label, self.play.icon = "play", viser.Icon.PLAYER_PLAY
        self.refresh()
        self._changed()

    def _jump(self, event: Choice) -> None:
        here = self.worst.index(self.frame) if self.frame in self.worst else None
        if event.target.value == "first" or here is None:
            target = 0
        else:
            target = (here + (1 if event.target.value == "next worse" else -1)) % len(self.worst)
        self.go_to(self.worst[target])


class PicksPanel:
    """Widgets for setting the picks; `side` of the scans faces the viewer, one of `picking.SIDES`."""

    def __init__(
        self, client: Client, capture: ViewedCapture, footage: FootagePanel, turned: Callback, changed: Callback
    ) -> None:
        """Add the widgets to the current container; call `turned` if the side changes, else `changed`."""
        self._client, self._capture, self._footage = client, capture, footage
        self._turned, self._changed = turned, changed
        self.book, self.side = PickBook(capture.source.bootstrap), "front"
        self._saved, self.scans_shown = capture.source.bootstrap, False
        self._fit = ""
        gui = client.gui
        gui.add_html(small_text(_HELP))
        self.picking = gui.add_checkbox("clicks set picks", capture.tracks is None, hint=_PICKING_HINT)
        self.picking.on_update(guarded(client, lambda _: turned()))
        self.sides = gui.add_button_group("scans", tuple(SIDES))
        self.sides.on_click(guarded(client, self._choose_side))
        self.chosen = gui.add_dropdown("pick", (_NONE,))
        self.chosen.on_update(guarded(client, self._choose))
        self.edit = gui.add_button_group("remove", ("pixel", "pick", "all"))
        self.edit.on_click(guarded(client, self._remove))
        self.go = gui.add_button("show their frame")
        self.go.on_click(guarded(client, self._go))
        self._list = gui.add_html("")
        self.write = gui.add_button("write to the capture file", icon=viser.Icon.DEVICE_FLOPPY)
        self.write.on_click(guarded(client, self._write))
        self.refresh()

    def show_fit(self, words: str) -> None:
        """Show a sentence on the consistency of the picks."""
        self._fit = words
        self.refresh()

    def refresh(self) -> None:
        """Update the widgets from the picks."""
        book = self.book
        names = tuple(book.name(k) for k in range(len(book.picks)))
        if self.chosen.options != (_NONE, *names):
            self.chosen.options = (_NONE, *names)
        assign(self.chosen, _NONE if book.selected is None else names[book.selected])
        some, missing = bool(book.picks), book.missing()
        enable(self.picking, not self._footage.on_wall)
        enable(self.sides, self.scans_shown)
        enable(self.chosen, some)
        enable(self.edit, some)
        enable(self.go, book.frame is not None)
        enable(self.write, not missing)
        lines = [f"frame {book.frame}" if book.frame is not None else "no pixels yet"]
        for number, pick in enumerate(book.picks):
            text = f"{names[number]}, vertex {pick.vertex}: {', '.join(pick.views) or 'no pixels yet'}"
            lines.append(f"<b>{text}</b>" if number == book.selected else text)
        lines.append(missing or "complete")
        if self._fit:
            lines.append(self._fit)
        self._list.content = small_text("<br>".join(lines))

    def _choose_side(self, event: Choice) -> None:
        self.side = event.target.value
        self._turned()

    def _choose(self, _: object) -> None:
        number = self.chosen.options.index(self.chosen.value) - 1
        self.book.selected = None if number < 0 else number
        self._changed()

    def _remove(self, event: Choice) -> None:
        if event.target.value == "pixel":
            self.book.remove_pixel(self._footage.view)
        elif event.target.value == "pick":
            self.book.remove()
        else:
            self.book.clear()
        self._changed()

    def _go(self, _: object) -> None:
        if self.book.frame is None:
            raise ValueError("no pick has a pixel yet, so there is no frame to show")
        self._footage.go_to(self.book.frame)

    async def _write(self, _: object) -> None:
        picks = self.book.bootstrap()
        await asyncio.to_thread(self._capture.save_picks, picks, self._saved)
        self._saved = picks
        count = f"{len(picks.upper)} upper and {len(picks.lower)} lower picks"
        notify(self._client, "Written", f"{count}, frame {picks.frame}")
