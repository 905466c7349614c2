"""Tooth crowns as watertight triangle meshes, built from tables of widths, profiles and cusps.

Crown frame: x distal, y towards the occlusal side (0 at the gum line), z facial, mm. Sizes are mean crown dimensions
from textbooks of dental anatomy (Ash and Nelson).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.meshes.surfaces import loft, superellipse

#: Height of the part of the crown that is hidden below the gum line [mm].
ROOT_MM = 2.5
_AROUND = 36
_SIDE_RINGS = 12
_TOP_RINGS = 5
_EDGE_ROUNDING_MM = 0.45
_CUSP_SHARPNESS_PER_MM = 4.0


@dataclass(frozen=True)
class CrownForm:
    """Shape of one kind of tooth."""

    width_mm: float  # mesio-distal crown width
    depth_mm: float  # facio-lingual crown depth
    height_mm: float  # height of the highest cusp, or of the incisal edge, above the gum line
    torque_deg: float  # tilt of the occlusal end towards the facial side
    # cusps of premolars and molars: x and z relative to half the width and half the depth, and distance below the
    # highest cusp [mm]; empty for incisors and canines
    cusps: tuple[tuple[float, float, float], ...] = ()
    tip_mm: float = 0.0  # height of a canine's tip above its shoulders; 0 for other teeth

    @property
    def tip_z_mm(self) -> float:
        """Return the facial offset of the edge or the buccal cusps from the crown's centre [mm]."""
        if self.cusps:
            return 0.5 * self.depth_mm * max(z for _, z, _ in self.cusps)
        return self.depth_mm * float(_bezier(_EDGE_MIDDLE, np.array(1.0)))


# Forms of the crowns, central incisor to second molar.
UPPER = (
    CrownForm(8.6, 7.0, 10.4, 7.0),
    CrownForm(6.7, 6.2, 9.2, 7.0),
    CrownForm(7.7, 8.0, 10.3, 1.0, tip_mm=1.7),
    CrownForm(7.1, 9.1, 8.5, -3.0, ((0.0, 0.50, 0.0), (0.0, -0.52, 0.5))),
    CrownForm(6.8, 9.1, 7.7, -3.0, ((0.0, 0.50, 0.0), (0.0, -0.52, 0.2))),
    CrownForm(10.2, 11.2, 7.4, -4.0, ((-0.46, 0.52, 0.0), (0.44, 0.50, 0.2), (-0.36, -0.50, 0.1), (0.48, -0.48, 0.7))),
    CrownForm(9.6, 11.0, 7.0, -4.0, ((-0.44, 0.52, 0.0), (0.44, 0.48, 0.3), (-0.30, -0.50, 0.1), (0.48, -0.46, 0.9))),
)
LOWER = (
    CrownForm(5.4, 5.8, 8.8, 3.0),
    CrownForm(5.9, 6.1, 9.2, 2.0),
    CrownForm(6.9, 7.6, 10.4, -2.0, tip_mm=1.5),
    CrownForm(7.0, 7.8, 8.6, -5.0, ((0.0, 0.42, 0.0), (0.0, -0.52, 1.3))),
    CrownForm(7.1, 8.3, 8.0, -7.0, ((0.0, 0.44, 0.0), (-0.25, -0.50, 0.4))),
    CrownForm(
        11.0, 10.4, 7.5, -8.0,
        ((-0.50, 0.48, 0.0), (0.10, 0.52, 0.1), (0.62, 0.34, 0.5), (-0.42, -0.50, 0.2), (0.42, -0.50, 0.3)),
    ),
    CrownForm(10.5, 10.2, 7.0, -8.0, ((-0.44, 0.50, 0.0), (0.44, 0.50, 0.2), (-0.42, -0.50, 0.2), (0.42, -0.50, 0.3))),
)  # fmt: skip

# Control values of Bezier profiles from the root end to the occlusal end. For incisors and canines: half width relative
# to half the crown's width; facial and lingual surface relative to the crown's depth.
_FRONT_WIDTH = (0.62, 0.68, 0.80, 1.02, 1.06, 0.95)
_FRONT_FACIAL = (0.38, 0.46, 0.58, 0.50, 0.42, 0.27)
_FRONT_LINGUAL = (-0.40, -0.52, -0.56, -0.10, 0.02, 0.11)
_EDGE_MIDDLE = tuple(0.5 * (f + g) for f, g in zip(_FRONT_FACIAL, _FRONT_LINGUAL, strict=True))
# For premolars and molars: half width relative to half the crown's width; facial and lingual surface relative to half
# the crown's depth.
_BACK_WIDTH = (0.74, 0.80, 0.92, 1.06, 1.04, 0.84)
_BACK_FACIAL = (0.72, 0.84, 1.06, 1.04, 0.90, 0.66)
_BACK_LINGUAL = (-0.72, -0.82, -0.98, -1.06, -0.98, -0.68)


def _bezier(control: tuple[float, ...], t: Array) -> Array:
    """Evaluate a scalar Bezier curve at t in 0..1, an array of any shape."""
    n = len(control) - 1
    return sum((c * comb(n, i) * t**i * (1.0 - t) ** (n - i) for i, c in enumerate(control)), np.zeros_like(t))


