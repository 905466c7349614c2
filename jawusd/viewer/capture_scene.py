"""3-D scene of a capture: an image with the scans in front of it, or the calibrated cameras around the scans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import viser

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import wxyz_from_matrix
from jawusd.geometry.se3 import se3_inverse
from jawusd.viewer.picking import ARCHES, FOV_RAD, PickBook, PickingLayout
from jawusd.viewer.scene import add_lights, set_pose
from jawusd.viewer.viewed import Image, ViewedCapture, for_view
from jawusd.viewer.widgets import Client

ENAMEL, GUM, BASE = (236, 229, 212), (196, 112, 108), (120, 135, 165)
#: Colours of picks by arch, as in the outlines, and colour of the selected pick.
ARCH_COLORS, SELECTED = {"upper": (255, 170, 0), "lower": (0, 200, 255)}, (255, 60, 200)
#: Up direction of the page.
UP = (0.0, -1.0, 0.0)
_MOST_FACES = 7_000  # maximum number of faces drawn per part of an arch; clicks are tested on the full scan
_MOST_PAINTED_FACES = 25_000  # maximum number of faces while labels are being edited
_JPEG_QUALITY = 88
_THUMB_PX = 480
_FRUSTUM_MM = 60.0  # distance from a camera's centre to its image
_FRUSTUM_COLOR = (120, 120, 120)
_BALL_MM = 0.7
_CROSS_MM = (0.35, 1.3)  # inner and outer radius of a cross
_FIRST_EYE_MM, _NEAR_MM, _FAR_MM = 300.0, 1.0, 10_000.0
_LIFT_MM = 0.05  # offset of marks in front of the image


class CaptureScene:
    """3-D scene of a capture in one page.

    The page frame has the axes of the first camera, so that images are upright; `T_page_world` has shape (4, 4).
    """

    def __init__(self, client: Client, capture: ViewedCapture) -> None:
        self._client, self._scene, self._capture = client, client.scene, capture
        scene = client.scene
        self.T_page_world = next((camera.T_cam_world for camera in capture.cameras.values()), np.eye(4))
        self._layout = scene.add_frame("/layout", show_axes=False)
        self._picture: viser.ImageHandle | None = None
        self._space = scene.add_frame("/space", show_axes=False, visible=False)
        self._frustums = {name: self._add_frustum(name) for name in capture.sizes_px if name in capture.cameras}
        self._arches = {arch: scene.add_frame(f"/{arch}", show_axes=False, visible=False) for arch in ARCHES}
        self._parts: dict[str, viser.MeshHandle] = {}
        for arch, crowns in capture.crowns.items():
            self._add_parts(arch, (("teeth", crowns, ENAMEL), ("gum", ~crowns, GUM)), _MOST_FACES)
        self._marks: list[viser.SceneNodeHandle] = []

    def _add_frustum(self, name: str) -> viser.CameraFrustumHandle:
        camera = self._capture.cameras[name]
        width, height = camera.size_px
        T = self.T_page_world @ se3_inverse(camera.T_cam_world)
        y = 0.5 * height / camera.K[1, 1]
        frustum = self._scene.add_camera_frustum(
            f"/space/{name}",
            fov=float(2 * np.arctan(y)),
            aspect=width / height,
            scale=float(_FRUSTUM_MM * np.cbrt(y * y * width / height / 3)),  # viser's scale sets the frustum's volume
            thickness=0.6,
            color=_FRUSTUM_COLOR,
            wxyz=wxyz_from_matrix(T[:3, :3]),
            position=T[:3, 3],
            cast_shadow=False,
            receive_shadow=False,
            format="jpeg",
        )
        self._scene.add_label(f"/space/{name}/name", name, anchor="bottom-center")
        return frustum

    def show_labels(self, arch: str, crown: Mask, gum: Mask, base: Mask) -> None:
        """Redraw a scan with the given crown, gum and base faces, masks of shape (F,)."""
        parts = ("teeth", crown, ENAMEL), ("gum", gum, GUM), ("base", base, BASE)
        with self._client.atomic():
            self._add_parts(arch, parts, _MOST_PAINTED_FACES)

    def _add_parts(self, arch: str, parts: Sequence[tuple[str, Mask, tuple[int, int, int]]], most: int) -> None:
        mesh = self._capture.scans[arch]
        for part, faces, color in parts:
            name = f"/{arch}/{part}"
            if name in self._parts:
                self._parts.pop(name).remove()
            if faces.any():
                small = for_view(type(mesh)(mesh.vertices, mesh.faces[faces]), most)
                self._parts[name] = self._scene.add_mesh_simple(
                    name,
                    small.vertices,
                    small.faces,
                    color=color,
                    side="double",
                    cast_shadow=False,
                    receive_shadow=False,
                )

    def show_picture(self, image: Image, layout: PickingLayout) -> None:
        """Show an image in the layout."""
        width, height = (side / layout.px_per_mm for side in layout.size_px)
        if self._picture is None:
            self._picture = self._scene.add_image(
                "/layout/picture", image, width, height, format="jpeg", jpeg_quality=_JPEG_QUALITY, receive_shadow=False
            )
            return
        with self._client.atomic():
            self._picture.image = image
            self._picture.render_width, self._picture.render_height = width, height

    def show_thumbnail(self, name: str, image: Image) -> None:
        """Show a thumbnail in the frustum of a camera."""
        step = -(-image.shape[1] // _THUMB_PX)
        self._frustums[name].image = np.ascontiguousarray(image[::step, ::step])

    def place(self, in_space: bool, poses: Mapping[str, Array]) -> None:
        """Show either the image or the cameras in 3-D, and the scans whose poses (4, 4) are given and finite."""
        with self._client.atomic():
            self._layout.visible, self._space.visible = not in_space, in_space
            for arch, frame in self._arches.items():
                T = poses.get(arch, np.full((4, 4), np.nan))
                frame.visible = bool(np.isfinite(T).all())
                if frame.visible:
                    set_pose(frame, T)

    def show_marks(self, book: PickBook, camera: str | None, frame: int, layout: PickingLayout | None) -> None:
        """Mark the picks on the scans and, in the image of a camera, the picks of this frame."""
        with self._client.atomic():
            for mark in self._marks:
                mark.remove()
            self._marks = []
            crosses, colors = [], []
            for number, pick in enumerate(book.picks):
                color = SELECTED if number == book.selected else ARCH_COLORS[pick.arch]
                if pick.vertex < len(self._capture.scans[pick.arch].vertices):
                    self._mark_vertex(book.name(number), pick.arch, pick.vertex, color)
                pixel = pick.views.get(camera) if camera is not None else None
                if pixel is not None and layout is not None and frame == book.frame:
                    place = layout.place(pixel) - [0.0, 0.0, _LIFT_MM]
                    crosses.append(_cross(place))
                    colors.append(np.broadcast_to(np.array(color, np.uint8), (4, 2, 3)))
                    self._label(f"/layout/name_{number}", book.name(number), place)
            if crosses:
                self._marks.append(
                    self._scene.add_line_segments(
                        "/layout/crosses",
                        np.concatenate(crosses).astype(np.float32),
                        np.concatenate(colors),
                        thickness=2.0,
                        thickness_units="screen",
                    )
                )

    def _mark_vertex(self, name: str, arch: str, vertex: int, color: tuple[int, int, int]) -> None:
        place = self._capture.scans[arch].vertices[vertex]
        ball = self._scene.add_icosphere(
            f"/{arch}/{name}", radius=_BALL_MM, color=color, position=tuple(place), cast_shadow=False
        )
        self._marks.append(ball)
        self._label(f"/{arch}/name_{name}", name, place)

    def _label(self, path: str, text: str, place: Array) -> None:
        self._marks.append(
            self._scene.add_label(path, text, position=tuple(place), anchor="bottom-left", font_screen_scale=0.8)
        )

    def look(self, eye: Array, target: Array) -> None:
        """Set position (3,) and target (3,) of the virtual camera."""
        camera = self._client.camera
        with self._client.atomic():
            camera.fov = FOV_RAD
            camera.position, camera.look_at, camera.up_direction = tuple(eye), tuple(target), UP


def set_first_view(server: viser.ViserServer) -> None:
    """Light every page, and set its initial virtual camera: upright, in front of the image."""
    add_lights(server.scene, UP)
    server.scene.set_up_direction("-y")
    first = server.initial_camera
    first.position, first.look_at, first.up = (0.0, 0.0, -_FIRST_EYE_MM), (0.0, 0.0, 0.0), UP
    first.fov, first.near, first.far = FOV_RAD, _NEAR_MM, _FAR_MM


def _cross(place: Array) -> Array:
    """Return the four segments (4, 2, 3) of a cross around a point (3,)."""
    ends = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=np.float64)
    return place + np.stack([_CROSS_MM[0] * ends, _CROSS_MM[1] * ends], axis=1)
