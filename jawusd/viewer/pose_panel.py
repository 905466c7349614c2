"""Panels that control the pose: sliders with pose-dependent limits, read-outs, pins, undo, views, tooth contacts."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import viser

from jawusd.base.arrays import Array
from jawusd.base.errors import JawusdError
from jawusd.evaluator import JawRig
from jawusd.evaluator.contact import AUTHORED_MM
from jawusd.formats.mesh import DEEP, TOUCHING
from jawusd.geometry import LANDMARKS
from jawusd.viewer.plots import GREEN, VERMILION
from jawusd.viewer.readouts import Readout, nearest_captured
from jawusd.viewer.scene import PRESETS, JawScene
from jawusd.viewer.session import Session
from jawusd.viewer.viewed import Callback, Image
from jawusd.viewer.widgets import Client, add_dark_checkbox, assign, guarded, small_text

STEP_MM = 0.01
NAMES = ("opening", "laterotrusion", "protrusion")
_HINTS = (
    "Opening d1 [mm] along this subject's own path.",
    "Laterotrusion d2 [mm] at the incisal point, + to the subject's left.",
    "Protrusion d3 [mm] relative to this subject's opening path, which leads backwards: + in front of it, - behind it.",
)
_DRAG_HELP = small_text(
    "You can also drag the jaw: the grabbed point follows the pointer as far as this subject can move. In depth it "
    "follows this subject's opening path; while you hold Shift, it keeps its depth.",
    "opacity:.7",
)
_KEYS_HELP = small_text("Undo: Ctrl+Z, redo: Ctrl+Shift+Z (Mac: Cmd)", "opacity:.7")
_MARGIN_HELP = "Distance in d from the pose to this subject's bound; negative outside."
_CAPTURED_HELP = "Distance in d to the nearest captured pose: the larger it is, the more the model extrapolates."
_VALID_HELP = "Valid range of this parameter at the current values of the others."
_MOVED_HELP = "Displacement from the closed bite, in anatomical axes: to the subject's left, down, forward."
_GHOSTS_HELP = "Draw the captured poses that are nearest to this one, at least 1 mm apart in d, faintly."
# Extension of the sliders beyond the rig's ranges if poses outside the bound are allowed, as a fraction of the range.
_BEYOND = 0.25
_PINNABLE = tuple(name for name in LANDMARKS if not name.startswith("molar"))
_LEGEND = "<br>".join(
    f'<span style="display:inline-block;width:10px;height:10px;background:rgb{mark.color}"></span> {mark.meaning}'
    for mark in (DEEP, *TOUCHING)
)
_NOTHING = np.full((8, 8, 3), 255, np.uint8)


class PosePanel:
    """Widgets that pose the jaw; `sliders` set d1, d2 and d3 [mm]."""

    def __init__(self, client: Client, session: Session, scene: JawScene, changed: Callback) -> None:
        """Add the widgets to the current container; call `changed` after every change."""
        self._client, self._session, self._scene, self._changed = client, session, scene, changed
        gui = client.gui
        self.sliders = [self._add_slider(index, label) for index, label in enumerate(f"{name} [mm]" for name in NAMES)]
        self.keep_valid = gui.add_checkbox("keep valid", True, hint="Stop sliders at the bound of this subject.")
        self.keep_valid.on_update(guarded(client, self._keep))
        gui.add_html(_DRAG_HELP)
        self.reading = gui.add_html("")
        history = gui.add_button_group("history", ("undo", "redo", "close jaw"))
        history.on_click(guarded(client, lambda event: self._step(event.target.value)))
        gui.add_html(_KEYS_HELP)
        with gui.add_folder("Pin while dragging"):
            self.pins = {name: self._add_pin(name) for name in _PINNABLE}
        with gui.add_folder("View"):
            views = gui.add_button_group("look from", tuple(PRESETS))
            views.on_click(guarded(client, lambda event: scene.look(event.target.value)))
            paths = gui.add_checkbox("paths and captured positions", True)
            paths.on_update(guarded(client, lambda _: scene.show_paths(paths.value)))
            self.ghosts = gui.add_checkbox("nearest captured poses", False, hint=_GHOSTS_HELP)
            self.ghosts.on_update(guarded(client, lambda _: self._draw_ghosts()))
            add_dark_checkbox(client)
        undo = gui.add_command("Undo", hotkey="Z", modifier="cmd/ctrl")
        undo.on_trigger(guarded(client, lambda _: self._step("undo")))
        redo = gui.add_command("Redo", hotkey="Z", modifier="cmd/ctrl+shift")
        redo.on_trigger(guarded(client, lambda _: self._step("redo")))

    def _add_slider(self, index: int, label: str) -> viser.GuiSliderHandle[float]:
        slider = self._client.gui.add_slider(label, -1.0, 1.0, STEP_MM, 0.0, hint=_HINTS[index])

        def moved(_: object) -> None:
            self._session.set_parameter(index, float(slider.value))
            self._changed()

        slider.on_update(guarded(self._client, moved))
        return slider

    def _add_pin(self, name: str) -> viser.GuiCheckboxHandle:
        box = self._client.gui.add_checkbox(name.replace("_", " "), False)

        def pinned(_: object) -> None:
            self._session.set_pin(name, bool(box.value))
            self._changed()

        box.on_update(guarded(self._client, pinned))
        return box

    def _keep(self, _: object) -> None:
        self._session.set_keep_valid(self.keep_valid.value)
        self._changed()

    def _step(self, where: str) -> None:
        if where == "undo":
            self._session.undo()
        elif where == "redo":
            self._session.redo()
        else:
            self._session.set_pose([0.0, 0.0, 0.0])
        self._changed()

    def _draw_ghosts(self) -> None:
        """Draw the captured poses nearest to the current one if they are switched on."""
        rig, d = self._session.rig, self._session.d
        near = nearest_captured(rig, d) if self.ghosts.value else np.zeros((0, 3))
        self._scene.show_ghosts(rig.pose(near))

    def refresh(self, readout: Readout) -> None:
        """Update sliders, pins and read-outs from the session."""
        session = self._session
        limits = session.limits()
        ends = slider_ends(limits, session.rig.d_range, session.keep_valid)
        for slider, (low, high), value in zip(self.sliders, ends, session.work.d, strict=True):
            low, high = min(low, _outwards(value, -1)), max(high, _outwards(value, 1))
            if (slider.min, slider.max) != (low, high):
                slider.min, slider.max = low, high
            if abs(slider.value - value) > 0.5 * STEP_MM:
                assign(slider, value)
        for name, box in self.pins.items():
            assign(box, any(pin.name == name for pin in session.work.pins))
        self.reading.content = reading_html(readout, session.work.d, limits)
        if self.ghosts.value:
            self._draw_ghosts()


def slider_ends(limits: Array, d_range: Array, keep_valid: bool) -> list[tuple[float, float]]:
    """Return the lower and the upper end of each of the three sliders [mm].

    They are the valid limits (3, 2) [mm] at the current pose, rounded inwards to the slider step, or without
    `keep_valid` the overall range (3, 2) [mm] of the rig, widened.
    """
    if keep_valid:
        return [(_outwards(low, 1), _outwards(high, -1)) for low, high in limits]
    beyond = [(low - _BEYOND * (high - low), high + _BEYOND * (high - low)) for low, high in d_range]
    return [(_outwards(low, -1), _outwards(high, 1)) for low, high in beyond]


def _outwards(value: float, sign: int) -> float:
    """Return a value rounded down (sign -1) or up (1) to the slider step, ignoring rounding noise."""
    return round(sign * math.ceil(sign * value / STEP_MM - 1e-6) * STEP_MM, 6)


def verdict_html(readout: Readout) -> str:
    """Return HTML that shows in words and colour whether a pose is inside the bound."""
    color, verdict = (GREEN, "inside the bound") if readout.inside else (VERMILION, "OUTSIDE the bound")
    margin = f'<span title="{_MARGIN_HELP}">margin {_plain(readout.margin_mm)} mm</span>'
    return small_text(f'<b style="color:{color}">&#9679; {verdict}</b>, {margin}', "padding-top:6px")


def reading_html(readout: Readout, d: tuple[float, float, float], limits: Array) -> str:
    """Return the measures of a pose as HTML."""
    captured = f"{readout.captured_mm:.2f} mm" if math.isfinite(readout.captured_mm) else "no captured poses"
    rows = [
        ("incisal point moved", _moved(readout.incisor_mm), _MOVED_HELP),
        ("left condyle moved", _moved(readout.condyle_left_mm), _MOVED_HELP),
        ("right condyle moved", _moved(readout.condyle_right_mm), _MOVED_HELP),
        ("nearest captured", captured, _CAPTURED_HELP),
        *((f"valid {name}", _span(d[i], *limits[i]), _VALID_HELP) for i, name in enumerate(NAMES)),
    ]
    style = "opacity:.7;padding-right:8px;white-space:nowrap"
    cells = "".join(
        f'<tr title="{words}" style="cursor:help"><td style="{style}">{name}</td><td>{text}</td></tr>'
        for name, text, words in rows
    )
    foot = '<div style="opacity:.7">L, D, F: to the left, down, forward [mm]</div>'
    return small_text(f'<div style="overflow-x:auto"><table>{cells}</table></div>{foot}', "line-height:1.35")


def _plain(value: float) -> str:
    """Format a length in mm with two decimals and no negative zero."""
    return f"{round(value, 2) + 0.0:.2f}"


def _span(value: float, low: float, high: float) -> str:
    text = f"{_plain(low)} to {_plain(high)} mm"
    inside = low - STEP_MM <= value <= high + STEP_MM
    return text if inside else f'<b style="color:{VERMILION}">{text}</b>'


def _moved(moved_mm: tuple[float, float, float]) -> str:
    left, up, forward = moved_mm
    return " ".join(f"{word} {_plain(value)}" for word, value in (("L", left), ("D", -up), ("F", forward)))


class ContactPanel:
    """Image of both arches with their contacts; it is drawn only while it is switched on."""

    def __init__(self, client: Client, rig: JawRig, draw: Callable[[Array], Image], changed: Callback) -> None:
        """Add the widgets to the current container; call `changed` when the image is switched on or off."""
        self._rig, self._draw, self._changed = rig, draw, changed
        self._drawn: tuple[float, float, float] | None = None
        gui = client.gui
        self.shown = gui.add_checkbox("articulating paper", False, hint="Mark where the teeth touch in this pose.")
        self.shown.on_update(guarded(client, self._switch))
        self.picture = gui.add_image(_NOTHING, format="png", visible=False)
        self.text = gui.add_html("", visible=False)

    def _switch(self, _: object) -> None:
        self.picture.visible = self.text.visible = self.shown.value
        self._changed()

    def refresh(self, d: tuple[float, float, float]) -> None:
        """Show the contacts at parameters d [mm] if the image is switched on."""
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
        foot = "Upper and lower teeth, front teeth at the top, the subject's left on the right."
        self.text.content = small_text(f"{head}{_LEGEND}<br>{foot}", "line-height:1.35")
        self._drawn = d
