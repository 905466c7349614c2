"""Traits that distinguish one mouth from another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jawusd.base.arrays import Array

Gums = Literal["dipping", "continuous", "crowns"]
BITES = ("normal", "deep", "open", "edge to edge", "underbite", "large overjet", "crossbite")


@dataclass(frozen=True, eq=False)
class ArchTraits:
    """What is peculiar to one arch; arrays hold first incisor to second molar, left then right, shape (2, 7)."""

    width_scale: Array  # tooth widths over the mean ones
    height_scale: Array  # crown heights over the mean ones: worn, short or long crowns
    shift_mm: Array  # towards the facial side of where a tooth would stand in line
    turn_rad: Array  # about the tooth's axis
    rise_mm: Array  # of edges and cusps over the occlusal curve
    overlap_mm: Array  # of a tooth with its mesial neighbour; negative for a gap
    present: Array  # 1 or 0 for a missing tooth
    brackets: bool  # on the facial faces of all teeth but the molars


@dataclass(frozen=True, eq=False)
class Traits:
    """What distinguishes one mouth; lengths mm, angles rad, in a frame of x left, y up, z anterior."""

    seed: int
    overbite_mm: float  # wished height of the lower incisal edges over the upper ones
    overjet_mm: float  # wished distance of the lower incisal edges behind the upper ones
    buccal_mm: tuple[float, float]  # distance of the left and right lower back teeth inside the upper ones
    quadratic_per_mm: float
    quartic_per_mm3: float
    cusp_slope: float  # drop of the cusps per mm
    spee_mm: float  # depth of the occlusal curve
    midline_mm: float  # of the lower arch to the left
    skew: tuple[float, float]  # widening to the left, and forward lead of the left side, per mm
    tilt: Array  # turn of the occlusal plane against the joint, shape (3, 3)
    upper: ArchTraits
    lower: ArchTraits
    gums: Gums

    @property
    def bite(self) -> str:
        """Return the kind of bite that was wished for, one of `BITES`."""
        if min(self.buccal_mm) < 0.5:
            return "crossbite"
        if self.overjet_mm < -0.8:
            return "underbite"
        if self.overbite_mm < -0.5:
            return "open"
        if self.overjet_mm < 1.0 and self.overbite_mm < 1.0:
            return "edge to edge"
        if self.overjet_mm > 6.0:
            return "large overjet"
        return "deep" if self.overbite_mm > 4.5 else "normal"
