"""Parametric bones without teeth: mandible, and skull with fossa and eminence, cheekbone, upper jaw bone, braincase.

Condyles that slide along the joint surfaces trace `eminence_path`. All surfaces are in axes x left, y up, z anterior
with the origin at the upper incisal edge [mm], in the closed bite.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.meshes.surfaces import Faces, grid_faces, loft, merged, outward, superellipse

#: Half axes of a condyle [mm]: lateral, up, forward.
CONDYLE_MM = np.array([9.0, 4.2, 4.8])
#: Distance from the centre of a condyle to the bone of the fossa: the condyle's radius plus the disc [mm].
JOINT_SPACE_MM = 6.0
_BONE = (222, 206, 178)
_AROUND = 24
# Fraction of the arch's scale applied to each row of the mandible's body, from the chin to the ramus.
_ARCH_SHARE = np.array([1.0, 1.0, 1.0, 1.0, 0.5, 0.0])


@dataclass(frozen=True)
class JointShape:
    """Positions and joint surfaces that determine the bones; pairs are (left, right), lengths are in mm."""

    condyles: Array  # centres of the condyles at rest, shape (2, 3)
    incisor: Array  # lower incisal point at rest, shape (3,)
    eminence_height_mm: Array  # drop of each eminence from fossa to crest, shape (2,)
    eminence_width_mm: Array  # half width of the slope, shape (2,)
    eminence_start_mm: Array  # forward distance from rest to the steepest point, shape (2,)

    @property
    def condylar_distance_mm(self) -> float:
        """Return the distance between the condyle centres [mm], the same in every pose."""
        return float(np.linalg.norm(self.condyles[0] - self.condyles[1]))


def eminence_path(joint: JointShape, side: int, slide_mm: ArrayLike) -> Array:
    """Return the height of a condyle centre (side 0 left, 1 right) relative to rest [mm], negative down the eminence.

    The section is an S curve in closed form (concave fossa, slope, convex crest), flat far in front and behind.
    `slide_mm` is the forward distance of the condyle from rest, any shape.
    """
    slide = np.asarray(slide_mm, dtype=np.float64)
    start, width = joint.eminence_start_mm[side], joint.eminence_width_mm[side]
    return -joint.eminence_height_mm[side] / 2 * (np.tanh((slide - start) / width) + np.tanh(start / width))


def build_mandible(joint: JointShape, arch: tuple[float, float] = (1.0, 1.0)) -> Mesh:
    """Build the mandible without teeth from overlapping watertight parts: body, rami, coronoid processes, condyles.

    `arch` is the width and length of the dental arch relative to the mean arch.
    """
    parts = [_body(joint, arch)]
    for side, centre in zip((1.0, -1.0), joint.condyles, strict=True):
        parts += [_ramus(joint, side, centre), _condyle(side, centre), _coronoid(side, centre)]
    return _mesh(merged(parts))


def build_skull(joint: JointShape, arch: tuple[float, float] = (1.0, 1.0), *, whole: bool = False) -> Mesh:
    """Build the skull from overlapping watertight parts: joint sockets, cheekbones and upper jaw bone.

    `arch` is as for `build_mandible`; `whole` adds nose, rims of the orbits and braincase.
    """
    parts = [_maxilla(joint, arch), *(_upper_skull(joint) if whole else ())]
    for k, side in enumerate((1.0, -1.0)):
        parts += [_socket(joint, k), _cheekbone(joint, k, side)]
    return _mesh(merged(parts))


def articular_surface(joint: JointShape, side: int, slide_mm: Array) -> Array:
    """Return points (y, z) of the joint socket's sagittal section [mm], shape (..., 2), at forward slides (...).

    The section is the condyle's path, offset by the joint space. Side 0 is left, 1 is right.
    """
    step = 1e-4
    slope = (eminence_path(joint, side, slide_mm + step) - eminence_path(joint, side, slide_mm - step)) / (2 * step)
    length = np.hypot(slope, 1.0)
    path_y = joint.condyles[side, 1] + eminence_path(joint, side, slide_mm)
    path_z = joint.condyles[side, 2] + slide_mm
    return np.stack([path_y + JOINT_SPACE_MM / length, path_z - JOINT_SPACE_MM * slope / length], -1)


def _mesh(part: tuple[Array, Faces]) -> Mesh:
    vertices, faces = part
    return Mesh(vertices, faces, np.tile(np.array(_BONE, dtype=np.uint8), (len(vertices), 1)))


def _ovals(centres: Array, half_x: Array, half_z: Array, squareness: float = 0.8) -> tuple[Array, Faces]:
    """Loft horizontal rounded rectangles with centres (R, 3) and half sizes (R,) [mm]."""
    x, z = superellipse(2 * np.pi * np.arange(_AROUND) / _AROUND, squareness)
    offsets = np.stack([half_x[:, None] * x, np.zeros((len(centres), _AROUND)), half_z[:, None] * z], -1)
    return loft(centres[:, None] + offsets)


def _swept(path: Array, half_wide: Array, half_high: Array) -> tuple[Array, Faces]:
    """Loft upright ovals along a path (R, 3), with half widths and heights (R,) [mm]."""
    tangent = np.gradient(path, axis=0) * [1.0, 0.0, 1.0]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.stack([tangent[:, 2], np.zeros(len(path)), -tangent[:, 0]], -1)
    wide, high = superellipse(2 * np.pi * np.arange(_AROUND) / _AROUND, 0.8)
    rings = path[:, None] + half_wide[:, None, None] * wide[None, :, None] * across[:, None]
    rings[..., 1] += half_high[:, None] * high
    return loft(rings)


def _spline(knots: Array, values: Array, at: Array) -> Array:
    """Interpolate values (K, ...) at positions within the knots with a Catmull-Rom spline."""
    slopes = np.gradient(values, knots, axis=0)
    i = np.clip(np.searchsorted(knots, at) - 1, 0, len(knots) - 2)
    h = (knots[i + 1] - knots[i])[:, None]
    t = ((at - knots[i])[:, None]) / h
    a, b, u, v = values[i], values[i + 1], slopes[i] * h, slopes[i + 1] * h
    return (1 + 2 * t) * (1 - t) ** 2 * a + t * (1 - t) ** 2 * u + t**2 * (3 - 2 * t) * b + t**2 * (t - 1) * v


def _body(joint: JointShape, arch: tuple[float, float]) -> tuple[Array, Faces]:
    """Return the body of the mandible, a horseshoe from ramus to ramus below the lower gum."""
    x, y, z = joint.incisor
    # columns: x, y of the middle, z, half width, half height; rows: from the chin to the left ramus
    half = np.array(
        [
            [0.0, y - 24.0, -5.5, 5.5, 10.5],
            [13.0, y - 23.5, -8.5, 5.5, 10.0],
            [22.0, y - 22.0, -20.0, 5.5, 9.5],
            [28.0, y - 20.0, -36.0, 6.0, 9.5],
            [34.0, y - 16.5, -52.0, 6.0, 11.0],
            [41.0, y - 11.0, -66.0, 5.0, 12.0],
        ]
    )
    half[:, 0] *= 1.0 + (arch[0] - 1.0) * _ARCH_SHARE
    half[:, 2] = z + half[:, 2] * (1.0 + (arch[1] - 1.0) * _ARCH_SHARE)
    return _horseshoe(half, x, 61)


def _ramus(joint: JointShape, side: float, centre: Array) -> tuple[Array, Faces]:
    """Return the plate of one ramus, from the angle of the jaw up to the notch."""
    # columns: height relative to the condyle, inward shift, forward position of the middle, half thickness, half length
    rows = np.array(
        [
            [-60.0, 7.0, 15.0, 2.0, 6.0],
            [-55.0, 6.0, 16.0, 4.5, 14.5],
            [-44.0, 5.0, 17.0, 5.0, 18.0],
            [-30.0, 3.5, 15.5, 4.5, 17.5],
            [-18.0, 2.0, 13.5, 3.5, 16.5],
            [-12.0, 1.5, 12.5, 2.4, 14.5],
            [-9.0, 1.5, 12.5, 0.6, 12.0],
        ]
    )
    rows = _spline(rows[:, 0], rows, np.linspace(-60.0, -9.0, 27))
    return _column(centre, side, rows)


def _condyle(side: float, centre: Array) -> tuple[Array, Faces]:
    """Return the neck and head of one condyle; the head is an ellipsoid about the condyle's centre."""
    neck = np.array([[-24.0, 2.5, 5.5, 2.6, 6.5], [-15.0, 1.5, 1.5, 4.0, 5.0], [-8.0, 0.5, -0.3, 5.5, 4.0]])
    neck = _spline(neck[:, 0], neck, np.linspace(-24.0, -8.0, 9))
    turn = np.linspace(-0.35 * np.pi, 0.499 * np.pi, 13)
    head = np.stack(
        [
            CONDYLE_MM[1] * np.sin(turn),
            np.zeros(13),
            np.zeros(13),
            CONDYLE_MM[0] * np.cos(turn),
            CONDYLE_MM[2] * np.cos(turn),
        ],
        -1,
    )
    return _column(centre, side, np.concatenate([neck, head]), squareness=1.0)


