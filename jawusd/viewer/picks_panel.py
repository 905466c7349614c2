"""The panel of the picks that start the tracking."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import viser

from jawusd.viewer.footage_panel import FootagePanel
from jawusd.viewer.picking_layout import SIDES
from jawusd.viewer.picks import PickBook
from jawusd.viewer.viewed import ViewedCapture
from jawusd.viewer.widgets import Choice, assign, enable, guarded, say, small_text

_NONE = "none"
_PICKING_HINT = "In the picture of one camera, and on scans in 3-D; not while all cameras are side by side."
_HELP = (
    "Click a vertex on a scan, then the same place in the picture of two or more cameras, all at one frame. Three or "
    "more of each arch, spread over it: front teeth and both sides. Wheel: zoom; right button: move."
)


class PicksPanel:
    """Hold the widgets of the picks.

    Attributes:
        book: the picks.
        side: that the scans in front of the picture show, one of `picking_layout.SIDES`.
        scans_shown: there are scans in front of the picture.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        capture: ViewedCapture,
        footage: FootagePanel,
        turned: Callable[[], None],
        changed: Callable[[], None],
    ) -> None:
        """Make the widgets in the present container; call `turned` for another side, `changed` for other picks."""
        self._client, self._capture, self._footage = client, capture, footage
        self._turned, self._changed = turned, changed
        self.book, self.side = PickBook(capture.picks), "front"
        self._saved, self.scans_shown = capture.picks, False
        self._fit = ""
        gui = client.gui
        gui.add_html(small_text(_HELP))
        self.picking = gui.add_checkbox("clicks set picks", capture.tracks is None, hint=_PICKING_HINT)
        self.picking.on_update(guarded(client, self._turn))
        self.sides = gui.add_button_group("scans", tuple(SIDES))
        self.sides.on_click(guarded(client, self._choose_side))
        self.chosen = gui.add_dropdown("pick", (_NONE,))
        self.chosen.on_update(guarded(client, self._choose))
        self.edit = gui.add_button_group("take away", ("pixel", "pick", "all"))
        self.edit.on_click(guarded(client, self._take_away))
        self.go = gui.add_button("show their frame")
        self.go.on_click(guarded(client, self._go))
        self._list = gui.add_html("")
        self.write = gui.add_button("write to the capture file", icon=viser.Icon.DEVICE_FLOPPY)
        self.write.on_click(guarded(client, self._write))
        self.refresh()

    def say_fit(self, words: str) -> None:
        """Show a sentence about how well the picks agree."""
        self._fit = words
        self.refresh()

    def refresh(self) -> None:
        """Update the widgets from the picks."""
        book = self.book
        names = tuple(book.name(k) for k in range(len(book.picks)))
        if self.chosen.options != (_NONE, *names):
            self.chosen.options = (_NONE, *names)
        assign(self.chosen, _NONE if book.selected is None else names[book.selected])
        some, lacks = bool(book.picks), book.lacks()
        enable(self.picking, not self._footage.on_wall)
        enable(self.sides, self.scans_shown)
        enable(self.chosen, some)
        enable(self.edit, some)
        enable(self.go, book.frame is not None)
        enable(self.write, not lacks)
        lines = [f"frame {book.frame}" if book.frame is not None else "no pixels yet"]
        for number, pick in enumerate(book.picks):
            text = f"{names[number]}, vertex {pick.vertex}: {', '.join(pick.views) or 'no pixels yet'}"
            lines.append(f"<b>{text}</b>" if number == book.selected else text)
        lines.append(lacks or "complete")
        if self._fit:
            lines.append(self._fit)
        self._list.content = small_text("<br>".join(lines))

    async def _turn(self, _: object) -> None:
        self._turned()

    async def _choose_side(self, event: Choice) -> None:
        self.side = event.target.value
        self._turned()

    async def _choose(self, _: object) -> None:
        number = self.chosen.options.index(self.chosen.value) - 1
        self.book.selected = None if number < 0 else number
        self._changed()

    async def _take_away(self, event: Choice) -> None:
        if event.target.value == "pixel":
            self.book.forget_view(self._footage.view)
        elif event.target.value == "pick":
            self.book.remove()
        else:
            self.book.clear()
        self._changed()

    async def _go(self, _: object) -> None:
        if self.book.frame is None:
            raise ValueError("the picks have no pixels yet, so they belong to no frame")
        self._footage.go_to(self.book.frame)

    async def _write(self, _: object) -> None:
        picks = self.book.bootstrap()
        await asyncio.to_thread(self._capture.save_picks, picks, self._saved)
        self._saved = picks
        count = f"{len(picks.upper)} picks above and {len(picks.lower)} below"
        say(self._client, "Written", f"{count}, frame {picks.frame}")
