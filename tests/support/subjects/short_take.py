"""Short takes of random persons: cameras, jaw and head motion, and initial picks.

A take has a closed bite, opening, both sides and protrusion, with a moving head.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, make_transform, se3_inverse, so3_exp, transform_points
from jawusd.synthetic.anatomy import LipState
from jawusd.synthetic.annotations import spread_out
from jawusd.synthetic.kinematics import Joint, controlled_pose, smoothstep
from subjects.bite import Bite

#: Labels (rows, columns), first column and row of that part of the picture, inverse depth (rows, columns) [1/mm].
Drawn = tuple[NDArray[np.uint8], tuple[int, int], NDArray[np.float32]]
#: First label of the 14 teeth of each arch.
TEETH_FROM = (1, 41)
#: Vertex of a scan and its pixels (camera, x, y) in two cameras.
ShortPick = tuple[int, list[tuple[str, float, float]]]

_PICKS = 4
_PICK_NOISE_PX = 1.5
SIZES_PX = ((640, 360), (960, 540), (1280, 720), (1920, 1080))
_TARGET_MM = np.array([0.0, -9.0, -12.0])
_LIFT_STEP, _MOST_LIFT = 0.004, 0.35
_TOUCH_MM = -0.02
_LIFT_FRAMES = 4  # duration of opening before a tooth contact
_LEAST_MOVE, _WHOLE_MOVE = 4, 8  # frames of the shortest movement, and of a movement over the full range
#: Frames of the closed bite at the start.
CLOSED_FRAMES = 3
_PIVOT_MM = np.array([0.0, 20.0, -95.0])


def pick_ends(
    mesh: Mesh,
    row: int,
    pose: Array,
    T_bite_scan: Array,
    cameras: Sequence[Camera],
    seen: Sequence[Drawn],
    rng: np.random.Generator,
) -> list[ShortPick]:
    """Choose four well distributed tooth tips of a scan; none if too few are visible in two cameras.

    Args:
        row: 0 upper, 1 lower.
        pose: T_world_scan, shape (4, 4).
        T_bite_scan: scan to (left, up, front) axes, shape (4, 4).
        seen: visible labels per camera.
    """
    world = transform_points(pose, mesh.vertices)
    visible = np.stack([_visible(camera, world, *drawn, row) for camera, drawn in zip(cameras, seen, strict=True)], 1)
    good = np.flatnonzero(visible.sum(1) >= 2)
    if len(good) < _PICKS:
        return []
    # A person clicks on the tips of the teeth, towards the other arch.
    height = transform_points(T_bite_scan, mesh.vertices[good])[:, 1] * (1.0 if row else -1.0)
    good = good[height >= np.quantile(height, 0.6)] if len(good) > 200 else good
    out = []
    for vertex in good[np.array(spread_out(world[good], _PICKS))].tolist():
        views = []
        for c in np.flatnonzero(visible[vertex])[:2]:
            clicked = cameras[c].project(world[vertex]) + rng.normal(0.0, _PICK_NOISE_PX, 2)
            x, y = np.clip(clicked, 0.0, np.array(cameras[c].size_px) - 1.0)
            views.append((cameras[c].name, float(x), float(y)))
        out.append((int(vertex), views))
    return out


def pick_lines(jaw: str, pick: ShortPick) -> list[str]:
    """Return a pick as lines of capture.toml."""
    vertex, views = pick
    text = ", ".join(f'{{ camera = "{name}", x = {x:.2f}, y = {y:.2f} }}' for name, x, y in views)
    return [f"[[bootstrap.{jaw}]]", f"vertex = {vertex}", f"views = [{text}]", ""]


def _visible(
    camera: Camera,
    world: Array,
    labels: NDArray[np.uint8],
    window: tuple[int, int],
    depth: NDArray[np.float32],
    row: int,
) -> NDArray[np.bool_]:
    """Return which points (N, 3) of an arch's crowns are visible in a camera."""
    at = np.rint(camera.project(world)).astype(int) - window
    inside = np.asarray(((at >= 2) & (at < np.array(labels.shape[::-1]) - 2)).all(1))
    at = np.where(inside[:, None], at, 0)
    near = depth[at[:, 1], at[:, 0]] * camera.depth(world) < 1.0 + 0.4 / 300.0
    first = TEETH_FROM[row]
    own = labels[at[:, 1], at[:, 0]]
    return np.asarray(inside & near & (own >= first) & (own < first + 14))


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses of a person over a take, at any time in frames of the reference camera."""

    joint: Joint
    controls: Array  # opening, lateral, protrusion per frame, without tooth penetration, shape (F, 3)
    T_world_head: Array  # pose of the head at rest, shape (4, 4)
    head_phase: Array  # of the head's motion, shape (6,)
    head_rate: float  # rad per frame
    lips: LipState | None  # None with retractors
    tongue_mm: Array  # forward, up, left, while open, shape (3,)

    def jaw(self, t: float) -> Array:
        """Return T_skull_mandible (4, 4) in the bite frame."""
        now = _between(self.controls, t)
        pose = controlled_pose(self.joint, *now.tolist())
        still = controlled_pose(self.joint, 0.0, 0.0, 0.0)
        return np.asarray(pose @ se3_inverse(still))

    def head(self, t: float) -> Array:
        """Return T_world_skull (4, 4) for the bite frame."""
        wave = np.sin(self.head_rate * t * np.array([1.0, 0.8, 1.2, 0.9, 1.1, 0.7]) + self.head_phase)
        turn = so3_exp(wave[:3] * np.deg2rad([1.6, 2.2, 1.2]))
        shift = wave[3:] * [2.0, 1.2, 2.0]
        return np.asarray(self.T_world_head @ make_transform(turn, _PIVOT_MM + shift - turn @ _PIVOT_MM))


def draw_cameras(
    rng: np.random.Generator, count: int | None = None, size: tuple[int, int] | None = None
) -> tuple[list[Camera], Array]:
    """Return two to four cameras and the head pose T_world_bite (4, 4); the world is the first camera's frame.

    Number of cameras and size of the pictures [px] are drawn unless given.
    """
    drawn_count, drawn_size = rng.choice([2, 3, 4], p=[0.1, 0.75, 0.15]), rng.choice(4, p=[0.2, 0.35, 0.3, 0.15])
    count, size = count or int(drawn_count), size or SIZES_PX[int(drawn_size)]
    apart = rng.uniform(26.0, 48.0)
    around = {2: (-0.45, 0.45), 3: (0.0, 1.0, -1.0), 4: (0.0, 1.0, -1.0, 0.3)}[count]
    above = {2: (0.0, 0.0), 3: (0.0, 0.1, -0.1), 4: (-0.15, 0.0, 0.0, 0.6)}[count]
    distance = rng.uniform(150.0, 600.0)
    span = rng.uniform(88.0, 140.0)  # width of the picture at the teeth [mm]
    T_cams: list[Array] = []
    cameras = []
    for k in range(count):
        azimuth = np.deg2rad(around[k] * apart + rng.normal(0.0, 3.0))
        height = np.deg2rad(above[k] * 40.0 + rng.normal(0.0, 5.0))
        far = distance * rng.uniform(0.88, 1.12)
        T_cams.append(_looking(azimuth, height, far, np.deg2rad(rng.normal(0.0, 3.0))))
        cameras.append(_camera(f"cam{k}", size, size[0] * far / (span * rng.uniform(0.95, 1.12)), rng))
    T_bite_world = se3_inverse(T_cams[0])
    placed = [replace(camera, T_cam_world=T @ T_bite_world) for camera, T in zip(cameras, T_cams, strict=True)]
    return placed, T_cams[0]


def _looking(azimuth: float, height: float, distance: float, roll: float) -> Array:
    """Return T_cam_bite of a camera that looks at the teeth from a direction (left, up)."""
    towards = np.array([np.sin(azimuth) * np.cos(height), np.sin(height), np.cos(azimuth) * np.cos(height)])
    right = np.cross([0.0, -1.0, 0.0], -towards)
    right /= np.linalg.norm(right)
    R = so3_exp(np.array([0.0, 0.0, roll])) @ np.stack([right, np.cross(-towards, right), -towards])
    return make_transform(R, -R @ (_TARGET_MM + distance * towards))


def _camera(name: str, size: tuple[int, int], focal: float, rng: np.random.Generator) -> Camera:
    """Return a camera at the origin with a distortion of -3 to +1.5 % at the corners."""
    width, height = size
    corner = (width**2 + height**2) / (4.0 * focal**2)
    bend = rng.uniform(-0.03, 0.015)
    distortion = np.array([bend / corner, 0.15 * abs(bend) / corner**2, *rng.normal(0.0, 2e-4, 2), 0.0])
    middle = np.array(size) / 2 - 0.5 + rng.normal(0.0, 0.004, 2) * width
    K = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    return Camera(name, size, K, distortion, np.eye(4))


def draw_motion(joint: Joint, bite: Bite, T_world_head: Array, frames: int, rng: np.random.Generator) -> Motion:
    """Draw a random take; the opening is increased where teeth would penetrate."""
    joint = replace(joint, incisor=bite.incisor)
    controls = _exercise(frames, rng)
    lift = np.zeros(frames)
    for i in range(CLOSED_FRAMES, frames):
        while lift[i] < _MOST_LIFT and _penetrates(joint, bite, controls[i] + [lift[i], 0.0, 0.0]):
            lift[i] += _LIFT_STEP
    controls[CLOSED_FRAMES:, 0] += _upper_envelope(lift)[CLOSED_FRAMES:]
    turn = so3_exp(np.deg2rad(rng.normal(0.0, [4.0, 5.0, 4.0])))
    centre = _TARGET_MM
    T_head = T_world_head @ make_transform(turn, centre - turn @ centre)
    lips = None
    if rng.random() < 0.55:
        lips = LipState(rng.uniform(6.0, 9.0), rng.uniform(6.0, 9.0), rng.uniform(25.0, 29.0), rng.normal(0.0, 0.02))
    raised = rng.uniform(0.0, 1.0) * (rng.random() < 0.4)
    tongue = np.array([6.0 * raised, 7.0 * raised, rng.uniform(-2.0, 2.0)])
    return Motion(joint, controls, T_head, rng.uniform(0.0, 2 * np.pi, 6), rng.uniform(0.1, 0.35), lips, tongue)


def _exercise(frames: int, rng: np.random.Generator) -> Array:
    """Return opening, lateral and protrusion per frame, shape (F, 3): opening, then further movements if time permits.

    Amplitudes are limited to realistic speeds: at 24 frames/s, up to about 100 mm/s of opening.
    """
    side = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 0.55)
    others = np.array([[0.12, side, 0.0], [0.1, -side, 0.1], [0.1, 0.0, rng.uniform(0.4, 0.8)]])
    rng.shuffle(others)
    free = frames - CLOSED_FRAMES
    moves = int(np.clip(free // _LEAST_MOVE, 1, 1 + len(others)))
    reach = min(1.0, free / moves / _WHOLE_MOVE)
    values = reach * np.array([[0.0, 0.0, 0.0], [rng.uniform(0.25, 0.45), 0.0, 0.0], *others])[: moves + 1]
    keys = CLOSED_FRAMES - 1 + free * np.linspace(0.0, 1.0, moves + 1)
    return np.stack([_through(keys, values, t) for t in range(frames)])


def _upper_envelope(lift: Array) -> Array:
    """Return a smooth upper envelope of a lift per frame, shape (F,)."""
    apart = np.abs(np.subtract.outer(np.arange(len(lift)), np.arange(len(lift))))
    share = np.where(apart < _LIFT_FRAMES, np.cos(0.5 * np.pi * apart / _LIFT_FRAMES) ** 2, 0.0)
    return np.asarray((share * lift).max(axis=1), np.float64)


def _between(rows: Array, t: float) -> Array:
    """Interpolate rows (F, n) monotonically in time (Fritsch & Butland 1984)."""
    step = np.diff(rows, axis=0)
    product, total = step[:-1] * step[1:], step[:-1] + step[1:]
    inner = np.where(product > 0, 2.0 * product / np.where(product > 0, total, 1.0), 0.0)
    slope = np.concatenate([step[:1], inner, step[-1:]])
    k = int(np.clip(np.floor(t), 0, len(step) - 1))
    s = float(np.clip(t - k, 0.0, 1.0))
    rising = rows[k] + s * s * (3.0 - 2.0 * s) * step[k]
    return np.asarray(rising + s * (1.0 - s) * ((1.0 - s) * slope[k] - s * slope[k + 1]))


def _through(keys: Array, values: Array, t: float) -> Array:
    """Interpolate smoothly between key values (K, 3)."""
    k = int(np.clip(np.searchsorted(keys, t, side="right") - 1, 0, len(keys) - 2))
    share = smoothstep((t - keys[k]) / (keys[k + 1] - keys[k]))
    return np.asarray((1.0 - share) * values[k] + share * values[k + 1])


def _penetrates(joint: Joint, bite: Bite, controls: Array) -> bool:
    pose = controlled_pose(joint, *controls) @ se3_inverse(controlled_pose(joint, 0.0, 0.0, 0.0))
    return bite.occlusion.gap(pose) < _TOUCH_MM


def sampled(motion: Callable[[float], Array], times: NDArray[np.float64]) -> Array:
    """Return poses at times, shape (T, 4, 4)."""
    return np.stack([motion(float(t)) for t in times])