def _coronoid(side: float, centre: Array) -> tuple[Array, Faces]:
    """Return the coronoid process, in front of the notch."""
    rows = np.array(
        [
            [-24.0, 2.5, 21.0, 2.6, 7.0],
            [-12.0, 2.5, 23.5, 2.8, 6.0],
            [-3.0, 3.0, 25.5, 2.0, 3.4],
            [1.0, 3.0, 25.0, 0.8, 1.2],
        ]
    )
    return _column(centre, side, _spline(rows[:, 0], rows, np.linspace(-24.0, 1.0, 14)))


def _column(centre: Array, side: float, rows: Array, squareness: float = 0.8) -> tuple[Array, Faces]:
    """Loft upwards near a condyle; rows: height, inward shift, forward position, half thickness, half length."""
    centres = centre + np.stack([-side * rows[:, 1], rows[:, 0], rows[:, 2]], -1)
    return _ovals(centres, rows[:, 3], rows[:, 4], squareness)


def _socket(joint: JointShape, k: int) -> tuple[Array, Faces]:
    """Return fossa, eminence and the bone in front of the eminence, as a slab above the condyle."""
    slide = np.linspace(-7.0, 22.0, 40)
    section = articular_surface(joint, k, slide)
    behind = np.maximum(-3.0 - slide, 0.0)
    section[:, 0] -= 0.35 * behind**2
    across = np.linspace(-12.0, 12.0, 13)
    vault = 1.6 * (across / 12.0) ** 2
    under = np.stack(
        [
            np.broadcast_to(joint.condyles[k, 0] + across, (40, 13)),
            section[:, :1] - vault,
            np.broadcast_to(section[:, 1:], (40, 13)),
        ],
        -1,
    )
    # thickness of the slab: large in the middle, small at the edges, domed over the fossa
    along = np.linspace(-1.0, 1.0, 40)[:, None]
    thick = np.sqrt((1.0 - along**6) * (1.0 - (across / 12.0) ** 6) + 0.01)
    dome = 3.0 * np.exp(-(((slide[:, None] - 2.0) / 9.0) ** 2)) * np.cos(across / 12.0 * np.pi / 2)
    over = under + np.stack([0.0 * thick, 1.0 + 4.5 * thick + dome, 0.0 * thick], -1)
    vertices = np.concatenate([under, over[:, ::-1]], 1).reshape(-1, 3)
    n = 2 * len(across)
    j = np.arange(len(across) - 1)
    ends = []
    for start, turn in ((0, 1), (39 * n, -1)):
        below, above = start + j, start + n - 1 - j
        strip = np.concatenate([np.stack([below, below + 1, above], -1), np.stack([below + 1, above - 1, above], -1)])
        ends.append(strip[:, ::turn])
    faces = np.concatenate([grid_faces(40, n, closed=True), *ends]).astype(np.int32)
    return vertices, outward(vertices, faces)


