"""A synthetic studio, a performance in front of its cameras, and the scene in each video frame.

A studio has a chessboard, and three cameras about 200 mm from the mouth. A take samples jaw, head, lips, tongue and
light once per frame; the scene poses the subject's surfaces in a frame and renders them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, make_transform, se3_inverse, so3_exp, transform_points
from jawusd.geometry.camera import intrinsics
from jawusd.meshes.surfaces import grid_faces
from jawusd.synthetic.anatomy import Face, LipState, Occlusion, PersonAnatomy, Surface, opened_bite, palate, tongue
from jawusd.synthetic.dental_arch import DentalArch
from jawusd.synthetic.exercises import schedule, smooth_noise, smoothed
from jawusd.synthetic.kinematics import smoothstep
from jawusd.synthetic.person import Person
from jawusd.synthetic.render import LOWER_TEETH, UPPER_TEETH, Picture, Renderer

#: Scan frame to world with the head at rest; the world is the first camera's frame: x right, y down, z forward.
T_WORLD_SCAN = make_transform(np.diag([1.0, -1.0, -1.0]), [0.0, -14.0, 214.0])
BOARD_COLUMNS, BOARD_ROWS, SQUARE_MM = 9, 6, 8.0
# Focal length relative to the image width; then, for each camera: direction from the mouth [deg left, deg up], radial
# and tangential distortion, and offsets of principal point and focal length relative to the image width.
_FOCAL = 1.494
_CAMERAS = (
    ((0.0, 0.0), (-0.031, 0.012, 0.0003, -0.0004, 0.0), (0.0043, -0.0031), 1.000),
    ((37.0, 9.0), (-0.027, 0.009, -0.0005, 0.0002, 0.0), (-0.0043, 0.0031), 1.005),
    ((-38.0, -6.0), (-0.034, 0.015, 0.0002, 0.0005, 0.0), (0.0026, 0.0048), 0.994),
)
FPS = 24.0
#: Numbers of frames before the first and after the last tracked frame; these contain the flashes.
LEAD, TAIL = 20, 16
#: Numbers of frames with the mouth slightly open, then with closed teeth, at the start of the tracked range.
OPEN_HOLD, REST_HOLD = 10, 12
_DARK_FRAMES = 4
_FLASH_START, _FLASH_BEFORE_END = 8, 10
_DARKNESS = 0.06
_HALF_OPEN = 0.10
_EXERCISES = (
    "open", "lateral", "protrude", "frontal border", "chew", "chew", "circumduct", "sagittal border",
    "lateral half open", "protrude half open", "speech", "open", "frontal border", "circumduct", "chew",
)  # fmt: skip
_ENAMEL = np.array([0.80, 0.745, 0.63])
_GUM = np.array([0.56, 0.22, 0.21])
# Canines are yellower, and enamel darkens towards the gum.
_CANINE_TINT = np.array([0.975, 0.955, 0.91])


def build_cameras(size_px: tuple[int, int]) -> list[Camera]:
    """Return the three cameras; the world frame is the frame of the first camera."""
    width, height = size_px
    target = (T_WORLD_SCAN @ [0.0, -14.0, -6.0, 1.0])[:3]
    cameras = []
    for k, ((left, up), distortion, shift, zoom) in enumerate(_CAMERAS):
        a, b = np.deg2rad([left, up])
        # The subject's left is on the right in the first camera's image.
        turn = so3_exp([0.0, -a, 0.0]) @ so3_exp([-b, 0.0, 0.0])
        T_world_cam = np.eye(4)
        if k:
            T_world_cam = make_transform(turn, target - turn @ [0.0, 0.0, 206.0 + 3.0 * k])
        focal = _FOCAL * width * zoom
        K = intrinsics(focal, focal, width / 2 - 0.5 + shift[0] * width, height / 2 - 0.5 + shift[1] * width)
        cameras.append(Camera(f"cam{k}", size_px, K, np.array(distortion), se3_inverse(T_world_cam)))
    return cameras


def board() -> Surface:
    """Return the chessboard with a white rim; origin at its centre, x along the columns, facing -z."""
    columns, rows = BOARD_COLUMNS + 3, BOARD_ROWS + 3
    vertices, colors = [], []
    for i in range(rows):
        for j in range(columns):
            x, y = np.array([j - columns / 2, i - rows / 2]) * SQUARE_MM
            vertices += [[x + u, y + v, 0.0] for v in (0.0, SQUARE_MM) for u in (0.0, SQUARE_MM)]
            rim = i in (0, rows - 1) or j in (0, columns - 1)
            colors += [[0.03] * 3 if (i + j) % 2 == 0 and not rim else [0.85] * 3] * 4
    quads = len(vertices) // 4
    faces = (grid_faces(2, 2, closed=False)[None] + 4 * np.arange(quads)[:, None, None]).reshape(-1, 3)
    n = len(vertices)
    return Surface(np.array(vertices), faces.astype(np.int32), np.array(colors), np.zeros(n), np.zeros(n), np.zeros(n))


def board_poses(n: int, rng: np.random.Generator) -> Array:
    """Return n random poses T_world_board (n, 4, 4) near the mouth, in view of all cameras."""
    centre = (T_WORLD_SCAN @ [0.0, -12.0, -10.0, 1.0])[:3]
    tilt = rng.uniform(-1.0, 1.0, (n, 3)) * np.deg2rad([24.0, 22.0, 14.0])
    shift = rng.uniform(-1.0, 1.0, (n, 3)) * [14.0, 8.0, 18.0]
    R = so3_exp(tilt)
    # Every second pose is rotated by 180 degrees.
    R[1::2] = R[1::2] @ np.diag([-1.0, -1.0, 1.0])
    return make_transform(R, centre + shift)


@dataclass(frozen=True, eq=False)
class Take:
    """A performance sampled at the frames of the reference camera."""

    first_instant: int  # first sampled frame of the reference camera; negative if another camera started earlier
    tracked: tuple[int, int]  # first tracked frame of the reference camera, and one past the last
    rest_frame: int  # frame of the reference camera in which the teeth are in occlusion
    dark: NDArray[np.int64]  # dark intervals [first, last) in frames of the reference camera, shape (2, 2)
    controls: Array  # opening, lateral and protrusion in each frame, shape (I, 3)
    phase: NDArray[np.str_]  # name of the exercise in each frame, shape (I,)
    T_skull_mandible: Array  # jaw poses [mm], shape (I, 4, 4)
    T_world_skull: Array  # head poses [mm], shape (I, 4, 4)
    lips: list[LipState]  # shape of the lips in each frame
    tongue_mm: Array  # displacement of the tongue forward, up and left, shape (I, 3)
    light: Array  # brightness factor of each frame, shape (I,)


def perform(person: Person, occlusion: Occlusion, frames: int, offsets: tuple[int, ...], seed: int) -> Take:
    """Return a take of a subject performing exercises.

    Args:
        occlusion: tooth contacts, which guide movements with closed teeth.
        frames: number of tracked frames, more than `OPEN_HOLD + REST_HOLD`.
        offsets: camera offsets; the take covers the frames of all cameras.
        seed: seed of exercises, head motion, lips and tongue.
    """
    rng = np.random.default_rng([seed, 0x7A6E])
    first = min(0, *offsets)
    n = LEAD + frames + TAIL + max(0, *offsets) - first
    start = LEAD - first  # index of the first tracked frame
    controls, phase, held = _controls(person, frames, start, n, rng)
    extra_mm = smooth_noise(rng, n, 8.0, 3) * [person.noise.side_mm, person.noise.lift_mm, person.noise.lift_mm]
    extra_mm *= 1.0 - held[:, None]
    controls = opened_bite(person, occlusion, controls, extra_mm)
    T_jaw = person.pose_with_extra(controls, extra_mm)
    dark = np.array([[_FLASH_START, 0], [LEAD + frames + TAIL - _FLASH_BEFORE_END, 0]])
    dark[:, 1] = dark[:, 0] + _DARK_FRAMES
    light = np.ones(n)
    for a, b in dark - first:
        light[a:b] = _DARKNESS
    return Take(
        first_instant=first,
        tracked=(LEAD, LEAD + frames),
        rest_frame=LEAD + OPEN_HOLD + REST_HOLD // 2,
        dark=dark,
        controls=controls,
        phase=phase,
        T_skull_mandible=T_jaw,
        T_world_skull=_head(n, rng),
        lips=_lips(controls, phase, rng),
        tongue_mm=_tongue(controls, rng),
        light=light,
    )


def _controls(
    person: Person, frames: int, start: int, n: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.str_], Mask]:
    """Return the controls and exercise of every frame, and a weight that is 1 in frames with the jaw held closed."""
    exercises = frames - OPEN_HOLD - REST_HOLD
    curves, names = schedule(_EXERCISES, exercises, rng, tempo=1.5)
    still = np.array([_HALF_OPEN, 0.0, 0.0])
    head = np.tile(still, (start + OPEN_HOLD, 1))
    rest = np.zeros((REST_HOLD, 3))
    tail = np.tile(still, (n - len(head) - REST_HOLD - exercises, 1))
    controls = smoothed(np.concatenate([head, rest, curves, tail]))
    resting = np.concatenate([np.zeros(len(head)), np.ones(REST_HOLD), np.zeros(exercises + len(tail))])
    phase = np.array(["open"] * len(head) + ["rest"] * REST_HOLD + list(names) + ["open"] * len(tail))
    held = smoothed(resting[:, None])
    unintended = smooth_noise(rng, n, 10.0, 3) * [0.006, 0.03, 0.03] * (1.0 - np.minimum(1.0, 4.0 * held))
    return person.limit(controls + unintended), phase, held[:, 0] > 0.02


def _drift(n: int, rng: np.random.Generator, count: int) -> Array:
    """Return slow drifts of unit variance: sums of sinusoids with periods of 2 to 7 s, shape (n, count)."""
    seconds = np.arange(n) / FPS
    period, phase = rng.uniform(2.0, 7.0, (4, count)), rng.uniform(0.0, 2 * np.pi, (4, count))
    return np.sin(2 * np.pi * seconds[:, None, None] / period + phase).sum(1) / np.sqrt(2.0)


def _head(n: int, rng: np.random.Generator) -> Array:
    """Return head poses that vary by a few millimetres and degrees about the atlas, shape (n, 4, 4)."""
    drift = _drift(n, rng, 6)
    R = so3_exp(drift[:, :3] * np.deg2rad([1.0, 1.3, 0.8]))
    pivot = np.array([0.0, 20.0, -95.0])
    shift = drift[:, 3:] * [1.0, 0.7, 1.2]
    return T_WORLD_SCAN @ make_transform(R, pivot + shift - R @ pivot)


def _lips(controls: Array, phase: NDArray[np.str_], rng: np.random.Generator) -> list[LipState]:
    """Return the shape of the lips in every frame: retracted to show the teeth, less so during chewing and speech."""
    drift = _drift(len(controls), rng, 4)
    relaxed = smoothed(np.isin(phase, ["chew", "speech"]).astype(np.float64)[:, None])[:, 0]
    wide = smoothstep(controls[:, 0])
    upper = 8.2 + 0.9 * drift[:, 0] - 1.6 * relaxed + 0.8 * wide
    lower = 8.2 + 1.0 * drift[:, 1] - 1.8 * relaxed - 1.2 * wide
    width = 27.5 + 0.6 * drift[:, 2] - 1.2 * relaxed - 1.5 * wide
    return [LipState(*row) for row in np.stack([upper, lower, width, 0.008 * drift[:, 3]], -1).tolist()]


def _tongue(controls: Array, rng: np.random.Generator) -> Array:
    """Return the tongue position in every frame (n, 3) [mm], sometimes raised over the lower front teeth."""
    drift = _drift(len(controls), rng, 2)
    room = smoothstep((controls[:, 0] - 0.12) / 0.3)
    raised = smoothstep((drift[:, 0] - 0.5) / 1.2) * room
    return np.stack([7.0 * raised, 9.0 * raised + 1.5 * room, 3.0 * drift[:, 1] * raised], -1)


class Scene:
    """All surfaces of one subject, ready to render."""

    def __init__(self, person: Person, anatomy: PersonAnatomy, renderer: Renderer, freckles: float = 0.0) -> None:
        """Add the subject's surfaces to the renderer; the face has freckles of a darkness of 0..1."""
        self._renderer = renderer
        self.anatomy = anatomy
        self._face = Face(person.joint.incisor)
        for name, arch, label in (("upper", anatomy.upper, UPPER_TEETH), ("lower", anatomy.lower, LOWER_TEETH)):
            crowns, gum = _arch_surfaces(arch)
            renderer.add(f"{name} teeth", crowns, label)
            renderer.add(f"{name} gum", gum)
        face = self._face
        vertices = face.posed(LipState(8.2, 8.2, 27.5, 0.0), np.eye(4))
        renderer.add("face", Surface(vertices, face.faces, face.colors, face.gloss, face.skin, face.inside, freckles))
        renderer.add("palate", palate())
        renderer.add("tongue", tongue(0.0, 0.0, 0.0))

    def pose(self, take: Take, index: int, slide_mm: Array | float = 0.0) -> dict[str, Array]:
        """Deform face and tongue for a frame of a take; return the poses T_world_part (4, 4) of all surfaces.

        `slide_mm`, (V, 3) or (), is added to the vertices of the face, skull frame [mm].
        """
        T_jaw, head = take.T_skull_mandible[index], take.T_world_skull[index]
        self._renderer.move("face", self._face.posed(take.lips[index], T_jaw) + slide_mm)
        self._renderer.move("tongue", tongue(*take.tongue_mm[index]).vertices)
        jaw = head @ T_jaw
        return {
            "upper teeth": head, "upper gum": head, "palate": head, "face": head,
            "lower teeth": jaw, "lower gum": jaw, "tongue": jaw,
        }  # fmt: skip

    def draw(
        self, camera: int, take: Take, index: int, poses: dict[str, Array], jitter_px: tuple[Array, Array] | None
    ) -> Picture:
        """Render a frame; `poses` comes from `pose`, and `jitter_px` is as in `Renderer.render`."""
        return self._renderer.render(camera, poses, take.T_world_skull[index], float(take.light[index]), jitter_px)

    def occluders(self, take: Take, index: int) -> list[Mesh]:
        """Return all meshes that can occlude a tooth in a frame, in world coordinates [mm]."""
        T_jaw, head = take.T_skull_mandible[index], take.T_world_skull[index]
        tongue_now = tongue(*take.tongue_mm[index])
        parts = (
            (head, self.anatomy.upper.mesh),
            (head @ T_jaw, self.anatomy.lower.mesh),
            (head, Mesh(self._face.posed(take.lips[index], T_jaw), self._face.faces)),
            (head @ T_jaw, Mesh(tongue_now.vertices, tongue_now.faces)),
        )
        return [Mesh(transform_points(T, mesh.vertices), mesh.faces) for T, mesh in parts]


