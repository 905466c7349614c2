"""One visitor's page: a session of their own, and everything drawn from it."""

from __future__ import annotations

import viser

from jawusd.geometry.se3 import transform_point
from jawusd.viewer.actor import ViewedActor
from jawusd.viewer.file_panel import FilePanel
from jawusd.viewer.motion_panel import MotionPanel
from jawusd.viewer.notices import guarded
from jawusd.viewer.plot_panel import PlotPanel, StillPlots
from jawusd.viewer.plots import VERMILION
from jawusd.viewer.pose_panel import PosePanel
from jawusd.viewer.scene import JawScene
from jawusd.viewer.session import Session
from jawusd.viewer.theme import set_theme

_PANEL_PX = 350
_PLACEHOLDER = (
    f'<div style="font-size:12px;padding:2px 12px;color:{VERMILION}"><b>The mandible is a placeholder, no anatomy:</b> '
    "the rig was built without its mesh. It shows where the teeth and condyles go, not the bone.</div>"
)


def begin_page(client: viser.ClientHandle, actor: ViewedActor) -> JawScene:
    """Draw the jaw, without any panel."""
    set_theme(client.gui)
    client.gui.set_panel_label(actor.name)
    return JawScene(client, actor)


class Page:
    """Connect a page's widgets with its session.

    Attributes:
        session: what the visitor does.
        scene: the jaw in 3-D.
        pose, motion, files, plots: the panels.
    """

    def __init__(self, client: viser.ClientHandle, scene: JawScene, actor: ViewedActor, still: StillPlots) -> None:
        """Draw the panels beside the jaw that `begin_page` drew."""
        self.client, self.scene = client, scene
        self.session = Session(actor.rig, actor.fps)
        gui = client.gui
        tabs = gui.add_tab_group()
        with tabs.add_tab("Pose"):
            if "mandible" in actor.placeholders:
                gui.add_html(_PLACEHOLDER)
            self.pose = PosePanel(client, self.session, self.scene, self.refresh)
        with tabs.add_tab("Animate"):
            self.motion = MotionPanel(client, self.session, actor, self.refresh)
        with tabs.add_tab("Files"):
            self.files = FilePanel(client, self.session, actor, self.motion, self.refresh)
        self.plots = PlotPanel(client, actor.rig, still)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_PX)
        for grip in self.scene.grips:
            grip.on_drag(guarded(client, self._drag))
        self.refresh()

    async def _drag(self, event: viser.SceneNodeDragEvent) -> None:
        session, scene = self.session, self.scene
        if event.phase == "start":
            self.motion.player.stop()
            session.grab(scene.skull_from_page(event.start_position))
        if not session.dragging:
            return
        pointer = scene.skull_from_page(event.end_position)
        session.drag_to(pointer)
        held = session.held_place()
        if event.phase == "end":
            session.release()
            held = None
        scene.show_hold(held, pointer)
        self.refresh()

    def refresh(self) -> None:
        """Bring everything in line with the session."""
        session = self.session
        readout = session.readout()
        with self.client.atomic():
            self.scene.move(session.pose(), readout.inside)
            self.scene.show_pins(
                {pin.name: transform_point(session.pose(), pin.p_mandible) for pin in session.work.pins}
            )
            self.pose.refresh(readout)
            self.plots.refresh(session.work.d, readout.inside)
            self.motion.refresh()

    def close(self) -> None:
        """Stop what runs for this page."""
        self.motion.player.stop()
