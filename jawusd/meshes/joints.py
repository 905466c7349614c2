"""How the condyles of a person meet their fossae: bone of mandible and skull around both joints as solids.

Bones are not what touches in a joint: cartilage and disc lie between, which scans do not show, and condyles are where
errors of tracking and model are largest. So what is measured here is reported and refuses no pose.
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

#: Between sampled clearances.
STEP_MM = 0.8

_GRID_MM = 0.5  # between distances to bone: curved less than teeth; against 0.25, clearances differ by 0.014 at most
_CONDYLES = [index for index, name in enumerate(LANDMARKS) if name.startswith("condyle")]  # left, right
_CONDYLE_MM = 10.0  # around the condyle's landmark: its head, no coronoid process
_REACH_MM = 26.0  # so far the head slides, forward beyond the eminence
_COARSEST_MM = 4.0  # of edges: a condyle is some 8 mm deep
_FEWEST_FACES = 30
_DEEPEST_MM, _WIDEST_MM = 2.5, 8.0  # of the condyle in the skull, and from it, in the closed bite


@dataclass(frozen=True, eq=False)
class Joints:
    """Both joints in the anatomical frame, the mandible in the closed bite.

    Attributes:
        pairs: Skull and condyle as solids, left and right.
        closed: How deep each condyle runs into the skull in the closed bite [mm], shape (2,); negative if it does not,
            down to -`collision.FARTHEST_MM`.
        T_anatomical_skull: Skull to anatomical coordinates, shape (4, 4).
        T_rest: T_skull_mandible of the closed bite, shape (4, 4).
    """

    pairs: tuple[Pair, Pair]
    closed: Array
    T_anatomical_skull: Array
    T_rest: Array

    @property
    def closed_mm(self) -> float:
        """How deep the deeper condyle runs into the skull in the closed bite."""
        return float(self.closed.max())

    def clearances(self, T_skull_mandible: Array) -> Array:
        """Return what both condyles leave [mm], shape (n,), in poses (n, 4, 4).

        Below 0 where one runs into the skull, deeper than in the closed bite.
        """
        A = self.T_anatomical_skull
        T = A @ T_skull_mandible @ se3_inverse(A @ self.T_rest)
        left, right = (max(closed, 0.0) - pair.depth(T) for pair, closed in zip(self.pairs, self.closed))
        return np.asarray(np.minimum(left, right))


def find_joints(skull: Mesh, mandible: Mesh, landmarks: Array, T_anatomical_skull: Array, T_rest: Array) -> Joints:
    """Return both joints as solids.

    Args:
        skull: Skull frame [mm].
        mandible: Mandible frame [mm].
        landmarks: `geometry.LANDMARKS` in the mandible frame [mm], shape (5, 3).

    Raises:
        NoContact: There is no bone at the condyles or around them, it is too coarse, or both are one.
    """
    closed_bite = T_anatomical_skull @ T_rest
    above = transform_points(T_anatomical_skull, skull.vertices)[skull.faces]
    below = transform_points(closed_bite, mandible.vertices)[mandible.faces]
    heads = transform_points(closed_bite, landmarks[_CONDYLES])
    left, right = (_joint(above, below, head) for head in heads)
    closed = np.array([float(pair.depth(np.eye(4)[None])[0]) for pair in (left, right)])
    for pair, depth in zip((left, right), closed):
        _check_near(pair, depth)
    if closed.max() > _DEEPEST_MM:
        raise NoContact(
            f"in the closed bite a condyle runs {closed.max():.1f} mm into the skull (at most {_DEEPEST_MM:g} mm)"
        )
    return Joints((left, right), closed, T_anatomical_skull, T_rest)


def _joint(above: Array, below: Array, head: Array) -> Pair:
    condyle = np.array([head - _CONDYLE_MM, head + _CONDYLE_MM])
    fossa = np.array([head - _REACH_MM, head + _REACH_MM])
    _check_fine("mandible", below, condyle)
    _check_fine("skull", above, fossa)
    upper = wound_solid("skull", above, 1.0, fossa, _GRID_MM)
    return Pair(upper, wound_solid("mandible", below, -1.0, condyle, _GRID_MM))


def _check_near(pair: Pair, depth_mm: float) -> None:
    """Raise NoContact where a condyle, so deep in the skull, is far from it."""
    if depth_mm > -FARTHEST_MM:
        return
    gap, _ = cKDTree(pair.upper.samples.points).query(pair.lower.samples.points)
    if gap.min() > _WIDEST_MM:
        raise NoContact(f"a condyle is {gap.min():.1f} mm from the skull (at most {_WIDEST_MM:g} mm is a joint)")


def _check_fine(name: str, corners: Array, box: Array) -> None:
    """Raise NoContact where a bone is missing or coarse in a box (2, 3) [mm]."""
    part = corners[((corners >= box[0]) & (corners <= box[1])).all(axis=2).any(axis=1)]
    if len(part) < _FEWEST_FACES:
        raise NoContact(f"the {name} has no bone at the condyles")
    edge = float(np.median(np.linalg.norm(part - np.roll(part, 1, axis=1), axis=2)))
    if edge > _COARSEST_MM:
        raise NoContact(f"the {name} is coarse at the condyles: edges of {edge:.1f} mm")
