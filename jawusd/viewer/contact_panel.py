"""The panel that shows the contacts of the teeth in the present pose, as articulating paper does."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import JawusdError
from jawusd.evaluator import JawRig
from jawusd.evaluator.contact import AUTHORED_MM
from jawusd.formats.contact import DEEP, TOUCHING
from jawusd.viewer.plots import GREEN, VERMILION
from jawusd.viewer.widgets import guarded, small_text

_LEGEND = "<br>".join(
    f'<span style="display:inline-block;width:10px;height:10px;background:rgb{mark.color}"></span> {mark.meaning}'
    for mark in (DEEP, *TOUCHING)
)
_NOTHING = np.full((8, 8, 3), 255, np.uint8)


class ContactPanel:
    """Hold the picture of both arches; it is drawn only while it is switched on."""

    def __init__(
        self,
        client: viser.ClientHandle,
        rig: JawRig,
        draw: Callable[[Array], NDArray[np.uint8]],
        changed: Callable[[], None],
    ) -> None:
        """Make the widgets in the present container; call `changed` when the picture is switched on or off."""
        self._rig, self._draw, self._changed = rig, draw, changed
        self._drawn: tuple[float, float, float] | None = None
        gui = client.gui
        self.shown = gui.add_checkbox("articulating paper", False, hint="Mark where the teeth touch in this pose.")
        self.shown.on_update(guarded(client, self._switch))
        self.picture = gui.add_image(_NOTHING, format="png", visible=False)
        self.text = gui.add_html("", visible=False)

    async def _switch(self, _: object) -> None:
        self.picture.visible = self.text.visible = self.shown.value
        self._changed()

    def refresh(self, d: tuple[float, float, float]) -> None:
        """Show the contacts of a pose [mm] if the picture is switched on."""
        if not self.shown.value or d == self._drawn:
            return
        try:
            self.picture.image = self._draw(np.array(d))
        except JawusdError as error:
            self.text.content = small_text(error.statement(), f"color:{VERMILION}")
            return
        clear = float(self._rig.clearance(d).clearance_mm)
        color, word = (GREEN, "") if clear >= -AUTHORED_MM else (VERMILION, ": teeth collide")
        head = f'<div style="color:{color}">clearance {clear:.2f} mm{word}</div>'
        foot = "Upper and lower teeth, fronts up, the subject's left on the right."
        self.text.content = small_text(f"{head}{_LEGEND}<br>{foot}", "line-height:1.35")
        self._drawn = d
