"""Traits of a mouth, and random mouths over the human range from a seed.

Ranges: overbite, overjet and crossbite after the NHANES III survey (Proffit, Fields and Moray 1998), tooth size
after Ash and Nelson with a coefficient of variation of 6 % between and 3 % within persons.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import so3_exp

Gums = Literal["dipping", "continuous", "crowns"]
BITES = ("normal", "deep", "open", "edge to edge", "underbite", "large overjet", "crossbite")
#: Intended vertical and horizontal distance of the incisal edges [mm]; the settled bite may end elsewhere.
OVERBITE_MM, OVERJET_MM = (-3.0, 8.0), (-3.0, 10.0)
_USUAL_SHARE = 0.4  # fraction of persons with a usual bite; the others cover the whole range
_BUCCAL_MM = 2.8  # distance of the lower buccal cusps inside the upper ones
_FRONT = (1, 2, 3)


@dataclass(frozen=True, eq=False)
class ArchTraits:
    """Individual traits of one arch; arrays run from first incisor to second molar, left then right, shape (2, 7)."""

    width_scale: Array  # tooth width relative to the mean
    height_scale: Array  # crown height relative to the mean: worn, short or long crowns
    shift_mm: Array  # facial offset from the arch line
    turn_rad: Array  # rotation about the tooth's axis
    rise_mm: Array  # height of edges and cusps over the occlusal curve
    overlap_mm: Array  # overlap with the mesial neighbour; negative for a gap
    present: Array  # 1, or 0 for a missing tooth
    brackets: bool  # on the facial faces of all teeth but the molars


@dataclass(frozen=True, eq=False)
class Traits:
    """Individual traits of a mouth; lengths mm, angles rad, frame x left, y up, z anterior."""

    seed: int
    overbite_mm: float  # intended height of the lower incisal edges over the upper ones
    overjet_mm: float  # intended distance of the lower incisal edges behind the upper ones
    buccal_mm: tuple[float, float]  # distance of the left and right lower back teeth inside the upper ones
    quadratic_per_mm: float
    quartic_per_mm3: float
    cusp_slope: float  # drop of the cusps per mm
    spee_mm: float  # depth of the occlusal curve
    midline_mm: float  # shift of the lower arch to the left
    skew: tuple[float, float]  # widening to the left, and forward shift of the left side, per mm
    tilt: Array  # rotation of the occlusal plane relative to the joint, shape (3, 3)
    upper: ArchTraits
    lower: ArchTraits
    gums: Gums

    @property
    def bite(self) -> str:
        """Return the intended kind of bite, one of `BITES`."""
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


def draw_traits(seed: int) -> Traits:
    """Draw the traits of one random person."""
    rng = np.random.default_rng([seed, 0xB17E])
    overbite, overjet = _incisors(rng)
    side = rng.random()
    buccal = np.full(2, _BUCCAL_MM) + rng.normal(0.0, 0.4, 2)
    if side < 0.18:  # on one side, or on both
        crossed = np.array([side < 0.12, not 0.06 < side < 0.12])
        buccal = np.where(crossed, rng.uniform(-2.6, 0.0, 2), buccal)
    size = np.clip(rng.normal(1.0, 0.06), 0.85, 1.15)
    worn = rng.random() < 0.2
    height = rng.uniform(0.62, 0.8) if worn else rng.uniform(0.85, 1.2)
    brackets = bool(rng.random() < 0.08)
    arches = [_arch(rng, size * scale, height, brackets) for scale in (1.0, rng.normal(1.0, 0.015))]
    tilt = rng.normal(0.0, 1.0, 3) * np.deg2rad([5.0, 2.0, 2.5])
    form = rng.uniform(0.85, 1.18) / size
    return Traits(
        seed=seed,
        overbite_mm=overbite,
        overjet_mm=overjet,
        buccal_mm=(float(buccal[0]), float(buccal[1])),
        quadratic_per_mm=0.0170 * form,
        quartic_per_mm3=2.9e-5 * rng.uniform(0.6, 1.4) / size**3,
        cusp_slope=rng.uniform(0.12, 0.25) if worn else rng.uniform(0.28, 0.42),
        spee_mm=rng.uniform(0.0, 1.8),
        midline_mm=rng.normal(0.0, 0.8),
        skew=(float(rng.normal(0.0, 0.025)), float(rng.normal(0.0, 0.03))),
        tilt=so3_exp(tilt),
        upper=arches[0],
        lower=arches[1],
        gums=_gums(rng, overjet),
    )


def _gums(rng: np.random.Generator, overjet_mm: float) -> Gums:
    kinds: tuple[Gums, ...] = ("dipping", "continuous", "crowns")
    # A ridge of constant cross-section does not follow arches with strongly receding front teeth.
    share = [0.42, 0.46, 0.12] if overjet_mm < 6.0 else [0.0, 0.8, 0.2]
    return kinds[int(rng.choice(3, p=share))]


def _incisors(rng: np.random.Generator) -> tuple[float, float]:
    """Draw overbite and overjet [mm]; the overbite is limited near edge-to-edge."""
    if rng.random() < _USUAL_SHARE:
        overbite, overjet = rng.normal(2.6, 1.0), rng.normal(2.8, 0.9)
    else:
        overbite, overjet = rng.uniform(*OVERBITE_MM), rng.uniform(*OVERJET_MM)
    if -1.2 < overjet < 1.2:
        overbite = min(overbite, 0.0)
    return float(np.clip(overbite, *OVERBITE_MM)), float(np.clip(overjet, *OVERJET_MM))


def _arch(rng: np.random.Generator, size: float, height: float, brackets: bool) -> ArchTraits:
    """Draw one arch: sizes, crowding or spacing, irregular positions, missing teeth."""
    shape = (2, 7)
    front = np.isin(np.arange(7) + 1, _FRONT)
    kind = rng.random()
    overlap, shift, turn = np.zeros(shape), rng.normal(0.0, 0.12, shape), rng.normal(0.0, np.deg2rad(2.5), shape)
    if kind < 0.3:  # crowded
        strength = rng.uniform(0.3, 1.0)
        overlap[:, front] = 0.8 * strength
        zigzag = np.where(np.arange(7) % 2 == 0, 1.0, -1.0) * rng.choice([-1.0, 1.0], (2, 1))
        shift = shift + np.where(front, 0.8 * strength * zigzag * rng.uniform(0.3, 1.0, shape), 0.0)
        turn = turn + np.where(front, np.deg2rad(14.0) * strength * rng.normal(0.0, 1.0, shape), 0.0)
    elif kind < 0.5:  # spaced
        overlap = -rng.uniform(0.0, 1.0) * rng.random(shape)
        overlap[:, 0] -= rng.uniform(0.0, 0.8) * (rng.random() < 0.4)
    present = np.ones(shape)
    if rng.random() < 0.35:
        likely = np.array([0.03, 0.05, 0.02, 0.08, 0.1, 0.18, 0.25])
        present = np.where(rng.random(shape) < likely, 0.0, 1.0)
    return ArchTraits(
        width_scale=np.clip(size * rng.normal(1.0, 0.03, shape), 0.8, 1.25),
        height_scale=np.clip(height * rng.normal(1.0, 0.04, shape), 0.58, 1.3),
        shift_mm=shift,
        turn_rad=turn,
        rise_mm=rng.normal(0.0, 0.2, shape),
        overlap_mm=overlap,
        present=present,
        brackets=brackets,
    )
