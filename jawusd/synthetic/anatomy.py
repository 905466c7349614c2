"""Bones, teeth and soft tissue that match the joint of a synthetic subject, in occlusion at the identity pose.

Lips, face, mouth lining, palate and tongue surround the teeth and occlude them in images. The face is a single grid of
rings around the mouth, which run from the throat over the cheek lining and the lips to the edge of the face. It is
built in the scan frame for the closed bite and follows the mandible by linear blend skinning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.geometry import transform_points
from jawusd.meshes.bones import build_mandible, build_skull
from jawusd.meshes.surfaces import Faces, grid_faces, superellipse
from jawusd.synthetic.dental_arch import ArchShape, DentalArch, build_arch
from jawusd.synthetic.kinematics import smoothstep
from jawusd.synthetic.person import Person
from jawusd.synthetic.teeth import LOWER, UPPER

# Heights of upper edges and cusps relative to the upper central incisal edges [mm], first incisor to second molar.
_UPPER_TIPS_MM = -np.array([0.0, 0.5, 0.2, 0.3, 0.4, 0.6, 1.0])
# Heights of the lower front teeth relative to the lower central incisors [mm].
_LOWER_FRONT_MM = np.array([0.0, -0.2, -0.3])
_CONTACT_GAP_MM = 0.05
_OPENING_STEP = 0.002
_CELL_MM = 0.2
_SAMPLES_PER_EDGE = 5


class Occlusion:
    """Contact test of the arches: height map of the upper crowns' occlusal side, and vertices of the lower crowns."""

    def __init__(self, upper: DentalArch, lower: DentalArch) -> None:
        """Build the height map from both arches in the scan frame, in occlusion."""
        samples = _samples(upper)
        self._low = samples[:, [0, 2]].min(0)
        cells = np.floor((samples[:, [0, 2]] - self._low) / _CELL_MM).astype(int)
        self._map = np.full(cells.max(0) + 1, np.inf)
        np.minimum.at(self._map, tuple(cells.T), samples[:, 1])
        self._points = lower.mesh.vertices
        self._tooth = lower.tooth

    def gaps(self, T_skull_mandible: ArrayLike) -> Array:
        """Return the smallest vertical gap between each lower tooth and the upper crowns [mm] in one pose (4, 4).

        Shape (2, 7), left 1..7 then right 1..7; negative inside a crown, inf for a tooth without an opposing crown.
        """
        teeth = [[side * (k + 1) for k in range(7)] for side in (1, -1)]
        return np.array([[self._gap(T_skull_mandible, self._points[self._tooth == k]) for k in half] for half in teeth])

    def gap(self, T_skull_mandible: ArrayLike) -> float:
        """Return the smallest vertical gap between the arches [mm] in one pose (4, 4)."""
        return self._gap(T_skull_mandible, self._points[self._tooth != 0])

    def _gap(self, T: ArrayLike, points: Array) -> float:
        moved = transform_points(T, points)
        cells = np.floor((moved[:, [0, 2]] - self._low) / _CELL_MM).astype(int)
        inside = np.all((cells >= 0) & (cells < self._map.shape), axis=1)
        if not inside.any():
            return float("inf")
        return float((self._map[tuple(cells[inside].T)] - moved[inside, 1]).min())


@dataclass(frozen=True, eq=False)
class PersonAnatomy:
    """Teeth and bones in the scan frame (x left, y up, z anterior, origin at the upper incisal edge) [mm]."""

    upper: DentalArch
    lower: DentalArch
    mandible: Mesh  # bone of the mandible, without teeth
    skull: Mesh  # sockets of the joint, cheekbones, upper jaw bone
    occlusion: Occlusion  # contact between the two arches


