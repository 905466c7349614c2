"""Arches of arbitrary persons, with individual size, position and gum line of every tooth.

The gum is a separate ridge around the crowns ("dipping"), a surface that continues each crown at its cervical line
("continuous"), or missing from the scan ("crowns"). Built with the occlusal side up, like `dental_arch`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.geometry import so3_exp
from jawusd.meshes.surfaces import Faces, loft, merged, outward
from jawusd.synthetic.dental_arch import (
    COLUMN_MM,
    CONTACT_MM,
    CONTACT_OVERLAP_MM,
    GREY,
    RED,
    ArchLine,
    DentalArch,
    crown_colors,
    gum_ridge,
)
from jawusd.synthetic.teeth import CrownForm, crown
from subjects.traits import ArchTraits, Gums, Traits

_AROUND = 36
# Profile of the gum below a crown's cervical line: distance outwards and height [mm].
_COLLAR = np.array([[0.05, -0.03], [0.22, -0.2], [0.5, -0.8], [0.8, -2.2], [1.1, -4.5], [0.9, -7.0]])
_BRACKET_MM = np.array([3.0, 3.0, 1.8])


@dataclass(frozen=True, eq=False)
class PlacedTooth:
    """One tooth of an arch and its position."""

    form: CrownForm
    tooth: int  # 1..7 left, -1..-7 right
    s_mm: float  # arc length of its centre
    tip_mm: float  # height of its edge or highest cusp
    facial_mm: float  # offset outside the arch line
    turn_rad: float
    present: bool


def placed_teeth(
    forms: tuple[CrownForm, ...], traits: ArchTraits, tips_mm: Array, facial_mm: Array, midline_s_mm: float
) -> list[PlacedTooth]:
    """Return the teeth of an arch, including missing ones; `tips_mm` and `facial_mm` have shape (2, 7)."""
    out = []
    for half, side in enumerate((1, -1)):
        edge = 0.0
        for k, form in enumerate(forms):
            scale = float(traits.height_scale[half, k])
            own = replace(
                form,
                width_mm=form.width_mm * float(traits.width_scale[half, k]),
                depth_mm=form.depth_mm * float(traits.width_scale[half, k]),
                height_mm=form.height_mm * scale,
                tip_mm=form.tip_mm * min(scale, 1.0),
            )
            taken = own.width_mm - CONTACT_OVERLAP_MM - float(traits.overlap_mm[half, k])
            out.append(
                PlacedTooth(
                    own,
                    side * (k + 1),
                    midline_s_mm + side * (edge + taken / 2),
                    float(tips_mm[half, k]),
                    float(facial_mm[half, k] + traits.shift_mm[half, k]),
                    float(traits.turn_rad[half, k]),
                    bool(traits.present[half, k]),
                )
            )
            edge += taken
    return out


def build(
    arch: list[PlacedTooth], line: ArchLine, person: Traits, traits: ArchTraits, upper: bool, gums: Gums
) -> DentalArch:
    """Build an arch, crowns first; the upper arch points down.

    For "crowns" the gum is built as for "continuous"; `without_gum` removes it.
    """
    rng = np.random.default_rng([person.seed, 0xC20, int(upper)])
    standing = [seat for seat in arch if seat.present]
    rings, locals_ = [], []
    for seat in arch:  # missing teeth consume random numbers too, so that the others do not change
        local, _ = crown(seat.form, person.cusp_slope, rng)
        if seat.present:
            placed = _placed(local, seat, line)
            rings.append(placed[:-2].reshape(-1, _AROUND, 3))
            locals_.append(local)
    everything = np.concatenate([ring.reshape(-1, 3) for ring in rings])
    parts: list[tuple[Array, Faces]] = []
    colors, tooth, gum_parts = [], [], []
    for seat, ring, local in zip(standing, rings, locals_, strict=True):
        k = abs(seat.tooth) - 1
        if gums == "dipping":
            vertices, faces = loft(ring)
            paint = crown_colors(local, seat.form, k)
        else:
            cut, share = _above_margin(ring, arch, line)
            vertices, faces = loft(cut)
            flat = local[:-2].reshape(-1, _AROUND, 3)
            shape = _resampled(flat, share)
            paint = crown_colors(loft(shape)[0], seat.form, k)
            gum_parts.append(_collar(cut[0]))
        if gums == "continuous":
            faces = faces[(faces != len(vertices) - 2).all(1)]  # open at the cervical line, where the gum continues
        parts.append((vertices, faces))
        colors.append(paint)
        tooth.append(np.full(len(vertices), seat.tooth))
        if traits.brackets and k < 5:
            box = _bracket(ring, seat, line)
            parts.append(box)
            colors.append(np.tile(np.array(RED, np.uint8), (len(box[0]), 1)))
            tooth.append(np.full(len(box[0]), seat.tooth))
    if gums == "dipping":
        span = np.abs([seat.s_mm for seat in arch]).max() + 7.0
        s = np.linspace(-span, span, int(2 * span / COLUMN_MM))
        gum_parts = [gum_ridge(line, s, margin(arch, s), everything)]
    gum = merged(gum_parts)
    vertices, faces = merged([*parts, gum])
    colors.append(np.tile(np.array(GREY, np.uint8), (len(gum[0]), 1)))
    tooth.append(np.zeros(len(gum[0]), int))
    vertices = _warped(vertices, person)
    if upper:
        vertices, faces = vertices * [1.0, -1.0, 1.0], faces[:, ::-1]
    mesh = Mesh(vertices, faces, np.concatenate(colors).astype(np.uint8))
    return DentalArch(mesh, np.concatenate(tooth).astype(np.int8))


def without_gum(arch: DentalArch) -> Mesh:
    """Return the crowns of an arch without gum."""
    first_gum = int(np.argmax(arch.tooth == 0)) if (arch.tooth == 0).any() else len(arch.tooth)
    faces = arch.mesh.faces[(arch.mesh.faces < first_gum).all(1)]
    colors = None if arch.mesh.colors is None else arch.mesh.colors[:first_gum]
    return Mesh(arch.mesh.vertices[:first_gum], faces, colors)


def margin(arch: list[PlacedTooth], s: Array) -> Array:
    """Return the height of the gum margin at arc lengths (...): the gum line at each tooth, papillae in between."""
    order = sorted(arch, key=lambda seat: seat.s_mm)
    centre = np.array([seat.s_mm for seat in order])
    level = np.array([seat.tip_mm - seat.form.height_mm - 0.6 * (not seat.present) for seat in order])
    rise = np.array([(0.38 if abs(seat.tooth) <= 3 else 0.30) * seat.form.height_mm * seat.present for seat in order])
    half = np.array([seat.form.width_mm / 2 for seat in order])
    nearest = np.abs(np.asarray(s)[..., None] - centre).argmin(-1)
    across = np.minimum(np.abs(s - centre[nearest]) / half[nearest], 1.0)
    return np.interp(s, centre, level) + np.interp(s, centre, rise) * across**2.6


def _placed(local: Array, seat: PlacedTooth, line: ArchLine) -> Array:
    """Transform a crown to its position."""
    side = 1 if seat.tooth > 0 else -1
    point, normal = line.at(np.array(seat.s_mm))
    distal = side * np.array([normal[1], 0.0, -normal[0]])
    facial = np.array([normal[0], 0.0, normal[1]])
    axes = np.stack([distal, [0.0, 1.0, 0.0], facial], 1)
    turn = so3_exp(np.array([np.deg2rad(seat.form.torque_deg), 0.0, 0.0])) @ so3_exp(
        np.array([0.0, seat.turn_rad, 0.0])
    )
    tip = np.array([0.0, seat.form.height_mm, seat.form.tip_z_mm])
    position = np.array([point[0], seat.tip_mm, point[1]]) + (CONTACT_MM + seat.facial_mm) * facial
    return (local - tip) @ (axes @ turn).T + position


def _above_margin(rings: Array, arch: list[PlacedTooth], line: ArchLine) -> tuple[Array, Array]:
    """Cut rings (R, A, 3) at the gum margin; return the remaining rings and the ring position of their vertices."""
    points = rings.reshape(-1, 3)
    s, _ = line.coordinates(points[:, [0, 2]])
    above = (points[:, 1] - margin(arch, s)).reshape(rings.shape[:2])
    count, columns = len(rings), np.arange(rings.shape[1])
    last = np.array([np.flatnonzero(above[: count // 2, j] < 0).max(initial=0) for j in columns])
    low, high = above[last, columns], above[last + 1, columns]
    cross = last + np.clip(-low / np.where(high > low, high - low, 1.0), 0.0, 0.98)
    first_whole = int(np.ceil(cross.max()))
    between = max(1, first_whole - int(cross.min()))
    steps = np.arange(between)[:, None] / between
    share = np.concatenate(
        [
            cross + steps * (first_whole - cross),
            np.broadcast_to(np.arange(first_whole, count)[:, None], (count - first_whole, _AROUND)),
        ]
    )
    return _resampled(rings, share), share


def _resampled(rings: Array, share: Array) -> Array:
    """Interpolate rings (R, A, 3) along columns at ring positions (N, A)."""
    low = np.minimum(share.astype(int), len(rings) - 2)
    columns = np.arange(rings.shape[1])
    weight = (share - low)[..., None]
    return rings[low, columns] * (1.0 - weight) + rings[low + 1, columns] * weight


def _collar(cervical: Array) -> tuple[Array, Faces]:
    """Return the gum around one crown, from its cervical line (A, 3) outwards and down, closed at the bottom."""
    outwards = cervical[:, [0, 2]] - cervical[:, [0, 2]].mean(0)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    even = cervical[:, 1].mean()
    rings = [cervical]
    for distance, drop in _COLLAR:
        follow = np.clip(1.0 + drop / 4.0, 0.0, 1.0)
        ring = cervical.copy()
        ring[:, [0, 2]] += distance * outwards
        ring[:, 1] = even + (cervical[:, 1] - even) * follow + drop
        rings.append(ring)
    vertices, faces = loft(np.stack(rings[::-1]))
    top = len(vertices) - 1
    return vertices, faces[(faces != top).all(1)]  # open towards the crown


def _bracket(rings: Array, seat: PlacedTooth, line: ArchLine) -> tuple[Array, Faces]:
    """Return a small box on the facial face of a crown."""
    _, normal = line.at(np.array(seat.s_mm))
    facial = np.array([normal[0], 0.0, normal[1]])
    height = rings[..., 1].max() - 0.5 * seat.form.height_mm
    side = rings.reshape(-1, 3)[np.abs(rings.reshape(-1, 3)[:, 1] - height) < 1.0]
    face = side[(side @ facial).argmax()]
    corners = np.array([[x, y, z] for y in (-1, 1) for x, z in ((-1, -1), (1, -1), (1, 1), (-1, 1))], float) / 2
    axes = np.stack([np.array([normal[1], 0.0, -normal[0]]), [0.0, 1.0, 0.0], facial], 1)
    centre = np.array([face[0], height, face[2]]) + 0.35 * facial
    vertices = (corners * _BRACKET_MM) @ axes.T + centre
    quads = np.array([[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
    inside = vertices.mean(0)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    turned = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - inside) < 0
    faces = np.where(turned[:, None], faces[:, ::-1], faces).astype(np.int32)
    return vertices, outward(vertices, faces)


def _warped(vertices: Array, person: Traits) -> Array:
    """Make an arch asymmetric, equally for both arches, so that they still occlude."""
    wide, lead = person.skew
    x = vertices[:, 0]
    return np.stack([x * (1.0 + wide * np.tanh(x / 15.0)), vertices[:, 1], vertices[:, 2] + lead * x], -1)
