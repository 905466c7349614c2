"""The page of a rig, with the footage of its take; every visitor has a separate session."""

from __future__ import annotations

import asyncio
from html import escape
from typing import Literal

import numpy as np
import viser

from jawusd.evaluator import JawRig
from jawusd.geometry.se3 import transform_point
from jawusd.viewer.motion_panel import FilePanel, MotionPanel, Playback
from jawusd.viewer.plots import VERMILION, bound_plot, posselt_plot, posselt_point
from jawusd.viewer.pose_panel import ContactPanel, PosePanel, verdict_html
from jawusd.viewer.readouts import landmark_places, rest_places
from jawusd.viewer.scene import FIRST_VIEW, PHONE, JawScene, set_lens
from jawusd.viewer.session import Session
from jawusd.viewer.viewed import Image, ViewedActor, ViewedFootage
from jawusd.viewer.widgets import Client, assign, begin_panel, errors_shown, guarded, small_text

#: Entry of the menu with which no footage is shown.
OFF = "off"
_EMPTY: Image = np.full((3, 4, 3), 255, np.uint8)


class TakeFootagePanel:
    """Menu of the cameras, and the image of the selected camera; frames outside the take show no image.

    Images are decoded outside the event loop. During playback, frames that would arrive late are left out. `drawn` is
    the camera and frame of the displayed image.
    """

    def __init__(self, client: Client, footage: ViewedFootage) -> None:
        """Add the widgets to the current container; phones start without footage."""
        self._client, self._footage = client, footage
        self._loop = asyncio.get_running_loop()
        self._frame = 0
        self._drawing: asyncio.Task[None] | None = None
        self.drawn: tuple[str, int] | None = None
        phone = client.camera.image_width < PHONE * client.camera.image_height
        choices = (OFF, *footage.cameras)
        self.camera = client.gui.add_dropdown("footage", choices, initial_value=choices[0 if phone else 1])
        self.camera.on_update(guarded(client, lambda _: self._start(self._frame)))
        self._image = client.gui.add_image(_EMPTY, format="jpeg", visible=False)

    def show(self, frame: float) -> None:
        """Show the image of the nearest whole frame as soon as it is decoded; any thread may call this."""
        self._loop.call_soon_threadsafe(self._start, round(frame))

    def _start(self, frame: int) -> None:
        self._frame = frame
        if self._drawing is None or self._drawing.done():
            self._drawing = self._loop.create_task(self._draw())

    def _wanted(self) -> tuple[str, int] | None:
        first, last = self._footage.frames
        if self.camera.value == OFF or not first <= self._frame <= last:
            return None
        return self.camera.value, self._frame

    async def _draw(self) -> None:
        """Draw until the image is the wanted one; an error is shown once, and turns the footage off."""
        while (wanted := self._wanted()) != self.drawn:
            if wanted is not None:
                image = None
                with errors_shown(self._client):
                    image = await asyncio.to_thread(self._footage.picture, *wanted)
                if image is None:
                    assign(self.camera, OFF)
                    wanted = None
                else:
                    self._image.image = image
            self.drawn = wanted
            self._image.visible = wanted is not None

    def close(self) -> None:
        """Stop drawing."""
        if self._drawing is not None:
            self._drawing.cancel()


#: Keyboard key with which a dragged point keeps its depth instead of following the habitual path.
FREE_DEPTH: Literal["shift"] = "shift"
_PANEL_PX, _PLOTS_PX = 350, 310
_PLACEHOLDER = small_text(
    "<b>The bone is estimated:</b> the rig was built without a mandible mesh. It shows the motion of teeth and "
    "condyles, not the shape of the bone.",
    f"color:{VERMILION}",
)
_NO_CONTACTS = small_text("The scans do not define the occlusion, so tooth collisions are not prevented.", "opacity:.7")
_PLOT_HELP = (
    '<div style="font-size:11px;opacity:.7;padding:0 12px">blue: bound of this subject; dashed: outline of the '
    "captured poses; grey: captured poses</div>"
)


class StaticPlots:
    """Static parts of a rig's plots, drawn once for all pages."""

    def __init__(self, rig: JawRig) -> None:
        self.rest = rest_places(rig)
        self.bounds = {axis: bound_plot(rig, axis) for axis in (1, 2)}
        self.posselt = {axis: posselt_plot(rig, axis) for axis in (2, 1)}