def build_anatomy(person: Person) -> PersonAnatomy:
    """Build the teeth and bones of a subject.

    Overbite and overjet determine the lower front teeth; the lower back teeth are raised until they touch the upper
    ones.
    """
    rng = np.random.default_rng([person.seed, 0xA1A7])
    quadratic, quartic = rng.uniform(0.0160, 0.0180), rng.uniform(2.7e-5, 3.1e-5)
    cusp_slope = rng.uniform(0.32, 0.38)
    x, y, z = person.joint.incisor
    upper_shape = ArchShape(quadratic, quartic, 0.0, np.tile(_UPPER_TIPS_MM, (2, 1)), 0.0)
    upper = build_arch(UPPER, upper_shape, cusp_slope, True, person.seed)
    tips = np.tile(np.concatenate([y + _LOWER_FRONT_MM, np.full(4, y - 1.0)]), (2, 1))
    for _ in range(2):  # the second round accounts for the teeth raised in the first round
        lower = build_arch(LOWER, ArchShape(quadratic, quartic, -z, tips, x), cusp_slope, False, person.seed)
        gaps = Occlusion(upper, lower).gaps(np.eye(4))
        tips = tips + np.where(np.arange(7) >= 3, gaps - _CONTACT_GAP_MM, np.minimum(gaps - _CONTACT_GAP_MM, 0.0))
    lower = build_arch(LOWER, ArchShape(quadratic, quartic, -z, tips, x), cusp_slope, False, person.seed)
    return PersonAnatomy(upper, lower, build_mandible(person.joint), build_skull(person.joint), Occlusion(upper, lower))


def opened_bite(person: Person, occlusion: Occlusion, controls: Array, extra_mm: Array) -> Array:
    """Return controls (F, 3) with the opening increased where teeth would penetrate; see `Person.pose_with_extra`."""
    lifted = controls.copy()
    for i in range(len(lifted)):
        while lifted[i, 0] < 0.2 and occlusion.gap(person.pose_with_extra(lifted[i], extra_mm[i])) < 0.0:
            lifted[i, 0] += _OPENING_STEP
    return lifted


def _samples(arch: DentalArch) -> Array:
    """Sample points on all crown triangles more densely than the cells of the height map, shape (N, 3)."""
    faces = arch.mesh.faces[arch.tooth[arch.mesh.faces[:, 0]] != 0]
    corners = arch.mesh.vertices[faces]
    n = _SAMPLES_PER_EDGE
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    keep = i + j <= n
    u, v = i[keep] / n, j[keep] / n
    weights = np.stack([1.0 - u - v, u, v], -1)
    return np.einsum("pk,fkc->fpc", weights, corners).reshape(-1, 3)


_COLUMNS = 160
_SKIN_ROWS = 30
_SKIN = np.array([0.66, 0.41, 0.31])
_VERMILION = np.array([0.50, 0.19, 0.175])
_LINING = np.array([0.45, 0.14, 0.13])
_THROAT = np.array([0.10, 0.025, 0.025])
_TONGUE = np.array([0.72, 0.36, 0.35])
_PALATE = np.array([0.70, 0.40, 0.38])

# Midline profile of the face from the neck up, with retracted lips: rows of height and depth [mm].
_PROFILE = np.array(
    [
        [-95.0, -58.0], [-75.0, -48.0], [-62.0, -34.0], [-54.0, -18.0], [-48.0, -6.5], [-42.0, 1.5], [-36.0, 5.0],
        [-29.0, 4.0], [-23.0, 2.2], [-16.0, 4.5], [-9.0, 7.5], [0.0, 8.5], [9.0, 9.0], [17.0, 8.8], [24.0, 8.6],
        [60.0, 12.0],
    ]
)  # fmt: skip
# Rings of the mouth lining: depth, half width, and heights above and below the centre [mm].
_LINING_RINGS = ((-78.0, 0.05, 0.05, 0.05), (-60.0, 36.0, 16.0, 16.0), (-24.0, 35.5, 18.0, 18.0))

# Cross-section of a lip, from the wet side to the skin: distance outwards from the lip's edge, height above the plane
# of the edge [mm], and redness.
_LIP = np.array(
    [
        [4.5, -5.5, 1.0], [2.2, -4.2, 1.0], [0.7, -2.2, 1.0], [0.0, 0.0, 1.0], [0.5, 1.9, 1.0], [1.7, 3.4, 1.0],
        [3.4, 4.4, 1.0], [5.2, 4.6, 0.98], [6.8, 4.1, 0.8], [8.2, 3.3, 0.42], [9.6, 2.6, 0.12], [11.2, 2.1, 0.0],
    ]
)  # fmt: skip


