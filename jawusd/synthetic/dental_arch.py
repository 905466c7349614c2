"""Dental arches: crowns placed along a curve, and a scalloped gum around their bases.

An arch is built with the occlusal side up (x left, y occlusal, z anterior), and mirrored in y for the upper jaw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.geometry import so3_exp
from jawusd.meshes.surfaces import Faces, loft, merged, outward
from jawusd.synthetic.teeth import CrownForm, crown

RED, GREEN, GREY = (215, 45, 40), (40, 190, 60), (150, 150, 150)
# Depth of the contact points behind the incisal edges and buccal cusp tips [mm]; teeth are aligned at these points.
CONTACT_MM = 0.9
CONTACT_OVERLAP_MM = 0.22
_BOUNDARY_MM = 2.5
# Gum cross-section on one side, from fold to crest: distance outside the crown, height above the gum margin.
_GUM_SIDE = np.array(
    [[2.6, -9.0], [2.0, -6.2], [1.45, -3.8], [1.0, -2.1], [0.72, -1.0], [0.42, -0.3], [0.05, 0.0], [-0.8, -0.5]]
)
COLUMN_MM = 0.55


@dataclass(frozen=True)
class ArchShape:
    """Shape and position of one dental arch."""

    quadratic_per_mm: float  # coefficient a of the curve z = -(a x^2 + b x^4) outside the edges and buccal cusps [1/mm]
    quartic_per_mm3: float  # coefficient b of the curve [1/mm^3]
    setback_mm: float  # distance by which the edges and buccal cusps lie inside the curve
    # height of edge or highest cusp of each tooth, first incisor to second molar, left then right, shape (2, 7)
    tips_mm: Array
    midline_mm: float  # x coordinate of the midline of the arch


@dataclass(frozen=True, eq=False)
class DentalArch:
    """One dental arch with gum, in the scan frame."""

    mesh: Mesh  # crowns (coloured red and green), then gum (gray)
    tooth: NDArray[np.int8]  # tooth number of each vertex, 1..7 left, -1..-7 right from the midline, 0 gum, shape (V,)


class ArchLine:
    """Planar curve through the contact points; its parameter is the arc length from the midline, positive left."""

    def __init__(self, shape: ArchShape) -> None:
        x = np.linspace(-40.0, 40.0, 8001)
        z = -shape.quadratic_per_mm * x**2 - shape.quartic_per_mm3 * x**4
        slope = -2 * shape.quadratic_per_mm * x - 4 * shape.quartic_per_mm3 * x**3
        normal = np.stack([-slope, np.ones_like(x)], -1) / np.hypot(slope, 1.0)[:, None]
        points = np.stack([x, z], -1) - (shape.setback_mm + CONTACT_MM) * normal
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        s = np.concatenate([[0.0], np.cumsum(steps)])
        self._s = s - np.interp(0.0, x, s)
        self._points = points + [shape.midline_mm, 0.0]
        self._normal = normal

    def at(self, s: Array) -> tuple[Array, Array]:
        """Return points and outward normals (x, z) at arc lengths, (..., 2) each."""
        points = np.stack([np.interp(s, self._s, self._points[:, k]) for k in (0, 1)], -1)
        normal = np.stack([np.interp(s, self._s, self._normal[:, k]) for k in (0, 1)], -1)
        return points, normal / np.linalg.norm(normal, axis=-1, keepdims=True)

    def coordinates(self, xz: Array) -> tuple[Array, Array]:
        """Return arc length and outward offset of points (N, 2)."""
        s = np.empty(len(xz))
        for i in range(0, len(xz), 4000):
            part = xz[i : i + 4000]
            squares = ((part[:, None] - self._points[None, ::10]) ** 2).sum(-1)
            s[i : i + 4000] = self._s[::10][squares.argmin(1)]
        points, normal = self.at(s)
        s = s + np.einsum("ni,ni->n", xz - points, np.stack([normal[:, 1], -normal[:, 0]], -1))
        points, normal = self.at(s)
        return s, np.einsum("ni,ni->n", xz - points, normal)


def build_arch(forms: tuple[CrownForm, ...], shape: ArchShape, cusp_slope: float, upper: bool, seed: int) -> DentalArch:
    """Build an arch with gum.

    Args:
        forms: tooth kinds from the first incisor to the second molar.
        cusp_slope: slope of the cusps [-], height lost per mm of distance from the tip.
        upper: whether to mirror the arch downwards.
        seed: seed of the positions and irregularities of the teeth, which do not depend on the heights of the tips.
    """
    rng = np.random.default_rng([seed, 0x7EE7, int(upper)])
    line = ArchLine(shape)
    centres = _centres(forms)
    parts, tooth, colors = [], [], []
    for half, side in enumerate((1, -1)):
        for k, form in enumerate(forms):
            local, faces = crown(form, cusp_slope, rng)
            placed = _placed(local, form, line, side * centres[k], side, shape.tips_mm[half, k], rng)
            parts.append((placed, outward(placed, faces)))
            colors.append(crown_colors(local, form, k))
            tooth.append(np.full(len(local), side * (k + 1)))
    gum = _gum(forms, shape, line, np.concatenate([placed for placed, _ in parts]))
    parts.append(gum)
    colors.append(np.tile(np.array(GREY, dtype=np.uint8), (len(gum[0]), 1)))
    tooth.append(np.zeros(len(gum[0])))
    vertices, faces = merged(parts)
    if upper:
        vertices, faces = vertices * [1.0, -1.0, 1.0], faces[:, ::-1]
    mesh = Mesh(vertices, faces, np.concatenate(colors).astype(np.uint8))
    return DentalArch(mesh, np.concatenate(tooth).astype(np.int8))


def _centres(forms: tuple[CrownForm, ...]) -> Array:
    """Return the arc lengths of the tooth centres on one side."""
    widths = np.array([form.width_mm - CONTACT_OVERLAP_MM for form in forms])
    return np.cumsum(widths) - widths / 2


def _placed(
    local: Array, form: CrownForm, line: ArchLine, s: float, side: int, tip_mm: float, rng: np.random.Generator
) -> Array:
    """Return a crown's vertices transformed to its position in the arch, occlusal side up."""
    point, normal = line.at(np.array(s))
    distal = side * np.array([normal[1], 0.0, -normal[0]])
    facial = np.array([normal[0], 0.0, normal[1]])
    axes = np.stack([distal, [0.0, 1.0, 0.0], facial], 1)
    jitter = np.deg2rad(rng.uniform(-1.0, 1.0, 3) * [2.0, 4.0, 2.0])
    turn = so3_exp(np.array([np.deg2rad(form.torque_deg), 0.0, 0.0])) @ so3_exp(jitter)
    tip = np.array([0.0, form.height_mm, form.tip_z_mm])
    shift = rng.uniform(-0.12, 0.12, 2)
    position = np.array([point[0], tip_mm, point[1]]) + (CONTACT_MM + shift[0]) * facial + [0.0, shift[1], 0.0]
    return (local - tip) @ (axes @ turn).T + position


