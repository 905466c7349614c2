"""What the mandible's joint does for each ARKit shape: a CSV table, for rigs that add up deltas of joints.

    shape,weight,d1,d2,d3,tx,ty,tz,rx_deg,ry_deg,rz_deg,qw,qx,qy,qz,clamped_mm
    JawOpen,0.5,...

Translations [mm] and turns are relative to the neutral face, about the joint, in the axes of the skull frame (those of
`actor_skel.usdc`). Turns stand there twice: as angles about fixed x, then y, then z, and as a quaternion.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.atomic import write_text_atomic
from jawusd.geometry.quaternion import wxyz_from_matrix

_COLUMNS = "shape,weight,d1,d2,d3,tx,ty,tz,rx_deg,ry_deg,rz_deg,qw,qx,qy,qz,clamped_mm"


@dataclass(frozen=True, eq=False)
class JointDelta:
    """Hold what one shape does to the joint."""

    shape: str  # as ARKit names it
    weight: float  # 0 .. 1
    d: Array  # the pose [mm], shape (3,)
    translation_mm: Array  # of the joint, skull axes, shape (3,)
    rotation: Array  # skull axes, shape (3, 3)
    clamped_mm: float  # by which d was brought inside the bound


def save_joint_table(path: str | os.PathLike[str], rows: Iterable[JointDelta]) -> None:
    """Write a table atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = [_COLUMNS]
    for row in rows:
        sizes = [*row.d, *row.translation_mm, *np.rad2deg(fixed_angles(row.rotation))]
        places = [(size, 6) for size in sizes] + [(part, 9) for part in wxyz_from_matrix(row.rotation)]
        numbers = [f"{round(float(value), digits) + 0.0:.9g}" for value, digits in [*places, (row.clamped_mm, 6)]]
        lines.append(",".join([row.shape, f"{row.weight:g}", *numbers]))
    write_text_atomic(path, "\n".join(lines) + "\n")


def fixed_angles(R: Array) -> Array:
    """Return the angles [rad] about the fixed axes x, then y, then z, shape (3,), R = Rz Ry Rx (3, 3).

    J. J. Craig, "Introduction to Robotics", eq. 2.66, for turns about y of less than a quarter.
    """
    about_y = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    return np.array([np.arctan2(R[2, 1], R[2, 2]), about_y, np.arctan2(R[1, 0], R[0, 0])])