def _relative_width(control: tuple[float, ...], t: Array) -> Array:
    """Return the width profile scaled to a maximum of 1, so that tabulated widths are those at the contact points."""
    return _bezier(control, t) / _bezier(control, np.linspace(0.0, 1.0, 101)).max()


def crown(form: CrownForm, cusp_slope: float, rng: np.random.Generator) -> tuple[Array, NDArray[np.int32]]:
    """Build one crown with small random irregularities; `cusp_slope` [-] is the slope of the cusps of back teeth.

    Return vertices (V, 3) in the crown frame [mm] and outward counter-clockwise faces (F, 3) of a closed mesh.
    """
    angle = 2 * np.pi * (np.arange(_AROUND) + 0.5) / _AROUND
    rings = _back_rings(form, angle, cusp_slope) if form.cusps else _front_rings(form, angle, rng)
    return loft(rings)


def _front_rings(form: CrownForm, angle: Array, rng: np.random.Generator) -> Array:
    """Return the rings of an incisor or canine from root to edge, shape (R, A, 3)."""
    x, z = superellipse(angle, 0.78)
    low, high = -ROOT_MM, form.height_mm - _EDGE_ROUNDING_MM
    t = np.linspace(0.0, 1.0, _SIDE_RINGS + 1)
    half = 0.5 * form.width_mm * _relative_width(_FRONT_WIDTH, t)
    facial, lingual = form.depth_mm * _bezier(_FRONT_FACIAL, t), form.depth_mm * _bezier(_FRONT_LINGUAL, t)
    level = low + (high - low) * t
    # quarter circle that rounds the edge
    turn = np.linspace(0.0, np.pi / 2, 4)[1:]
    inset = _EDGE_ROUNDING_MM * (1.0 - np.cos(turn))
    half = np.concatenate([half, half[-1] - inset])
    middle = 0.5 * (facial + lingual)
    thick = 0.5 * (facial - lingual)
    middle = np.concatenate([middle, np.full(3, middle[-1])])
    thick = np.concatenate([thick, np.maximum(thick[-1] * np.cos(turn), 0.02)])
    level = np.concatenate([level, high + _EDGE_ROUNDING_MM * np.sin(turn)])
    X = half[:, None] * x
    Z = middle[:, None] + thick[:, None] * z
    share = np.clip(level / form.height_mm, 0.0, 1.0)[:, None]
    Y = level[:, None] - share**3 * _edge_drop(form, X, rng)
    return np.stack([X, np.broadcast_to(Y, X.shape), Z], -1)


def _edge_drop(form: CrownForm, X: Array, rng: np.random.Generator) -> Array:
    """Return the depth of the edge below its highest point [mm]: rounded corners, canine shoulders, tilt from wear."""
    relative = X / (0.5 * form.width_mm)
    tilt = 0.15 * rng.uniform(-1.0, 1.0) * relative
    if form.tip_mm:
        mesial_tip = relative + 0.1
        return form.tip_mm * (np.hypot(mesial_tip, 0.18) - 0.18) * 1.15 + tilt
    corner = np.clip((np.abs(relative) - 0.55) / 0.45, 0.0, 1.2) ** 2.2
    return corner * np.where(relative > 0, 0.95, 0.45) + tilt


def _back_rings(form: CrownForm, angle: Array, cusp_slope: float) -> Array:
    """Return the rings of a premolar or molar from root over the rim to the occlusal centre, shape (R, A, 3)."""
    x, z = superellipse(angle, 0.70)
    t = np.linspace(0.0, 1.0, _SIDE_RINGS + 1)
    half = 0.5 * form.width_mm * _relative_width(_BACK_WIDTH, t)
    facial, lingual = (0.5 * form.depth_mm * _bezier(c, t) for c in (_BACK_FACIAL, _BACK_LINGUAL))
    middle, thick = 0.5 * (facial + lingual), 0.5 * (facial - lingual)
    X, Z = half[:, None] * x, middle[:, None] + thick[:, None] * z
    rim = _occlusal(form, X[-1], Z[-1], cusp_slope)
    Y = -ROOT_MM + t[:, None] * (rim + ROOT_MM)
    shrink = np.linspace(1.0, 0.0, _TOP_RINGS + 2)[1:-1, None]
    top_x, top_z = shrink * X[-1], middle[-1] + shrink * (Z[-1] - middle[-1])
    top = np.stack([top_x, _occlusal(form, top_x, top_z, cusp_slope), top_z], -1)
    return np.concatenate([np.stack([X, Y, Z], -1), top])


def _occlusal(form: CrownForm, X: Array, Z: Array, slope: float) -> Array:
    """Return the height of the occlusal surface: a smooth maximum of rounded cones, with ridges and grooves."""
    k = _CUSP_SHARPNESS_PER_MM
    heights = []
    for x, z, lower in form.cusps:
        distance = np.hypot(X - 0.5 * form.width_mm * x, Z - 0.5 * form.depth_mm * z)
        heights.append(form.height_mm - lower - slope * (np.hypot(distance, 0.8) - 0.8))
    return np.logaddexp.reduce([k * h for h in heights], axis=0) / k