def _cheekbone(joint: JointShape, k: int, side: float) -> tuple[Array, Faces]:
    """Return the zygomatic arch, from the socket forward to the cheek and inward to the upper jaw bone."""
    x, y, z = joint.condyles[k]
    rows = np.array(
        [
            [x + side * 9.0, y + 7.0, z + 8.0, 3.0, 4.0],
            [x + side * 12.0, y + 4.0, z + 26.0, 2.4, 3.4],
            [x + side * 9.0, y + 1.0, z + 44.0, 3.0, 5.0],
            [side * 48.0, y - 5.0, -26.0, 5.0, 9.0],
            [side * 34.0, y - 9.0, -18.0, 6.0, 10.0],
            [side * 24.0, y - 12.0, -17.0, 5.0, 9.0],
        ]
    )
    rows = _spline(np.arange(6.0), rows, np.linspace(0.0, 5.0, 36))
    return _swept(rows[:, :3], rows[:, 3], rows[:, 4])


def _maxilla(joint: JointShape, arch: tuple[float, float]) -> tuple[Array, Faces]:
    """Return the upper jaw bone, a horseshoe above the upper gum."""
    y = 0.5 * joint.condyles[:, 1].mean()
    half = np.array(
        [[0.0, y, -8.0, 4.5, 8.0], [11.0, y, -9.0, 5.0, 9.0], [21.0, y, -19.0, 6.0, 9.5],
         [26.0, y, -34.0, 6.0, 9.5], [28.0, y, -50.0, 5.0, 9.0]]
    )  # fmt: skip
    half[:, [0, 2]] *= arch
    return _horseshoe(half, 0.0, 49)


