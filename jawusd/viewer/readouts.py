"""What a pose of the jaw means in a clinic's numbers, and the paths that landmarks take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.evaluator import JawRig
from jawusd.geometry import LANDMARKS
from jawusd.geometry.arrays import Array
from jawusd.geometry.se3 import transform_points

INCISOR, CONDYLES = LANDMARKS.index("incisor"), (LANDMARKS.index("condyle_left"), LANDMARKS.index("condyle_right"))
# A margin this little below zero is rounding: `ranges` and `ik` end on the bound itself.
ON_BOUND_MM = 1e-6


@dataclass(frozen=True)
class Readout:
    """Hold what is shown of one pose.

    Attributes:
        opening_mm, lateral_mm, protrusion_mm: how far the incisal point went down, to the subject's left and forward.
        condyle_left_mm, condyle_right_mm: how far the condyle centres went left, up and forward.
        margin_mm: signed distance to the bound, > 0 inside.
        captured_mm: distance in d to the nearest captured pose; infinite without any.
        inside: the pose is valid.
    """

    opening_mm: float
    lateral_mm: float
    protrusion_mm: float
    condyle_left_mm: tuple[float, float, float]
    condyle_right_mm: tuple[float, float, float]
    margin_mm: float
    captured_mm: float
    inside: bool


def landmark_places(rig: JawRig, d: Array) -> Array:
    """Return where the landmarks are, anatomical frame [mm], shape (..., 5, 3), for d (..., 3) [mm]."""
    T = rig.arrays["T_anatomical_skull"] @ rig.pose(d)
    return transform_points(T, rig.arrays["landmarks"])


def rest_places(rig: JawRig) -> Array:
    """Return where the landmarks are in the closed bite, anatomical frame [mm], shape (5, 3)."""
    T = rig.arrays["T_anatomical_skull"] @ rig.arrays["T_rest"]
    return transform_points(T, rig.arrays["landmarks"])


def read_out(rig: JawRig, d: Array) -> Readout:
    """Measure the pose of parameters d (3,) [mm]."""
    moved = landmark_places(rig, d) - rest_places(rig)
    lateral, up, forward = moved[INCISOR].tolist()
    margin = float(rig.margin(d))
    left, right = (tuple(moved[index].tolist()) for index in CONDYLES)
    captured = float(rig.captured_distance(d))
    return Readout(-up, lateral, forward, left, right, margin, captured, margin >= -ON_BOUND_MM)


def habitual_path(rig: JawRig, samples: int = 60) -> Array:
    """Return the places of the landmarks along plain opening, anatomical frame [mm], shape (samples, 5, 3)."""
    opening = np.linspace(0.0, float(rig.arrays["d_range"][0, 1]), samples)
    return landmark_places(rig, np.stack([opening, np.zeros(samples), np.zeros(samples)], axis=1))


def border_path(rig: JawRig, axis: int, samples: int = 40) -> Array:
    """Return a ring of parameters [mm] on the bound in the plane of d1 and another one.

    Args:
        rig: the rig.
        axis: 1 for d2, 2 for d3; the third parameter is 0.
        samples: openings per side.

    Returns:
        Shape (n, 3), down one side and up the other.
    """
    # denser at both ends, where the bound closes
    low, high = rig.arrays["d_range"][0]
    opening = low + (high - low) * 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, samples)))
    ends = rig.ranges(opening)
    least, most = ends[2 * (axis - 1)], ends[2 * (axis - 1) + 1]
    known = np.isfinite(least) & np.isfinite(most)
    sides = np.zeros((2, int(known.sum()), 3))
    sides[..., 0] = opening[known]
    sides[0, :, axis], sides[1, :, axis] = least[known], most[known]
    return np.concatenate([sides[0], sides[1, ::-1]])
