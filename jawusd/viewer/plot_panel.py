"""The panel of plots that follow the jaw: bounds and Posselt's figures."""

from __future__ import annotations

import viser

from jawusd.evaluator import JawRig
from jawusd.viewer.plots import Plot, bound_plot, posselt_plot, posselt_point
from jawusd.viewer.readouts import landmark_places, rest_places


class StillPlots:
    """Draw what does not move in the plots of a rig, once for all pages."""

    def __init__(self, rig: JawRig) -> None:
        """Draw the four plots of a rig."""
        self.rest = rest_places(rig)
        self.bounds: dict[int, Plot] = {axis: bound_plot(rig, axis) for axis in (1, 2)}
        self.posselt: dict[int, Plot] = {axis: posselt_plot(rig, axis) for axis in (2, 1)}


class PlotPanel:
    """Hold the plots of one page."""

    def __init__(self, client: viser.ClientHandle, rig: JawRig, still: StillPlots) -> None:
        """Make the panel, docked at the left."""
        self._rig, self._still = rig, still
        panel = client.gui.add_panel()
        with panel.add_tab("Bounds and borders"):
            plots = [*still.bounds.values(), *still.posselt.values()]
            client.gui.add_html("".join(plot.definition() for plot in plots))
            self._moving = client.gui.add_html("")
            client.gui.add_html(
                '<div style="font-size:11px;opacity:.7;padding:0 12px">blue: bound of this person; dashed: outline of '
                "the captured poses; grey: captured poses</div>"
            )
        panel.dock_left()
        panel.set_width(310)

    def refresh(self, d: tuple[float, float, float], inside: bool) -> None:
        """Mark the present pose [mm]."""
        still = self._still
        parts = [plot.with_point(d[0], d[axis], inside) for axis, plot in still.bounds.items()]
        places = landmark_places(self._rig, list(d))
        parts += [
            plot.with_point(*posselt_point(places, still.rest, axis), inside) for axis, plot in still.posselt.items()
        ]
        self._moving.content = f'<div style="padding:0 6px">{"".join(parts)}</div>'
