"""3-D scene of the jaw: meshes, paths, markers and camera. The page's world is the anatomical frame in mm."""

from __future__ import annotations

from typing import Literal

import numpy as np
import viser

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.geometry import LANDMARKS
from jawusd.geometry.se3 import se3_inverse, transform_point, transform_points
from jawusd.geometry.so3 import wxyz_from_matrix
from jawusd.viewer.readouts import CONDYLES, GHOSTS, INCISOR, habitual_path, landmark_places, rest_places
from jawusd.viewer.viewed import MOVING, STILL, ViewedActor, is_solid
from jawusd.viewer.widgets import Client

Color = tuple[int, int, int]

_ENAMEL, _GUM, _BONE = (236, 229, 212), (196, 112, 108), (222, 207, 178)
_COLORS = {"upper_teeth": _ENAMEL, "lower_teeth": _ENAMEL, "upper_gum": _GUM, "lower_gum": _GUM}
_OUTSIDE: Color = (222, 120, 90)
_PLACEHOLDER: Color = (150, 158, 168)  # colour of placeholders, distinct from bone
_CLEAR = 0.45  # opacity of a translucent mandible
_INCISOR, _CONDYLE, _PIN, _HELD = (0, 114, 178), (0, 158, 115), (230, 159, 0), (213, 94, 0)
_SKULL_OPACITY, _FAINT = 0.28, 0.16
_GROUND: Color = (196, 190, 186)
_AMBIENT = 1.6
_MARKER_MM, _PIN_MM = 1.2, 2.2
_BALL = 2  # number of subdivisions of a marker, an icosphere (320 faces)
_CAPTURED_MM, _MOST_CAPTURED = 0.5, 400

#: Views by name: offset from target to camera, anatomical axes [mm].
PRESETS = {
    "front": (0.0, 10.0, 330.0),
    "left": (330.0, 10.0, 0.0),
    "right": (-330.0, 10.0, 0.0),
    "top": (0.0, 330.0, 20.0),
    "condyle left": (105.0, 12.0, 40.0),
    "condyle right": (-105.0, 12.0, 40.0),
}
#: Initial view of a page.
FIRST_VIEW = "front"
#: Up direction of the page.
UP = (0.0, 1.0, 0.0)
#: Aspect ratio (width over height) below which a screen counts as a phone, whose lower half the panel covers.
PHONE = 0.6
_NARROW = 0.75  # aspect ratio below which the camera moves back, so that the jaw fits the width
_LOWER = 0.25  # fraction of the view's height by which the camera aims below the jaw on a phone
_FOV_RAD, _NEAR_MM, _FAR_MM = 0.6, 1.0, 5000.0


def add_lights(scene: viser.SceneApi, up: tuple[float, float, float]) -> None:
    """Light a scene from the camera and, more weakly, from everywhere; `up` is (0, 1, 0) or (0, -1, 0)."""
    scene.configure_default_lights(cast_shadow=False)
    # Use a hemisphere light: without a GPU, an environment map takes most of the frame time.
    scene.configure_environment_map(None)
    turned = (1.0, 0.0, 0.0, 0.0) if up[1] > 0 else (0.0, 1.0, 0.0, 0.0)  # viser lights from the local +y axis
    scene.add_light_hemisphere("/light", ground_color=_GROUND, intensity=_AMBIENT, wxyz=turned)


def add_jaw(scene: viser.SceneApi, actor: ViewedActor) -> tuple[viser.FrameHandle, dict[str, viser.MeshHandle]]:
    """Draw skull and jaw in occlusion; return the frame of the jaw and its meshes, by the names in `MOVING`."""
    T_world_skull = np.array(actor.rig.T_anatomical_skull)
    for name in STILL:
        if name in actor.meshes:
            mesh = actor.meshes[name]
            placed = Mesh(transform_points(T_world_skull, mesh.vertices), mesh.faces)
            _add_mesh(scene, f"/{name}", placed, _color(name, actor), _SKULL_OPACITY if name == "skull" else None)
    jaw = scene.add_frame("/jaw", show_axes=False)
    parts = {}
    for name in MOVING:
        if name in actor.meshes:
            opacity = _CLEAR if name in actor.placeholders else None
            parts[name] = _add_mesh(scene, f"/jaw/{name}", actor.meshes[name], _color(name, actor), opacity)
    return jaw, parts