def _upper_skull(joint: JointShape) -> list[tuple[Array, Faces]]:
    """Return braincase and brow, and below them sides of the nose and outer rims of the orbits; mean adult sizes."""
    wide = joint.condylar_distance_mm / 100.0
    y, z = joint.condyles[:, 1:].mean(0)
    # columns: height, forward position of the middle, half width, half length; rows: from the base to the crown
    rows = np.array(
        [
            [y + 2.0, z - 34.0, 18.0, 24.0], [y + 9.0, z - 20.0, 46.0, 54.0], [y + 26.0, z - 5.0, 65.0, 82.0],
            [y + 50.0, z - 3.0, 70.0, 88.0], [y + 72.0, z - 6.0, 66.0, 82.0], [y + 90.0, z - 10.0, 52.0, 64.0],
            [y + 102.0, z - 12.0, 26.0, 34.0], [y + 104.0, z - 12.0, 6.0, 8.0],
        ]
    )  # fmt: skip
    rows = _spline(np.arange(8.0), rows, np.linspace(0.0, 7.0, 43))
    middle = np.stack([np.zeros(len(rows)), rows[:, 0], rows[:, 1]], -1)
    brow = np.array(
        [[0.0, y + 31.0, -10.0, 5.0, 6.0], [20.0, y + 33.0, -11.0, 5.0, 5.0], [38.0, y + 32.0, -16.0, 5.0, 5.0],
         [50.0, y + 28.0, -27.0, 5.0, 5.0], [54.0, y + 24.0, -44.0, 4.0, 6.0]]
    )  # fmt: skip
    parts = [_ovals(middle, wide * rows[:, 2], rows[:, 3], 0.9), _horseshoe(brow, 0.0, 49)]
    for side in (1.0, -1.0):
        for pillar in (  # columns: x, height, z, half width, half length
            [[19.0, y - 20.0, -14.0, 5.0, 4.0], [12.0, y - 4.0, -10.0, 4.5, 4.0], [9.0, y + 32.0, -8.0, 5.0, 5.0]],
            [[50.0, y - 8.0, -28.0, 4.0, 4.0], [52.0, y + 10.0, -26.0, 3.5, 4.0], [49.0, y + 34.0, -22.0, 6.0, 6.0]],
        ):
            at = _spline(np.arange(3.0), np.array(pillar), np.linspace(0.0, 2.0, 17)) * [side, 1.0, 1.0, 1.0, 1.0]
            parts.append(_ovals(at[:, :3], at[:, 3], at[:, 4]))
    return parts


def _horseshoe(half: Array, midline_x: float, count: int) -> tuple[Array, Faces]:
    """Sweep ovals along a symmetric path; rows of its left half: x, y, z, half width, half height."""
    rows = np.concatenate([half[:0:-1] * [-1.0, 1.0, 1.0, 1.0, 1.0], half])
    rows[:, 0] += midline_x
    rows = _spline(np.arange(len(rows), dtype=np.float64), rows, np.linspace(0.0, len(rows) - 1.0, count))
    return _swept(rows[:, :3], rows[:, 3], rows[:, 4])
