"""Bones and teeth that match the joint of a synthetic subject; at the identity pose, the teeth are in occlusion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.geometry import transform_points
from jawusd.meshes.bones import build_mandible, build_skull
from jawusd.synthetic.dental_arch import ArchShape, DentalArch, build_arch
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

    The subject's overbite and overjet determine the lower front teeth; the lower back teeth are raised until they touch
    the upper ones.
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