def _color(name: str, actor: ViewedActor) -> Color:
    return _PLACEHOLDER if name in actor.placeholders else _COLORS.get(name, _BONE)


def _add_mesh(scene: viser.SceneApi, name: str, mesh: Mesh, color: Color, opacity: float | None) -> viser.MeshHandle:
    # Two-sided faces take twice as long to render; only open meshes need them.
    side: Literal["front", "double"] = "front" if is_solid(mesh) else "double"
    return scene.add_mesh_simple(name, mesh.vertices, mesh.faces, color=color, opacity=opacity, side=side)


def set_pose(frame: viser.FrameHandle, T: Array) -> None:
    """Set the pose T (4, 4) [mm] of a frame."""
    frame.position, frame.wxyz = tuple(T[:3, 3]), tuple(wxyz_from_matrix(T[:3, :3]))


class JawScene:
    """3-D scene of one page: first only skull and jaw, then `add_marks`; `grips` are the meshes that can be dragged."""

    def __init__(self, client: Client, actor: ViewedActor) -> None:
        self._client, self._scene = client, client.scene
        self._T_world_skull = np.array(actor.rig.T_anatomical_skull)
        self._rest = rest_places(actor.rig)
        self._jaw, parts = add_jaw(client.scene, actor)
        self._moving = {name: actor.meshes[name] for name in parts}
        self._ghosts: list[viser.FrameHandle] = []
        self._bone = _color("mandible", actor)
        self.grips = list(parts.values())
        self._mandible = parts.get("mandible")
        self._inside = True

    def add_marks(self, actor: ViewedActor) -> None:
        """Add the landmarks, the paths, and the hidden marks of pins and of the grabbed point."""
        for name, place in zip(LANDMARKS, actor.rig.landmarks, strict=True):
            if not name.startswith("molar"):
                color = _CONDYLE if name.startswith("condyle") else _INCISOR
                self._ball(f"/jaw/{name}", _MARKER_MM, color).position = place
        self._paths = self._add_paths(actor)
        self._pins = {name: self._ball(f"/pin/{name}", _PIN_MM, _PIN, 0.6) for name in LANDMARKS}
        self._held = self._ball("/held", _MARKER_MM, _HELD)
        self._line = self._lines("/pull", np.zeros((1, 2, 3)), _HELD)
        self.show_grab(None, None)
        self.show_pins({})

    def _ball(self, name: str, radius_mm: float, color: Color, opacity: float | None = None) -> viser.IcosphereHandle:
        return self._scene.add_icosphere(name, radius=radius_mm, color=color, subdivisions=_BALL, opacity=opacity)

    def _lines(self, name: str, ends: Array, color: Color) -> viser.LineSegmentsHandle:
        return self._scene.add_line_segments(name, ends, colors=color, thickness=2.5, thickness_units="screen")

    def _add_paths(self, actor: ViewedActor) -> list[viser.SceneNodeHandle]:
        """Draw the paths of the incisal point and the condyles during opening, and their captured positions."""
        d = actor.rig.captured_d
        captured = landmark_places(actor.rig, d[:: max(1, -(-len(d) // _MOST_CAPTURED))])
        path = habitual_path(actor.rig)
        handles: list[viser.SceneNodeHandle] = []
        for index in (INCISOR, *CONDYLES):
            color, line = _INCISOR if index == INCISOR else _CONDYLE, path[:, index]
            segments = np.stack([line[:-1], line[1:]], axis=1)
            name = f"/paths/{LANDMARKS[index]}"
            handles.append(self._lines(name, segments, color))
            handles.append(
                self._scene.add_point_cloud(
                    f"{name}_captured",
                    captured[:, index],
                    colors=color,
                    point_size=_CAPTURED_MM,
                    point_shape="circle",
                    precision="float32",
                )
            )
        return handles

    def show_paths(self, visible: bool) -> None:
        """Show or hide the paths and the captured positions."""
        for handle in self._paths:
            handle.visible = visible

    def show_ghosts(self, T_skull_mandible: Array) -> None:
        """Draw the lower teeth and the mandible faintly at poses (n, 4, 4), n <= `GHOSTS`; n = 0 hides them."""
        if len(T_skull_mandible) and not self._ghosts:
            self._ghosts = [self._add_ghost(f"/ghost_{k}") for k in range(GHOSTS)]
        for k, ghost in enumerate(self._ghosts):
            if k < len(T_skull_mandible):
                set_pose(ghost, self._T_world_skull @ T_skull_mandible[k])
            ghost.visible = k < len(T_skull_mandible)

    def _add_ghost(self, name: str) -> viser.FrameHandle:
        ghost = self._scene.add_frame(name, show_axes=False)
        for part in ("mandible", "lower_teeth"):
            if part in self._moving:
                _add_mesh(self._scene, f"{name}/{part}", self._moving[part], _COLORS.get(part, self._bone), _FAINT)
        return ghost

    def move(self, T_skull_mandible: Array, inside: bool) -> None:
        """Pose the mandible; colour it if the pose is invalid."""
        with self._client.atomic():
            set_pose(self._jaw, self._T_world_skull @ T_skull_mandible)
        if inside != self._inside and self._mandible is not None:
            self._mandible.color = self._bone if inside else _OUTSIDE
        self._inside = inside

    def show_grab(self, held_skull: Array | None, pointer_skull: Array | None) -> None:
        """Mark the grabbed point and draw a line to the pointer, both (3,) [mm] in the skull frame; None hides them."""
        if held_skull is not None and pointer_skull is not None:
            ends = transform_points(self._T_world_skull, np.stack([held_skull, pointer_skull]))
            self._held.position = tuple(ends[0])
            self._line.points = ends[None].astype(np.float32)
        self._held.visible = self._line.visible = held_skull is not None and pointer_skull is not None

    def show_pins(self, places_skull: dict[str, Array]) -> None:
        """Mark the pinned landmarks at their positions (3,) [mm] in the skull frame."""
        for name, ball in self._pins.items():
            if name in places_skull:
                ball.position = tuple(transform_point(self._T_world_skull, places_skull[name]))
            ball.visible = name in places_skull

    def skull_from_page(self, position: tuple[float, float, float]) -> Array:
        """Transform a position from the page's world to the skull frame [mm], shape (3,)."""
        return transform_point(se3_inverse(self._T_world_skull), np.array(position))

    def sight_to(self, position: tuple[float, float, float]) -> Array:
        """Return the direction in the skull frame from the camera to a position in the page's world, shape (3,)."""
        return self._T_world_skull[:3, :3].T @ (np.array(position) - self._client.camera.position)

    def look(self, preset: str) -> None:
        """Move the camera to a preset view; make the mandible translucent in close-ups of a condyle."""
        camera = self._client.camera
        target, eye = preset_view(self._rest, preset, camera.image_width / max(camera.image_height, 1))
        if self._mandible is not None and self._bone != _PLACEHOLDER:
            self._mandible.opacity = _CLEAR if preset.startswith("condyle") else None
        with self._client.atomic():
            camera.position, camera.look_at, camera.up_direction = tuple(eye), tuple(target), UP


def preset_view(rest: Array, preset: str, aspect: float = 1.0) -> tuple[Array, Array]:
    """Return the target (3,) and the camera position (3,) of a preset view [mm].

    `rest` are the landmarks at rest, shape (5, 3) [mm]; `aspect` is width over height of the screen.
    """
    target = rest[list(CONDYLES) + [INCISOR]].mean(axis=0)
    if preset.startswith("condyle"):
        target = rest[CONDYLES[0] if preset.endswith("left") else CONDYLES[1]]
    away = np.array(PRESETS[preset]) * max(1.0, _NARROW / aspect)
    if aspect < PHONE:
        up = np.array([0.0, 1.0, 0.0]) if preset != "top" else np.array([0.0, 0.0, -1.0])
        target = target - _LOWER * 2 * np.linalg.norm(away) * np.tan(_FOV_RAD / 2) * up
    return target, target + away


def set_first_view(server: viser.ViserServer, rest: Array) -> None:
    """Start every page lit and with the initial view, given the landmarks (5, 3) at rest [mm]."""
    target, eye = preset_view(rest, FIRST_VIEW)
    add_lights(server.scene, UP)
    server.scene.set_up_direction("+y")
    first = server.initial_camera
    first.position, first.look_at, first.up = tuple(eye), tuple(target), UP
    set_lens(first)


def set_lens(camera: viser.CameraHandle | viser.InitialCameraConfig) -> None:
    """Set the field of view and the clipping planes of a page's camera."""
    camera.fov, camera.near, camera.far = _FOV_RAD, _NEAR_MM, _FAR_MM