def _arch_surfaces(arch: DentalArch) -> tuple[Surface, Surface]:
    """Return crowns and gum of an arch in natural colours."""
    tooth = arch.tooth != 0
    first_gum = int(np.argmin(tooth))
    vertices, faces = arch.mesh.vertices, arch.mesh.faces
    crown_faces = faces[faces[:, 0] < first_gum]
    gum_faces = faces[faces[:, 0] >= first_gum] - first_gum
    colors = np.tile(_ENAMEL, (first_gum, 1))
    for k in np.unique(arch.tooth[:first_gum]):
        own = arch.tooth[:first_gum] == k
        height = np.abs(vertices[:first_gum][own, 1])
        # distance from the occlusal end as a fraction of the crown height
        share = (height - height.min()) / np.ptp(height)
        colors[own] *= 1.0 - 0.16 * share[:, None] * np.array([0.6, 0.8, 1.3])
        if abs(k) == 3:
            colors[own] *= _CANINE_TINT
    n, m = first_gum, len(vertices) - first_gum
    crowns = Surface(vertices[:n], crown_faces, colors, np.full(n, 0.5), np.zeros(n), np.ones(n))
    gum = Surface(vertices[n:], gum_faces, np.tile(_GUM, (m, 1)), np.full(m, 0.4), np.full(m, 0.3), np.ones(m))
    return crowns, gum
