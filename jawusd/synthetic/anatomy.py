"""The bones and teeth of a synthetic person, fitted to that person's joint, teeth in occlusion at identity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.formats.mesh import Mesh
from jawusd.geometry.arrays import Array
from jawusd.synthetic.bones import build_mandible, build_skull
from jawusd.synthetic.dental_arch import ArchShape, DentalArch, build_arch
from jawusd.synthetic.occlusion import Occlusion
from jawusd.synthetic.person import Person
from jawusd.synthetic.teeth import LOWER, UPPER

# Heights of edges and cusps over the plane of the upper central incisors [mm], first incisor to second molar.
_UPPER_TIPS_MM = -np.array([0.0, 0.5, 0.2, 0.3, 0.4, 0.6, 1.0])
# Heights of the lower front teeth over the lower central incisors [mm].
_LOWER_FRONT_MM = np.array([0.0, -0.2, -0.3])
_CONTACT_GAP_MM = 0.05
_OPENING_STEP = 0.002


@dataclass(frozen=True, eq=False)
class PersonAnatomy:
    """Teeth and bones in the scan frame (x left, y up, z anterior, origin at the upper incisal edge) [mm].

    Attributes:
        mandible: without teeth.
        skull: sockets of the joint, cheekbones, upper jaw bone.
        occlusion: contact of the two arches.
    """

    upper: DentalArch
    lower: DentalArch
    mandible: Mesh
    skull: Mesh
    occlusion: Occlusion


def build_anatomy(person: Person) -> PersonAnatomy:
    """Build the teeth and bones of a person.

    The lower front teeth are placed by the person's overbite and overjet; the lower back teeth are raised until they
    meet the upper ones.
    """
    rng = np.random.default_rng([person.seed, 0xA1A7])
    quadratic, quartic = rng.uniform(0.0160, 0.0180), rng.uniform(2.7e-5, 3.1e-5)
    cusp_slope = rng.uniform(0.32, 0.38)
    x, y, z = person.joint.incisor
    upper_shape = ArchShape(quadratic, quartic, 0.0, np.tile(_UPPER_TIPS_MM, (2, 1)), 0.0)
    upper = build_arch(UPPER, upper_shape, cusp_slope, True, person.seed)
    tips = np.tile(np.concatenate([y + _LOWER_FRONT_MM, np.full(4, y - 1.0)]), (2, 1))
    for _ in range(2):  # the second round corrects for the raised teeth
        lower = build_arch(LOWER, ArchShape(quadratic, quartic, -z, tips, x), cusp_slope, False, person.seed)
        gaps = Occlusion(upper, lower).gaps(np.eye(4))
        tips = tips + np.where(np.arange(7) >= 3, gaps - _CONTACT_GAP_MM, np.minimum(gaps - _CONTACT_GAP_MM, 0.0))
    lower = build_arch(LOWER, ArchShape(quadratic, quartic, -z, tips, x), cusp_slope, False, person.seed)
    return PersonAnatomy(upper, lower, build_mandible(person.joint), build_skull(person.joint), Occlusion(upper, lower))


def lifted_bite(person: Person, occlusion: Occlusion, controls: Array, extra_mm: Array) -> Array:
    """Return controls (F, 3) of a recording with the opening raised where the teeth would penetrate each other.

    Args:
        controls: opening, lateral, protrusion, shape (F, 3).
        extra_mm: movements outside the controls, shape (F, 3).
    """
    lifted = controls.copy()
    for i in range(len(lifted)):
        while lifted[i, 0] < 0.2 and occlusion.gap(person.pose_with_extra(lifted[i], extra_mm[i])) < 0.0:
            lifted[i, 0] += _OPENING_STEP
    return lifted