@dataclass(frozen=True)
class LipState:
    """Shape of the lips in one frame."""

    upper_mm: float  # height of the upper lip's midpoint above the upper incisal edge
    lower_mm: float  # distance of the lower lip's midpoint below the lower incisal edge, which moves with the jaw
    width_mm: float  # half the distance between the mouth corners
    slant: float  # rise of the mouth line per mm to the left


@dataclass(frozen=True, eq=False)
class Surface:
    """A coloured surface for rendering."""

    vertices: Array  # positions [mm], shape (V, 3)
    faces: Faces  # vertex indices, shape (F, 3)
    colors: Array  # linear diffuse reflectance, shape (V, 3), 0..1
    gloss: Array  # strength of the highlight, shape (V,), 0..1
    skin: Array  # strength of the skin texture, shape (V,), 0..1
    inside: Array  # 1 inside the mouth, where the light decreases with depth; 0 elsewhere; shape (V,)
    freckles: float = 0.0  # darkness of freckles where the skin texture has full strength, 0..1


class Face:
    """Face, lips and mouth lining of one subject as a grid of rings around the mouth."""

    def __init__(self, lower_incisor: Array) -> None:
        """Build the grid, given the lower incisal point (3,) in occlusion, scan frame [mm]."""
        self._incisor_y = float(lower_incisor[1])
        angle = 2 * np.pi * (np.arange(_COLUMNS) + 0.5) / _COLUMNS
        self._angle, self._cos, self._sin = angle, np.cos(angle), np.sin(angle)
        # The lower lip moves with the jaw; the mouth corners move by a third of its motion.
        self._follow = smoothstep((0.35 - self._sin) / 0.95)
        lining_rows, lip_rows = 4, len(_LIP)
        self.rows = lining_rows + lip_rows + _SKIN_ROWS
        self.faces = grid_faces(self.rows, _COLUMNS, closed=True)
        red = np.concatenate([np.ones(lining_rows), _LIP[:, 2], np.zeros(_SKIN_ROWS)])[:, None, None]
        depth = np.concatenate([[0.0, 0.3, 0.85, 1.0], np.ones(lip_rows + _SKIN_ROWS)])[:, None, None]
        wet = np.concatenate([np.zeros(lining_rows), smoothstep((2.0 - _LIP[:, 1]) / 6.0), np.zeros(_SKIN_ROWS)])
        red_color = _VERMILION + (_LINING - _VERMILION) * wet[:, None, None]
        color = _SKIN + (red_color - _SKIN) * red
        color = _THROAT + (np.where(depth < 1.0, _LINING, color) - _THROAT) * depth
        self.colors = np.broadcast_to(color, (self.rows, _COLUMNS, 3)).reshape(-1, 3).copy()
        gloss = np.concatenate([np.zeros(lining_rows), 0.30 - 0.17 * (1 - _LIP[:, 2]), np.full(_SKIN_ROWS, 0.13)])
        self.gloss = np.repeat(gloss, _COLUMNS)
        grain = np.concatenate([np.zeros(lining_rows), 0.35 + 0.65 * (1 - _LIP[:, 2]), np.ones(_SKIN_ROWS)])
        self.skin = np.repeat(grain, _COLUMNS)
        inside = np.concatenate([np.ones(lining_rows), np.where(_LIP[:, 1] < -1.0, 1.0, 0.0), np.zeros(_SKIN_ROWS)])
        self.inside = np.repeat(inside, _COLUMNS)

    def rest(self, lips: LipState) -> Array:
        """Return the vertices for the closed bite, scan frame [mm], shape (rows, columns, 3)."""
        edge = self._edge(lips)
        outwards = np.stack([self._cos * 0.8, self._sin], -1)
        outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
        # The vermilion is narrow at the corners and widest in the middle of the lower lip.
        size = (0.45 + 0.55 * np.abs(self._sin) ** 0.7) * np.where(self._sin < 0, 1.1, 0.95)
        base = _skin_depth(edge[:, 0], edge[:, 1]) - 4.2 - 1.5 * self._cos**8
        lip_rows = []
        for distance, height, _ in _LIP:
            xy = edge + outwards * distance * (size[:, None] if distance > 0.1 else 1.0)
            lip_rows.append(np.stack([xy[:, 0], xy[:, 1], base + height * (0.6 + 0.4 * np.abs(self._sin))], -1))
        lip = np.stack(lip_rows)
        lip[4:] = _rounded(lip[4:])
        return np.concatenate([self._lining(lip[0]), lip, _rounded(self._skin_grid(lip[-1]))])

    def posed(self, lips: LipState, T_skull_mandible: ArrayLike) -> Array:
        """Return the vertices (rows * columns, 3) in the skull frame [mm] for a jaw pose (4, 4)."""
        rest = self.rest(lips)
        reach = np.ones(self.rows)
        reach[-_SKIN_ROWS:] = np.linspace(1.0, 0.75, _SKIN_ROWS)
        weight = self._follow * reach[:, None]
        weight[0] = 0.4  # equal for all points of the ring at the throat, so that it does not open
        weight = weight[..., None]
        moved = transform_points(np.asarray(T_skull_mandible, dtype=np.float64), rest.reshape(-1, 3))
        return (rest + weight * (moved.reshape(rest.shape) - rest)).reshape(-1, 3)

    def _edge(self, lips: LipState) -> Array:
        """Return the inner lip outline with the teeth closed, x and y, shape (columns, 2)."""
        middle = -1.0
        upper, lower = lips.upper_mm - middle, middle - (self._incisor_y - lips.lower_mm)
        shape = np.abs(self._sin) ** 0.8
        y = middle + np.where(self._sin > 0, upper, -lower) * shape
        x = lips.width_mm * superellipse(self._angle, 0.9)[0]
        # Add the notch in the middle of the upper lip.
        y = y - 0.9 * np.exp(-((x / 4.0) ** 2)) * (self._sin > 0)
        return np.stack([x, y + lips.slant * x], -1)

    def _lining(self, lip_inner: Array) -> Array:
        """Return the rings of the mouth lining from the throat to the wet side of the lips, (4, columns, 3)."""
        rings, (x, y) = [], superellipse(self._angle, 0.7)
        for z, half_width, up, down in _LINING_RINGS:
            height = np.where(self._sin > 0, up, down) * y - 1.0
            rings.append(np.stack([half_width * x, height, np.full(_COLUMNS, z)], -1))
        rings.append(0.5 * (rings[-1] + lip_inner) + [0.0, 0.0, 3.0])
        return np.stack(rings)

    def _skin_grid(self, border: Array) -> Array:
        """Return the rings of skin from the vermilion border to the edge of the face, (rows, columns, 3)."""
        far = np.stack([70.0 * self._cos, np.where(self._sin > 0, 62.0, 72.0) * self._sin - 8.0], -1)
        share = (np.arange(1, _SKIN_ROWS + 1) / _SKIN_ROWS)[:, None, None] ** 1.35
        xy = border[None, :, :2] + share * (far - border[:, :2])
        z = _skin_depth(xy[..., 0], xy[..., 1])
        # Blend the first rows so that they continue the lip smoothly.
        offset = border[:, 2] - _skin_depth(border[:, 0], border[:, 1])
        z = z + offset * np.exp(-((share[..., 0] / 0.10) ** 1.5))
        return np.concatenate([xy, z[..., None]], -1)


