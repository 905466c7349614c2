"""Clinical measures of a jaw pose, and paths of landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.geometry import LANDMARKS
from jawusd.geometry.se3 import transform_points

INCISOR, CONDYLES = LANDMARKS.index("incisor"), (LANDMARKS.index("condyle_left"), LANDMARKS.index("condyle_right"))

#: Number of captured poses that are shown near a pose, and their least distance from each other in d [mm].
GHOSTS, GHOSTS_APART_MM = 3, 1.0


@dataclass(frozen=True)
class Readout:
    """The displayed measures of one pose; displacements are to the subject's left, up and forward [mm]."""

    incisor_mm: tuple[float, float, float]
    condyle_left_mm: tuple[float, float, float]
    condyle_right_mm: tuple[float, float, float]
    margin_mm: float  # signed distance to the bound, > 0 inside
    captured_mm: float  # distance in d to the nearest captured pose; infinite if there are none
    inside: bool  # whether d lies inside the bound


def landmark_places(rig: JawRig, d: Array) -> Array:
    """Return the landmarks at parameters d (..., 3) [mm], in the anatomical frame [mm], shape (..., 5, 3)."""
    T = rig.T_anatomical_skull @ rig.pose(d)
    return transform_points(T, rig.landmarks)


def rest_places(rig: JawRig) -> Array:
    """Return the landmarks in occlusion, anatomical frame [mm], shape (5, 3)."""
    T = rig.T_anatomical_skull @ rig.T_rest
    return transform_points(T, rig.landmarks)


def measure_pose(rig: JawRig, d: Array) -> Readout:
    """Return the measures of the pose at parameters d (3,) [mm]."""
    moved = landmark_places(rig, d) - rest_places(rig)
    margin = float(rig.margin(d))
    incisor, left, right = (triple(moved[index]) for index in (INCISOR, *CONDYLES))
    captured = float(rig.captured_distance(d))
    return Readout(incisor, left, right, margin, captured, bool(rig.is_inside(d)))


def triple(values: Array) -> tuple[float, float, float]:
    """Return an array of three as a tuple of floats."""
    x, y, z = values.tolist()
    return x, y, z


def nearest_captured(rig: JawRig, d: Array) -> Array:
    """Return captured poses near d (3,), nearest first, shape (n, 3) [mm], with n <= `GHOSTS`."""
    captured = rig.captured_d
    found: list[Array] = []
    for row in captured[np.argsort(np.linalg.norm(captured - d, axis=1), kind="stable")]:
        if len(found) == GHOSTS:
            break
        if all(np.linalg.norm(row - other) >= GHOSTS_APART_MM for other in found):
            found.append(row)
    return np.array(found).reshape(-1, 3)


def habitual_path(rig: JawRig, samples: int = 60) -> Array:
    """Return the landmarks along pure opening (d2 = d3 = 0), anatomical frame [mm], shape (samples, 5, 3)."""
    opening = np.linspace(0.0, float(rig.d_range[0, 1]), samples)
    return landmark_places(rig, np.stack([opening, np.zeros(samples), np.zeros(samples)], axis=1))


def border_path(rig: JawRig, axis: int, samples: int = 40) -> Array:
    """Return the outline of the bound over d1 and d2 (axis 1) or d1 and d3 (axis 2), parameters (n, 3) [mm]."""
    # Samples are denser at both ends of the opening range, where the bound narrows.
    low, high = rig.d_range[0]
    opening = low + (high - low) * 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, samples)))
    ends = rig.ranges(opening)
    least, most = ends[2 * (axis - 1)], ends[2 * (axis - 1) + 1]
    known = np.isfinite(least) & np.isfinite(most)
    sides = np.zeros((2, int(known.sum()), 3))
    sides[..., 0] = opening[known]
    sides[0, :, axis], sides[1, :, axis] = least[known], most[known]
    return np.concatenate([sides[0], sides[1, ::-1]])
