"""The page of a capture and its server; every visitor has a separate view and separate picks."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np
import viser

from jawusd.base.arrays import Array
from jawusd.base.errors import JawusdError
from jawusd.formats.capture import Bootstrap
from jawusd.geometry import make_transform, transform_points
from jawusd.geometry.se3 import se3_inverse
from jawusd.viewer.capture_panels import ALL, FootagePanel, PicksPanel
from jawusd.viewer.capture_scene import UP, CaptureScene, set_first_view
from jawusd.viewer.picking import ARCHES, PickingLayout, fit_view, hit_vertex, region_around
from jawusd.viewer.scan_labels import BRUSHES, ScanLabelsPanel
from jawusd.viewer.scene import PHONE
from jawusd.viewer.server import PageServer
from jawusd.viewer.viewed import Image, Poses, Region, ViewedCapture
from jawusd.viewer.widgets import Client, begin_panel, errors_shown, guarded, limit_uploads

_PANEL_PX = 370
_SLOW_S = 0.3  # decoding time after which "loading" is displayed
_USUAL_MM, _USUAL_WEIGHT = 250.0, 1e-3  # mean and weight of the prior on the distance from a camera to the mouth
_SPACE_SIDE = (0.9, -0.7, 0.0)  # offset of the 3-D view's direction from that of the first camera


class CapturePage:
    """Connect a page's widgets with a capture.

    `layout` is that of the current image, None before the first one; `poses` are T_page_scan (4, 4) of the displayed
    scans, by arch; `drawn` is the number of the redraw request that was drawn last.
    """

    def __init__(self, client: Client, capture: ViewedCapture) -> None:
        self.client, self._capture = client, capture
        gui = client.gui
        begin_panel(client, capture.source.name)
        self.scene = CaptureScene(client, capture)
        self.layout: PickingLayout | None = None
        self.poses: dict[str, Array] = {}
        self.drawn = self._wanted = 0
        self._aim = True
        self._drawing: asyncio.Task[None] | None = None
        self._of_picks: tuple[Bootstrap, Poses | None] | None = None
        tabs = gui.add_tab_group()
        with tabs.add_tab("Footage"):
            self.footage = FootagePanel(client, capture, self._turn_camera, self.refresh)
        with tabs.add_tab("Picks"):
            self.picks = PicksPanel(client, capture, self.footage, self.turn, self.refresh)
        with tabs.add_tab("Scans"):
            self.labels = ScanLabelsPanel(client, capture, self._turn_painting, self._show_labels)
        limit_uploads(client, None)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_PX)
        client.scene.on_click()(guarded(client, self._clicked))  # type: ignore[arg-type]  # viser awaits coroutines
        self.refresh()

    def turn(self) -> None:
        """Redraw, and move the virtual camera so that everything is in view."""
        self._aim = True
        self.refresh()

    def _turn_camera(self) -> None:
        if self.picks.picking.value and self.footage.view in self._capture.sizes_px:
            self.picks.book.select_incomplete(self.footage.view)
        self.turn()

    def refresh(self) -> None:
        """Draw the current state; merge the requests that arrive while drawing into one."""
        self._wanted += 1
        if self._drawing is None or self._drawing.done():
            self._drawing = asyncio.get_running_loop().create_task(self._draw())

    @property
    def busy(self) -> bool:
        """Return whether a redraw is pending."""
        return self.drawn != self._wanted

    async def _draw(self) -> None:
        while self.drawn != self._wanted:
            wanted, aim = self._wanted, self._aim
            self._aim = False
            slow = asyncio.get_running_loop().call_later(_SLOW_S, self.footage.show_loading, True)
            with errors_shown(self.client):
                await self._fit_picks()
                await self._draw_once(aim)
            slow.cancel()
            self.footage.show_loading(False)
            self.drawn = wanted

    async def _draw_once(self, aim: bool) -> None:
        capture, footage = self._capture, self.footage
        view, frame, look = footage.view, footage.frame, footage.look
        tracked = self._poses_at(frame)
        if footage.in_space:
            names = [name for name in capture.sizes_px if name in capture.cameras]
            for name in names:
                image = await asyncio.to_thread(capture.picture, name, frame, tracked, look)
                self.scene.show_thumbnail(name, image)
            default = self._default_pose()
            shown = tracked or (default, default)
            self.poses = {arch: self.scene.T_page_world @ T for arch, T in zip(ARCHES, shown, strict=True)}
        else:
            if footage.on_wall:
                image = await asyncio.to_thread(capture.wall, frame, tracked, look, self._show_partly())
            else:
                image = await asyncio.to_thread(capture.picture, view, frame, tracked, look)
            if aim or self.layout is None:
                self.layout = await asyncio.to_thread(self._lay_out, view, frame)
            self.scene.show_picture(image, self.layout)
            self.poses = {}
            self.picks.scans_shown = (self.picks.picking.value or self.labels.painting.value) and not footage.on_wall
            if self.picks.scans_shown:
                self.poses = self.layout.scan_poses(capture.scans, capture.T_anatomical_skull, self.picks.side)
        self.scene.place(footage.in_space, self.poses)
        footage.follow(frame)
        camera, layout = (None, None) if footage.in_space or footage.on_wall else (view, self.layout)
        self.scene.show_marks(self.picks.book, camera, frame, layout)
        self.picks.refresh()
        if aim:
            self._look()

    def _show_partly(self) -> Callable[[Image], None] | None:
        """Return a thread-safe callback that shows a partial image of all cameras; None during playback."""
        if self.footage.player.playing:
            return None
        loop, layout = asyncio.get_running_loop(), self._lay_out(ALL, self.footage.frame)

        def show(image: Image) -> None:
            loop.call_soon_threadsafe(self.scene.show_picture, image, layout)

        return show

    def _look(self) -> None:
        camera = self.client.camera
        aspect = camera.image_width / camera.image_height
        seen = [
            transform_points(T, self._capture.scans[arch].vertices)
            for arch, T in self.poses.items()
            if np.isfinite(T).all()
        ]
        away = np.array([0.0, 0.0, -1.0])
        if self.footage.in_space:
            centres = [c.centre_world() for c in self._capture.cameras.values()]
            seen.append(transform_points(self.scene.T_page_world, np.array(centres)))
            away += _SPACE_SIDE
        elif self.layout is not None:
            seen.append(self.layout.corners())
        points = np.vstack(seen)
        if aspect < PHONE:  # on a phone, the panel covers the lower half
            points = np.vstack([points, points - np.ptp(points @ UP) * np.array(UP)])
        self.scene.look(*fit_view(points, away, UP, aspect))

    def _poses_at(self, frame: int) -> Poses | None:
        """Return T_world_upper and T_world_lower of a frame: tracked or, if untracked, fitted to that frame's picks."""
        tracked = self._capture.tracked_poses(frame)
        if tracked is None and self._of_picks is not None and self._of_picks[0].frame == frame:
            return self._of_picks[1]
        return tracked

    async def _fit_picks(self) -> None:
        """Fit poses to the picks if they have changed and are complete."""
        book = self.picks.book
        if book.missing() or book.frame is None:
            if self._of_picks is not None:
                self.picks.show_fit("")
            self._of_picks = None
            return
        picks = book.bootstrap()
        if not self._capture.cameras or (self._of_picks is not None and self._of_picks[0] == picks):
            return
        try:
            poses, wrong = await asyncio.to_thread(self._capture.poses_of_picks, picks)
            self._of_picks = picks, poses
            self.picks.show_fit(f"inconsistent picks: {', '.join(wrong)}" if wrong else "the picks are consistent")
        except JawusdError as error:
            self._of_picks = picks, None
            self.picks.show_fit(error.statement())

    def _lay_out(self, view: str, frame: int) -> PickingLayout:
        """Return the layout of one camera's image, or of all cameras side by side."""
        capture = self._capture
        if view not in capture.sizes_px:
            width, height = capture.all_cameras.size_px
            return PickingLayout((width, height), (0.0, 0.0, width - 1.0, height - 1.0))
        return PickingLayout(capture.sizes_px[view], self._region(view, frame))

    def _region(self, camera: str, frame: int) -> Region:
        """Return the region of a camera's image to show: around the teeth if their position is known."""
        capture, size = self._capture, self._capture.sizes_px[camera]
        tracked = self._poses_at(frame)
        if tracked is not None and camera in capture.cameras and all(np.isfinite(T).all() for T in tracked):
            seen = [
                capture.cameras[camera].project(
                    transform_points(T, mesh.vertices[np.unique(mesh.faces[capture.crowns[arch]])])
                )
                for T, (arch, mesh) in zip(tracked, capture.scans.items(), strict=True)
            ]
            return region_around(np.vstack(seen), size)
        found = capture.teeth_region(camera, frame)
        if found is not None:
            return region_around(np.reshape(found, (2, 2)), size)
        pixels = [pick.views[camera] for pick in self.picks.book.picks if camera in pick.views]
        return region_around(pixels, size) if len(pixels) > 1 else (0.0, 0.0, size[0] - 1.0, size[1] - 1.0)

    def _default_pose(self) -> Array:
        """Return T_world_scan for untracked scans: where the optical axes intersect, facing the first camera."""
        cameras = list(self._capture.cameras.values())
        axes = np.stack([camera.T_cam_world[2, :3] for camera in cameras])
        across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
        centres = np.stack([camera.centre_world() for camera in cameras])
        # A weak prior determines the distance if the axes are nearly parallel.
        usual = centres[0] + _USUAL_MM * axes[0]
        A = across.sum(axis=0) + _USUAL_WEIGHT * np.eye(3)
        met = np.linalg.solve(A, np.einsum("nij,nj->i", across, centres) + _USUAL_WEIGHT * usual)
        T_world_cam = se3_inverse(cameras[0].T_cam_world)
        facing = make_transform(T_world_cam[:3, :3] @ np.diag([1.0, -1.0, -1.0]), met)
        return facing @ self._capture.T_anatomical_skull

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        """Pick the vertex or pixel under the pointer, or paint the scan there."""
        if not self.picks.picking.value and not self.labels.painting.value:
            return
        ray, hits = (event.ray_origin, event.ray_direction), []
        for arch, T in self.poses.items():
            hit = hit_vertex(self._capture.scans[arch], T, *ray)
            if hit is not None:
                hits.append((hit[1], arch, hit[0]))
        if self.labels.painting.value:
            if hits:
                self.labels.click(*min(hits)[1:])
            return
        if hits:
            self.picks.book.add(*min(hits)[1:])
        elif self.footage.view in self._capture.sizes_px and self.layout is not None:
            pixel = self.layout.pixel(*ray)
            if pixel is None:
                return
            self.picks.book.see(self.footage.view, self.footage.frame, pixel)
        self.refresh()

    def _turn_painting(self) -> None:
        if self.labels.painting.value:
            for arch in ARCHES:
                self._show_labels(arch)
        self.turn()

    def _show_labels(self, arch: str) -> None:
        brush = self.labels.brush
        self.scene.show_labels(arch, *(brush.faces_with(arch, label) for label in BRUSHES.values()))

    def close(self) -> None:
        """Stop the background tasks of this page."""
        self.footage.player.close()
        if self._drawing is not None:
            self._drawing.cancel()


class CaptureViewer(PageServer):
    """Server of a capture."""

    def __init__(self, capture: ViewedCapture, host: str, port: int) -> None:
        self._capture = capture
        super().__init__(capture.source.name, host, port)
        set_first_view(self._server)

    async def _page(self, client: Client) -> CapturePage:
        return CapturePage(client, self._capture)
