"""Draw random mouths over the human range from a seed.

Ranges: overbite, overjet and crossbite after the NHANES III survey (Proffit, Fields and Moray 1998), tooth size
after Ash and Nelson with a coefficient of variation of 6 % between and 3 % within persons.
"""

from __future__ import annotations

import numpy as np

from jawusd.geometry import so3_exp
from jawusd.synthetic.dentition import ArchTraits, Gums, Traits

#: Intended vertical and horizontal distance of the incisal edges [mm]; the settled bite may end elsewhere.
OVERBITE_MM, OVERJET_MM = (-3.0, 8.0), (-3.0, 10.0)
_USUAL_SHARE = 0.4  # fraction of persons with a usual bite; the others cover the whole range
_BUCCAL_MM = 2.8  # distance of the lower buccal cusps inside the upper ones
_FRONT = (1, 2, 3)


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
