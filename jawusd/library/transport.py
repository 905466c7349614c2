"""Carry one person's jaw motion to another's bones, by the five landmarks both have.

How a jaw moves is decided by its joints and teeth, how far its landmarks travel also by its size. What is carried over
is therefore the displacement of each landmark, scaled sideways by the ratio of the distances between the condyles and
in the sagittal plane by that of the distances from the condyles to the incisal point; the pose is the rigid motion
nearest to the displaced landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.geometry import landmark_frame, rigid_fit, transform_points


@dataclass(frozen=True, eq=False)
class Donor:
    """One person of a library."""

    name: str  # of the person, for reports
    rig: JawRig  # the person's rig

    @property
    def landmarks(self) -> Array:
        """The landmarks with the teeth together, skull frame [mm], shape (5, 3), in the order of `LANDMARKS`."""
        return transform_points(self.rig.T_rest, self.rig.landmarks)


def condylar_distance_mm(landmarks: Array) -> float:
    """Return the distance [mm] between the condyle centres of landmarks (5, 3)."""
    return float(np.linalg.norm(landmarks[3] - landmarks[4]))


def condyle_incisor_mm(landmarks: Array) -> float:
    """Return the distance [mm] from the middle between the condyles to the incisal point of landmarks (5, 3)."""
    return float(np.linalg.norm(landmarks[0] - landmarks[3:5].mean(axis=0)))


def landmark_distance_mm(a: Array, b: Array) -> float:
    """Return the rms distance [mm] that the best rigid fit leaves between two persons' landmarks (5, 3) [mm]."""
    left = transform_points(rigid_fit(a, b), a) - b
    return float(np.sqrt((left**2).sum(axis=1).mean()))


def displacements(donor: Donor, target: Array, shares: Array) -> Array:
    """Return how the target's landmarks move when a donor's motion is carried over, target's frame [mm], (K, 5, 3).

    Args:
        target: the other person's landmarks with the teeth together [mm], shape (5, 3).
        shares: parameters as shares of the ranges, see `JawRig.normalized`, shape (K, 3).
    """
    rest = donor.landmarks
    d = donor.rig.denormalized(shares)
    moved = transform_points(donor.rig.pose(d), donor.rig.landmarks) - rest
    width = condylar_distance_mm(target) / condylar_distance_mm(rest)
    reach = condyle_incisor_mm(target) / condyle_incisor_mm(rest)
    axes = landmark_frame(target)[:3, :3]  # rows: left, up and anterior in the target's frame
    to_target = axes.T @ np.diag([width, reach, reach]) @ axes @ rigid_fit(rest, target)[:3, :3]
    return moved @ to_target.T
