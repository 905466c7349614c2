"""Both arches of a person in occlusion: contact without deep penetration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.synthetic.anatomy import Occlusion
from jawusd.synthetic.dental_arch import ArchLine, ArchShape, DentalArch
from jawusd.synthetic.teeth import LOWER, UPPER
from subjects.dentition import PlacedTooth, build, placed_teeth
from subjects.traits import Traits

# Heights of the upper edges and cusps over the plane of the first incisors [mm].
_UPPER_TIPS_MM = -np.array([0.0, 0.5, 0.2, 0.3, 0.4, 0.6, 1.0])
# Blend from the overjet and height of the incisors (0) to those of the back teeth (1), first incisor to second molar.
_BACK_SHARE = np.array([0.0, 0.05, 0.2, 0.45, 0.7, 0.9, 1.0])
_FRONT_TEETH = 3
_GAP_MM = 0.03
_PREMOLARS_REACH_MM = 1.0  # largest eruption of premolars in an open bite
_MOLARS_REACH_MM = 4.0


@dataclass(frozen=True, eq=False)
class Bite:
    """Both arches in occlusion; x left, y up, z anterior, origin at the upper incisal edges [mm]."""

    upper: DentalArch
    lower: DentalArch
    occlusion: Occlusion
    overbite_mm: float  # actual overbite between the edges of the first incisors
    overjet_mm: float
    incisor: Array  # lower incisal point, shape (3,)


def build_bite(traits: Traits) -> Bite:
    """Build both arches of a person and bring the lower teeth into contact with the upper ones."""
    shape = ArchShape(traits.quadratic_per_mm, traits.quartic_per_mm3, 0.0, np.zeros((2, 7)), 0.0)
    curve = traits.spee_mm * np.sin(np.linspace(0.0, np.pi, 7))
    upper_seats = placed_teeth(
        UPPER, traits.upper, _UPPER_TIPS_MM + traits.upper.rise_mm - 0.5 * curve, np.zeros((2, 7)), 0.0
    )
    upper = build(upper_seats, ArchLine(shape), traits, traits.upper, True, traits.gums)
    base = float(np.clip(traits.overjet_mm, -2.0, 6.0))
    line = ArchLine(
        ArchShape(traits.quadratic_per_mm, traits.quartic_per_mm3, base, np.zeros((2, 7)), traits.midline_mm)
    )
    wished = traits.overjet_mm + (np.array(traits.buccal_mm)[:, None] - traits.overjet_mm) * _BACK_SHARE
    front = traits.overbite_mm + (1.5 - traits.overbite_mm) * np.array([0.0, 0.1, 0.5])
    tips = np.tile(np.concatenate([front, np.full(4, -1.5)]), (2, 1)) + traits.lower.rise_mm * (np.arange(7) > 0)

    def lower_arch() -> tuple[list[PlacedTooth], DentalArch]:
        placed = placed_teeth(LOWER, traits.lower, tips, base - wished, 0.0)
        return placed, build(placed, line, traits, traits.lower, False, traits.gums)

    for _ in range(3):  # raised teeth touch other parts of the upper ones
        _, lower = lower_arch()
        tips = tips + _moves(Occlusion(upper, lower).gaps(np.eye(4)), traits)
    placed, lower = lower_arch()
    occlusion = Occlusion(upper, lower)
    # The first contact stops the closing.
    gap = occlusion.gap(np.eye(4)) - _GAP_MM
    raised = lower.mesh.vertices + [0.0, gap, 0.0]
    lower = DentalArch(type(lower.mesh)(raised, lower.mesh.faces, lower.mesh.colors), lower.tooth)
    edges = [_incisal_edge(arch) for arch in (upper, lower)]
    return Bite(
        upper,
        lower,
        Occlusion(upper, lower),
        float(edges[1][1] - edges[0][1]),
        float(edges[0][2] - edges[1][2]),
        edges[1],
    )


def _moves(gaps: Array, traits: Traits) -> Array:
    """Return how far each lower tooth is raised into contact (+) or lowered out of a tooth (-), shape (2, 7) [mm]."""
    free = gaps - _GAP_MM
    reach = np.array([0.0] * _FRONT_TEETH + [_PREMOLARS_REACH_MM] * 2 + [_MOLARS_REACH_MM] * 2)
    if traits.overbite_mm > 0.5:
        reach[_FRONT_TEETH:] = _MOLARS_REACH_MM
    moves = np.where(np.isfinite(free), np.minimum(free, reach), 0.0)
    # The four incisors stay aligned.
    moves[:, :2] = moves[:, :2].min()
    # A tooth without an opposing tooth follows its neighbours.
    for half in (0, 1):
        met = np.isfinite(free[half]) & (np.arange(7) >= _FRONT_TEETH)
        if met.any():
            lone = ~np.isfinite(free[half]) & (np.arange(7) >= _FRONT_TEETH)
            moves[half, lone] = np.median(moves[half, met])
    return moves


def _incisal_edge(arch: DentalArch) -> Array:
    """Return the middle of the edges of the teeth nearest to the midline, shape (3,)."""
    up = 1.0 if arch.mesh.vertices[arch.tooth == 0, 1].mean() < arch.mesh.vertices[arch.tooth != 0, 1].mean() else -1.0
    edges = []
    for side in (1, -1):
        own = [k for k in range(1, 8) if (arch.tooth == side * k).any()]
        if own:
            points = arch.mesh.vertices[arch.tooth == side * own[0]]
            edges.append(points[up * points[:, 1] > (up * points[:, 1]).max() - 0.3].mean(0))
    return np.asarray(np.mean(edges, axis=0))