def crown_colors(local: Array, form: CrownForm, k: int) -> NDArray[np.uint8]:
    """Return vertex colours (V, 3): red, and green on the facial side of the tips of the six front teeth.

    `local` (V, 3) are vertices in the crown frame, k is the index of the tooth from 0 (first incisor) to 6 (second
    molar).
    """
    colors = np.tile(np.array(RED, dtype=np.uint8), (len(local), 1))
    if k < 3:
        middle = form.tip_z_mm
        boundary = (local[:, 1] > local[:, 1].max() - _BOUNDARY_MM - form.tip_mm / 2) & (local[:, 2] > middle - 0.1)
        colors[boundary] = GREEN
    return colors


def _gum(forms: tuple[CrownForm, ...], shape: ArchShape, line: ArchLine, crowns: Array) -> tuple[Array, Faces]:
    """Return a closed gum ridge with scalloped margins, slightly outside the crowns."""
    half = _centres(forms)[-1] + forms[-1].width_mm / 2 + 2.5
    s = np.linspace(-half, half, int(2 * half / COLUMN_MM))
    return gum_ridge(line, s, _margin(forms, shape, s), crowns)


def gum_ridge(line: ArchLine, s: Array, margin: Array, crowns: Array) -> tuple[Array, Faces]:
    """Return a closed gum ridge around crowns with vertices (V, 3).

    The cross-sections have evenly spaced arc lengths s (S,), and gum margins at heights (S,) [mm].
    """
    crown_s, crown_n = line.coordinates(crowns[:, [0, 2]])
    facial, lingual = _crown_extent(s, margin, crown_s, crown_n, crowns[:, 1])
    # Near the crest, the gum follows every crown; farther down, it follows only the arch.
    follow = np.clip(1.0 + _GUM_SIDE[:, 1] / 5.0, 0.0, 1.0)
    sides = []
    for extent, sign in ((facial, 1.0), (lingual, -1.0)):
        even = _averaged(extent, int(9.0 / COLUMN_MM))[:, None]
        offset = even + (extent[:, None] - even) * follow + sign * _GUM_SIDE[:, 0]
        even_margin = _averaged(margin, int(9.0 / COLUMN_MM))[:, None]
        level = even_margin + (margin[:, None] - even_margin) * follow + _GUM_SIDE[:, 1]
        sides.append(np.stack([offset, level], -1))
    profile = np.concatenate([sides[0], sides[1][:, ::-1]], 1)
    points, normal = line.at(s)
    xz = points[:, None] + profile[..., :1] * normal[:, None]
    rings = np.stack([xz[..., 0], profile[..., 1], xz[..., 1]], -1)
    return loft(rings)