class PlotPanel:
    """The plots of one page, with the current pose marked: bounds and Posselt's figures."""

    def __init__(self, client: Client, rig: JawRig, static: StaticPlots) -> None:
        self._rig, self._static = rig, static
        panel = client.gui.add_panel()
        with panel.add_tab("Bounds and borders"):
            plots = [*static.bounds.values(), *static.posselt.values()]
            client.gui.add_html("".join(plot.definition() for plot in plots))
            self._moving = client.gui.add_html("")
            client.gui.add_html(_PLOT_HELP)
        panel.dock_left()
        panel.set_width(_PLOTS_PX)

    def refresh(self, d: tuple[float, float, float], inside: bool) -> None:
        """Mark the current pose [mm]."""
        static, places = self._static, landmark_places(self._rig, np.array(d))
        parts = [plot.with_point(d[0], d[axis], inside) for axis, plot in static.bounds.items()]
        parts += [
            plot.with_point(*posselt_point(places, static.rest, axis), inside) for axis, plot in static.posselt.items()
        ]
        self._moving.content = f'<div style="padding:0 6px">{"".join(parts)}</div>'


def begin_page(client: Client, actor: ViewedActor) -> JawScene:
    """Draw the jaw; the panels are added later."""
    begin_panel(client, actor.name)
    set_lens(client.camera)
    scene = JawScene(client, actor)
    scene.look(FIRST_VIEW)
    return scene


class Page:
    """Connect a page's widgets with its session."""

    def __init__(self, client: Client, scene: JawScene, actor: ViewedActor, static: StaticPlots) -> None:
        """Add the panels beside the jaw drawn by `begin_page`, and the marks on it."""
        self.client, self.scene = client, scene
        scene.add_marks(actor)
        self.session = Session(actor.rig, actor.fps)
        gui = client.gui
        self.built = gui.add_html(small_text(escape(actor.verdict))) if actor.verdict else None
        self.verdict = gui.add_html("")
        self.playback = Playback(client)
        self.footage = None if actor.footage is None else TakeFootagePanel(client, actor.footage)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Pose"):
            if "mandible" in actor.placeholders:
                gui.add_html(_PLACEHOLDER)
            self.pose = PosePanel(client, self.session, self.scene, self._posed)
            with gui.add_folder("Contacts of the teeth"):
                self.contacts = None
                if actor.contacts is None:
                    gui.add_html(_NO_CONTACTS)
                else:
                    self.contacts = ContactPanel(client, actor.rig, actor.contacts, self.refresh)
        with tabs.add_tab("Animate"):
            self.motion = MotionPanel(client, self.session, actor, self.playback, self.refresh)
        with tabs.add_tab("Files"):
            self.files = FilePanel(client, self.session, actor, self.motion, self.refresh)
        self.plots = PlotPanel(client, actor.rig, static)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_PX)
        for grip in self.scene.grips:
            for modifier in (None, FREE_DEPTH):
                grip.on_drag("left", modifier=modifier)(guarded(client, self._drag))
        self._opening: asyncio.Task[None] | None = None
        self.refresh()

    def play_take(self) -> None:
        """Start reading the captured take, if there is one, and play it afterwards."""
        self._opening = asyncio.get_running_loop().create_task(self.motion.play_take())

    def _posed(self) -> None:
        """Pause playback, which would overwrite the pose, and update everything."""
        self.motion.player.stop()
        self.refresh()

    def _drag(self, event: viser.SceneNodeDragEvent[viser.MeshHandle]) -> None:
        session, scene = self.session, self.scene
        if event.phase == "start":
            self.motion.player.stop()
            session.grab(scene.skull_from_page(event.start_position))
        if not session.dragging:
            return
        sight = None if event.modifier == FREE_DEPTH else scene.sight_to(event.end_position)
        pointer = session.drag_to(scene.skull_from_page(event.end_position), sight)
        held = session.grabbed_point()
        if event.phase == "end":
            session.release()
            held = None
        scene.show_grab(held, pointer)
        self.refresh()

    def refresh(self) -> None:
        """Refresh all widgets from the session state."""
        session = self.session
        readout = session.readout()
        with self.client.atomic():
            self.scene.move(session.pose(), readout.inside)
            self.scene.show_pins(
                {pin.name: transform_point(session.pose(), pin.p_mandible) for pin in session.work.pins}
            )
            self.verdict.content = verdict_html(readout)
            self.pose.refresh(readout)
            if self.contacts is not None:
                self.contacts.refresh(session.work.d)
            self.plots.refresh(session.work.d, readout.inside)
            self.motion.refresh()
        if self.footage is not None:
            self.footage.show(self.motion.frame)

    def close(self) -> None:
        """Stop playback, and drawing footage."""
        if self._opening is not None:
            self._opening.cancel()
        if self.footage is not None:
            self.footage.close()
        self.motion.player.close()