def _rounded(rings: Array) -> Array:
    """Smooth each ring (R, A, 3) along its circumference with a Hann window, to avoid creases at the mouth corners."""
    kernel = np.hanning(13)[1:-1]
    kernel /= kernel.sum()
    return sum(k * np.roll(rings, i - 5, axis=1) for i, k in enumerate(kernel))


def _skin_depth(x: Array, y: Array) -> Array:
    """Return the depth z of the skin relative to the frontal plane [mm], at positions of any shape."""
    # Average to round the corners of the polygon.
    middle = np.mean([np.interp(y + shift, *_PROFILE.T) for shift in (-4.0, -2.0, 0.0, 2.0, 4.0)], axis=0)
    chin = smoothstep((-22.0 - y) / 20.0)
    z = middle - (0.0138 + 0.0045 * chin) * x**2 - 1.1e-6 * x**4
    # Add philtrum, nose and nasolabial folds.
    lip = np.exp(-(((y - 17.0) / 7.5) ** 2))
    z = z + lip * (0.7 * np.exp(-(((np.abs(x) - 5.0) / 2.6) ** 2)) - 0.8 * np.exp(-((x / 3.0) ** 2)))
    z = z + 15.0 * np.exp(-((x / 12.5) ** 2)) * smoothstep((y - 21.0) / 13.0)
    fold = np.abs(x) - (19.0 + 0.62 * (24.0 - y))
    strength = smoothstep((y + 12.0) / 10.0) * smoothstep((40.0 - y) / 14.0)
    z = z - 1.5 * strength * np.exp(-((fold / 3.2) ** 2)) + 1.6 * strength * np.exp(-(((fold - 9.0) / 8.0) ** 2))
    return z + 1.6 * chin * np.exp(-((x / 13.0) ** 2)) * np.exp(-(((y + 37.0) / 8.0) ** 2))