def _margin(forms: tuple[CrownForm, ...], shape: ArchShape, s: Array) -> Array:
    """Return the height of the gum margin: the gum line at each tooth, with papillae in between."""
    height = np.array([form.height_mm for form in forms])
    centre = np.concatenate([side * _centres(forms) for side in (1, -1)])
    order = np.argsort(centre)
    centre = centre[order]
    line = (shape.tips_mm - height).ravel()[order]
    papilla = np.tile(np.where(np.arange(len(forms)) < 3, 0.38, 0.30) * height, 2)[order]
    half = np.tile([form.width_mm / 2 for form in forms], 2)[order]
    tooth = np.abs(s[:, None] - centre).argmin(1)
    smooth_line = np.interp(s, centre, line)
    across = np.minimum(np.abs(s - centre[tooth]) / half[tooth], 1.0)
    return smooth_line + np.interp(s, centre, papilla) * across**2.6


def _crown_extent(s: Array, margin: Array, crown_s: Array, crown_n: Array, crown_y: Array) -> tuple[Array, Array]:
    """Return the largest facial and lingual offsets of the crowns at the margin, for each cross-section of the gum."""
    facial, lingual = np.full(len(s), np.nan), np.full(len(s), np.nan)
    for i, (column, level) in enumerate(zip(s, margin, strict=True)):
        near = (np.abs(crown_s - column) < 0.8) & (np.abs(crown_y - level) < 1.2)
        if near.any():
            facial[i], lingual[i] = crown_n[near].max(), crown_n[near].min()
    known = np.isfinite(facial)
    facial, lingual = (np.interp(s, s[known], v[known]) for v in (facial, lingual))
    return _averaged(facial, 3), _averaged(lingual, 3)


def _averaged(values: Array, width: int) -> Array:
    """Smooth values along the arch with a Hann window and replicated edges."""
    width += 1 - width % 2
    kernel = np.hanning(width + 2)[1:-1]
    return np.convolve(np.pad(values, width // 2, mode="edge"), kernel / kernel.sum(), "valid")
