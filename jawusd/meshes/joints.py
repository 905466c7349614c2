"""Condyles and fossae of a subject: mandible and skull around both jaw joints, as solids.

In a joint, cartilage and disc separate the bones but are not in the scans, and tracking and model errors are largest at
the condyles. Clearances of the joints are therefore reported, but never used to reject poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.geometry.anatomy import LANDMARKS
from jawusd.geometry.se3 import se3_inverse, transform_points
from jawusd.meshes.collision import FARTHEST_MM, Pair
from jawusd.meshes.contact import NoContact, wound_solid

#: Grid step of sampled joint clearances [mm].
STEP_MM = 0.8

_GRID_MM = 0.5  # step of the distance grid; clearances differ by at most 0.014 mm from those of a 0.25 mm grid
# Indices of the left and the right condyle.
_CONDYLES = [index for index, name in enumerate(LANDMARKS) if name.startswith("condyle")]
_CONDYLE_MM = 10.0  # radius around the condyle landmark that includes the condylar head but not the coronoid process
_REACH_MM = 26.0  # maximum translation of the condylar head, which may move past the articular eminence
_COARSEST_MM = 4.0  # maximum median edge length of a bone's triangles; a condyle is about 8 mm deep
_FEWEST_FACES = 30
# Maximum penetration of a condyle into the skull, and maximum distance from the skull, in the closed bite.
_DEEPEST_MM, _WIDEST_MM = 2.5, 8.0


@dataclass(frozen=True, eq=False)
class Joints:
    """Both jaw joints in the anatomical frame, the mandible in the closed bite."""

    pairs: tuple[Pair, Pair]  # skull and condyle as solids, for the left and the right joint
    # penetration depth of each condyle into the skull in the closed bite [mm], shape (2,); negative for gaps, down to
    # -`collision.FARTHEST_MM`
    closed: Array
    T_anatomical_skull: Array  # skull to anatomical coordinates, shape (4, 4)
    T_rest: Array  # T_skull_mandible of the closed bite, shape (4, 4)

    @property
    def closed_mm(self) -> float:
        """Penetration depth of the deeper condyle in the closed bite [mm]."""
        return float(self.closed.max())

    def clearances(self, T_skull_mandible: Array) -> Array:
        """Return the smaller clearance of the condyles [mm], (n,), in poses (n, 4, 4), relative to the closed bite."""
        A = self.T_anatomical_skull
        T = A @ T_skull_mandible @ se3_inverse(A @ self.T_rest)
        left, right = (max(closed, 0.0) - pair.depth(T) for pair, closed in zip(self.pairs, self.closed))
        return np.asarray(np.minimum(left, right))


def find_joints(skull: Mesh, mandible: Mesh, landmarks: Array, T_anatomical_skull: Array, T_rest: Array) -> Joints:
    """Return both jaw joints as solids, given both bones and `geometry.LANDMARKS` (5, 3) in their own frames [mm].

    Raises:
        NoContact: Bone is missing at the condyles or around them, a mesh is too coarse, or a condyle is too far from
            the skull or penetrates it too deeply.
    """
    closed_bite = T_anatomical_skull @ T_rest
    above = transform_points(T_anatomical_skull, skull.vertices)[skull.faces]
    below = transform_points(closed_bite, mandible.vertices)[mandible.faces]
    heads = transform_points(closed_bite, landmarks[_CONDYLES])
    left, right = (_joint(above, below, head) for head in heads)
    closed = np.array([float(pair.depth(np.eye(4)[None])[0]) for pair in (left, right)])
    for pair, depth in zip((left, right), closed):
        if depth <= -FARTHEST_MM:
            gap, _ = cKDTree(pair.upper.samples.points).query(pair.lower.samples.points)
            if gap.min() > _WIDEST_MM:
                raise NoContact(f"a condyle is {gap.min():.1f} mm from the skull; at most {_WIDEST_MM:g} mm is allowed")
    if closed.max() > _DEEPEST_MM:
        raise NoContact(
            f"in occlusion, a condyle penetrates the skull by {closed.max():.1f} mm; at most "
            f"{_DEEPEST_MM:g} mm is allowed"
        )
    return Joints((left, right), closed, T_anatomical_skull, T_rest)


def _joint(above: Array, below: Array, head: Array) -> Pair:
    condyle = np.array([head - _CONDYLE_MM, head + _CONDYLE_MM])
    fossa = np.array([head - _REACH_MM, head + _REACH_MM])
    _check_fine("mandible", below, condyle)
    _check_fine("skull", above, fossa)
    upper = wound_solid("skull", above, 1.0, fossa, _GRID_MM)
    return Pair(upper, wound_solid("mandible", below, -1.0, condyle, _GRID_MM))


def _check_fine(name: str, corners: Array, box: Array) -> None:
    """Raise NoContact if a bone is missing or too coarse in a box (2, 3) [mm]."""
    part = corners[((corners >= box[0]) & (corners <= box[1])).all(axis=2).any(axis=1)]
    if len(part) < _FEWEST_FACES:
        raise NoContact(f"the mesh of the {name} has no bone at the condyles")
    edge = float(np.median(np.linalg.norm(part - np.roll(part, 1, axis=1), axis=2)))
    if edge > _COARSEST_MM:
        raise NoContact(f"the mesh of the {name} is too coarse at the condyles: its edges measure {edge:.1f} mm")
