"""The panel that corrects with a brush which parts of the scans are crown, gum and base."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import viser

from jawusd.viewer.scan_brush import BRUSHES, ScanBrush
from jawusd.viewer.viewed import ViewedCapture
from jawusd.viewer.widgets import Choice, enable, guarded, say, small_text

_HELP = (
    "White is crown, red gum, blue base. Click on a scan to paint around the place clicked. Only the line between "
    "crown and gum matters to the tracking; what lies below the gum does not."
)
_RADIUS_MM = (0.3, 8.0, 0.1, 1.5)  # smallest, largest, step, first


class ScanLabelsPanel:
    """Hold the widgets of the brush.

    Attributes:
        brush: the labels.
        label: that is painted.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        capture: ViewedCapture,
        turned: Callable[[], None],
        painted: Callable[[str], None],
    ) -> None:
        """Make the widgets in the present container; call `turned` on or off, `painted` with an arch to draw again."""
        self._client, self._capture, self._turned, self._painted = client, capture, turned, painted
        self.brush = ScanBrush(capture.scans, capture.labels)
        self.label = BRUSHES["crown"]
        gui = client.gui
        gui.add_html(small_text(_HELP))
        self.painting = gui.add_checkbox("clicks paint", False)
        self.painting.on_update(guarded(client, self._turn))
        self.kinds = gui.add_button_group("paint", tuple(BRUSHES))
        self.kinds.on_click(guarded(client, self._choose))
        low, high, step, first = _RADIUS_MM
        self.radius = gui.add_slider("radius [mm]", low, high, step, first)
        self.undo = gui.add_button("undo", icon=viser.Icon.ARROW_BACK_UP)
        self.undo.on_click(guarded(client, self._undo))
        self._state = gui.add_html("")
        self.write = gui.add_button("save the labels", icon=viser.Icon.DEVICE_FLOPPY)
        self.write.on_click(guarded(client, self._write))
        self._say_state()

    def click(self, arch: str, vertex: int) -> None:
        """Paint around a vertex."""
        if self.brush.paint(arch, vertex, self.radius.value, self.label):
            self._painted(arch)
        self._say_state()

    def _say_state(self) -> None:
        enable(self.kinds, self.painting.value)
        enable(self.radius, self.painting.value)
        enable(self.undo, self.brush.strokes > 0)
        name = next(name for name, label in BRUSHES.items() if label == self.label)
        unsaved = " and ".join(sorted(self.brush.changed))
        state = f"paints {name}; {self.brush.strokes} strokes; "
        self._state.content = small_text(state + (f"not saved: {unsaved}" if unsaved else "all saved"))

    async def _turn(self, _: object) -> None:
        self._say_state()
        self._turned()

    async def _choose(self, event: Choice) -> None:
        self.label = BRUSHES[event.target.value]
        self._say_state()

    async def _undo(self, _: object) -> None:
        arch = self.brush.undo()
        if arch is not None:
            self._painted(arch)
        self._say_state()

    async def _write(self, _: object) -> None:
        """Save both arches: what was looked at and left as it is, is accepted as well."""
        paths = []
        for arch, labels in self.brush.labels.items():
            paths.append(await asyncio.to_thread(self._capture.save_labels, arch, labels.copy()))
            self.brush.saved(arch)
        self._say_state()
        say(self._client, "Written", f"{' and '.join(path.name for path in paths)}; track or build again to use them")