def palate() -> Surface:
    """Return the roof of the mouth between the upper teeth, in the scan frame."""
    z = np.linspace(-56.0, -6.0, 26)
    across = np.linspace(-1.0, 1.0, 25)
    half = 24.0 * np.sqrt(np.clip((-z - 2.0) / 40.0, 0.03, 1.0)) + 0.5
    x = half[:, None] * across
    rise = np.sqrt(np.clip((-z - 5.0) / 18.0, 0.0, 1.0))[:, None]
    y = 7.5 + 11.0 * rise * (1.0 - np.abs(across) ** 2.5)
    ridges = 0.35 * np.sin(z * 1.5)[:, None] * np.exp(-(((z + 14.0) / 8.0) ** 2))[:, None]
    vertices = np.stack([x, y + ridges, np.broadcast_to(z[:, None], x.shape)], -1).reshape(-1, 3)
    faces = grid_faces(26, 25, closed=False)
    return _plain(vertices, faces, _PALATE, 0.35)


def tongue(forward_mm: float, up_mm: float, side_mm: float) -> Surface:
    """Return the tongue in the mandible frame, moved forward, with its tip raised and moved left by given lengths."""
    around, along = 40, 26
    u = 2 * np.pi * np.arange(around) / around
    t = np.linspace(0.0, 1.0, along)
    width = 17.5 * np.sqrt(np.clip(1.0 - (t * 1.02 - 0.25).clip(0) ** 2 / 0.6, 0.002, 1.0))
    height = 8.0 * (1.0 - 0.55 * t) * np.sqrt(np.clip(1.0 - t**6, 0.002, 1.0))
    z = -66.0 + (57.0 + forward_mm) * t
    lift = up_mm * smoothstep((t - 0.45) / 0.55)
    across, top = superellipse(u, 0.8)
    x = width[:, None] * across + side_mm * t[:, None] ** 2
    groove = 1.3 * np.exp(-((x / 3.0) ** 2)) * (top > 0) * np.sin(np.pi * t)[:, None]
    y = -8.0 + lift[:, None] + height[:, None] * top - groove
    vertices = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], -1).reshape(-1, 3)
    return _plain(vertices, grid_faces(along, around, closed=True)[:, ::-1], _TONGUE, 0.45)


def _plain(vertices: Array, faces: Faces, color: Array, gloss: float) -> Surface:
    n = len(vertices)
    return Surface(vertices, faces, np.tile(color, (n, 1)), np.full(n, gloss), np.full(n, 0.3), np.ones(n))
