"""A synthetic subject: seeded joint parameters within human ranges, and poses.

Ranges: opening and excursions after Hirsch et al. 2006 and Travers et al. 2000, condylar inclination and Bennett angle
after Johnson and Winstanley 1997 and Cadiax studies, condylar travel after Muto and Kanazawa 1996.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.geometry import transform_point
from jawusd.synthetic.kinematics import Joint, controlled_pose

_LOWER = np.array([0.0, -1.0, -1.0])
_UPPER = np.array([1.0, 1.0, 1.0])


def _asymmetric(rng: np.random.Generator, value: float, relative: float) -> Array:
    """Draw random left and right values around a given value."""
    return value * (1.0 + relative * rng.uniform(-1.0, 1.0, 2))


def draw_joint(rng: np.random.Generator) -> Joint:
    """Draw a random joint for one subject."""
    u = rng.uniform
    half_distance, middle_x = u(47.0, 53.0), u(-0.7, 0.7)
    height, depth = u(41.0, 47.0), u(86.0, 92.0)
    skew = np.array([u(-0.8, 0.8), u(-1.2, 1.2)])
    condyles = np.array(
        [[side * half_distance + middle_x, height + side * skew[0], -depth + side * skew[1]] for side in (1, -1)]
    )
    slide_open = u(10.0, 13.0)
    return Joint(
        condyles=condyles,
        incisor=np.array([u(-0.4, 0.4), u(1.3, 1.9), -u(2.6, 3.2)]),
        eminence_height_mm=_asymmetric(rng, u(9.5, 11.5), 0.08),
        eminence_width_mm=_asymmetric(rng, u(5.6, 6.6), 0.06),
        eminence_start_mm=_asymmetric(rng, u(4.2, 5.8), 0.10),
        medial_slope=u(0.03, 0.10, 2),
        bennett_rad=np.deg2rad(u(7.0, 16.0, 2)),
        side_shift_mm=u(0.1, 0.6, 2),
        lateral_max_mm=_asymmetric(rng, u(6.4, 7.8), 0.09),
        lateral_shrink=u(0.70, 0.85),
        working_share=u(0.95, 0.98),
        rotation_max_rad=np.deg2rad(u(29.0, 34.0)),
        rotation_bend=u(-0.12, 0.12),
        slide_open_mm=slide_open,
        slide_limit_mm=slide_open + u(1.3, 2.5),
        slide_early=u(0.2, 0.8),
        slide_onset=u(0.05, 0.2),
        protrusion_max_mm=u(7.0, 9.0),
        retrusion_max_mm=u(0.7, 1.2),
        hinge_share=u(0.5, 0.75),
        deviation_mm=np.array([u(-0.45, 0.45), u(-0.5, 0.5)]),
        protrusive_guidance=np.array([u(0.75, 0.95), u(0.10, 0.18), u(2.0, 2.6)]),
        lateral_guidance=np.array([u(0.70, 0.90), u(0.08, 0.15), u(2.0, 2.6)]),
    )


@dataclass(frozen=True)
class Noise:
    """Standard deviations of tracking noise and of movements outside the three controls."""

    tracking_mm: float  # translation of the middle of the dental arch, per axis, independent between frames
    tracking_rad: float  # rotation, per axis, independent between frames
    side_mm: float  # side shift outside the three controls, smooth in time
    lift_mm: float  # lift of each condyle off its eminence, smooth in time


class Person:
    """One synthetic subject, with all parameters drawn from the seed.

    Attributes:
        landmarks: `jawusd.geometry.LANDMARKS` on the mandible, scan frame [mm], shape (5, 3).
        mandible_points: points all over the mandible, for measuring pose errors, scan frame [mm], shape (42, 3).
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 0x7A77])
        self.seed = seed
        self.joint = draw_joint(rng)
        self.noise = Noise(0.12, float(np.deg2rad(0.08)), rng.uniform(0.10, 0.20), rng.uniform(0.065, 0.12))
        self.mandible_points = _mandible_points(self.joint)
        first_molars = self.joint.incisor + np.array([[22.0, 0.5, -26.0], [-22.0, 0.5, -26.0]])
        self.landmarks = np.concatenate([self.joint.incisor[None], first_molars, self.joint.condyles])

    def pose(self, opening: ArrayLike, lateral: ArrayLike, protrusion: ArrayLike) -> Array:
        """Return mandible poses (..., 4, 4) on the three-parameter manifold of the subject; see `controlled_pose`."""
        return controlled_pose(self.joint, opening, lateral, protrusion)

    def pose_with_extra(self, controls: ArrayLike, extra_mm: ArrayLike) -> Array:
        """Return mandible poses (..., 4, 4) that include movements outside the three controls; see `controlled_pose`.

        `controls` (..., 3) are opening, lateral, protrusion; `extra_mm` (..., 3) side shift, lift of the left and right
        condyle.
        """
        opening, lateral, protrusion = np.moveaxis(np.asarray(controls, dtype=np.float64), -1, 0)
        return controlled_pose(self.joint, opening, lateral, protrusion, extra_mm)

    def limit(self, controls: ArrayLike) -> Array:
        """Return controls (..., 3) clipped to their ranges, which are independent of each other."""
        return np.asarray(np.clip(np.asarray(controls, dtype=np.float64), _LOWER, _UPPER))

    def incisor(self, T_skull_mandible: ArrayLike) -> Array:
        """Return the displacement of the lower incisal point from rest [mm], scan axes, shape (..., 3)."""
        return transform_point(T_skull_mandible, self.joint.incisor) - self.joint.incisor


def _mandible_points(joint: Joint) -> Array:
    """Return points on condyles, coronoids, rami, lower border, chin and teeth, scan frame [mm], shape (42, 3)."""
    x, y, z = joint.incisor
    points = []
    for side, centre in zip((1.0, -1.0), joint.condyles, strict=True):
        from_condyle = np.array(
            [
                [9, 0, 0], [-9, 0, 0], [0, 4, 0], [0, 0, -4], [0, 0, 5], [0, -18, -3],  # condylar head and neck
                [-3, 4, 26], [-2, -12, 20],  # points on coronoid process and notch
                [-4, -45, 0], [-2, -58, 10], [-6, -30, 14], [-14, -62, 35], [-22, -66, 60],  # ramus and lower border
            ]
        )  # fmt: skip
        points.append(centre + from_condyle * [side, 1, 1])
        from_incisor = np.array(
            [[22, -26, -7], [27, 6, -42], [24, 3, -28], [16, 1, -9], [6, 0, -1], [10, -32, -4], [9, -16, -2]]
        )
        points.append([x, y, z] + from_incisor * [side, 1, 1])
    points.append([[x, y, z], [x, y - 34, z - 6]])
    return np.concatenate(points).astype(np.float64)
