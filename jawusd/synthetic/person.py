"""A synthetic subject: seeded joint parameters within human ranges, poses, and the set of possible poses.

Ranges: opening and excursions after Hirsch et al. 2006 and Travers et al. 2000, condylar inclination and Bennett angle
after Johnson and Winstanley 1997 and Cadiax studies, condylar travel after Muto and Kanazawa 1996.

A pose is possible if it lies on the subject's three-parameter manifold with controls inside their ranges. The nearest
possible pose is found by bounded Gauss-Newton steps from the best node of a coarse grid, on distances of mandible
points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import transform_point, transform_points
from jawusd.synthetic.kinematics import Joint, controlled_pose

PoseFunction = Callable[[Array, Array, Array], Array]

_LOWER = np.array([0.0, -1.0, -1.0])
_UPPER = np.array([1.0, 1.0, 1.0])
_GRID = (13, 9, 9)
# Number of Gauss-Newton steps; this many are needed near zero protrusion, where the manifold has a kink.
_STEPS = 30
_DIFFERENCE = 1e-5
# Damping relative to the scale of each control, since the controls' gradients differ by a factor of ten.
_DAMPING = 1e-3
_CHUNK = 2000
EnvelopeKind = Literal["box", "competing"]


class Envelope:
    """Set of possible controls of one subject, with projection onto this set."""

    def __init__(self, pose: PoseFunction, points: Array, exponent: float | None) -> None:
        """Prepare the grid of start values.

        Args:
            pose: maps opening, lateral and protrusion (...) to T_skull_mandible (..., 4, 4).
            points: mandible points [mm], shape (P, 3).
            exponent: None for independent ranges, p for |lateral|^p + max(protrusion, 0)^p <= 1.
        """
        self._pose = pose
        self._points = points
        self._exponent = exponent
        axes = [np.linspace(low, high, n) for low, high, n in zip(_LOWER, _UPPER, _GRID, strict=True)]
        self._grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        self._few = points[np.linspace(0, len(points) - 1, 6).astype(int)]
        self._grid_points = self._moved(self._grid, self._few)

    def limit(self, controls: Array) -> Array:
        """Return controls (..., 3) inside the ranges: clipped, then lateral and protrusion scaled down jointly."""
        controls = np.clip(controls, _LOWER, _UPPER)
        if self._exponent is None:
            return controls
        p = self._exponent
        size = (np.abs(controls[..., 1]) ** p + np.maximum(controls[..., 2], 0.0) ** p) ** (1.0 / p)
        shrink = 1.0 / np.maximum(size, 1.0)
        lateral, protrusion = controls[..., 1] * shrink, controls[..., 2]
        protrusion = np.where(protrusion > 0, protrusion * shrink, protrusion)
        return np.stack([controls[..., 0], lateral, protrusion], -1)

    def nearest(self, T: Array, bounded: bool) -> tuple[Array, Array]:
        """Return controls (..., 3) of the nearest pose on the manifold, and the largest point distance [mm] (...)."""
        flat = T.reshape(-1, 4, 4)
        parts = [self._nearest(flat[i : i + _CHUNK], bounded) for i in range(0, len(flat), _CHUNK)]
        if not parts:
            return np.zeros((*T.shape[:-2], 3)), np.zeros(T.shape[:-2])
        controls, distance = (np.concatenate(part) for part in zip(*parts, strict=True))
        return controls.reshape(*T.shape[:-2], 3), distance.reshape(T.shape[:-2])

    def _moved(self, controls: Array, points: Array) -> Array:
        """Return points (P, 3) transformed by the poses at controls (N, 3), shape (N, 3 P)."""
        T = self._pose(controls[:, 0], controls[:, 1], controls[:, 2])
        return transform_points(T, points).reshape(len(controls), -1)

    def _start(self, T: Array) -> Array:
        """Return the controls of the grid nodes nearest to poses (N, 4, 4), shape (N, 3)."""
        target = transform_points(T, self._few).reshape(len(T), -1)
        squares = (self._grid_points**2).sum(1) - 2 * target @ self._grid_points.T
        return self._grid[squares.argmin(1)]

    def _nearest(self, T: Array, bounded: bool) -> tuple[Array, Array]:
        target = transform_points(T, self._points).reshape(len(T), -1)
        controls = self._start(T)
        if bounded:
            controls = self.limit(controls)
        damping = np.full(len(T), _DAMPING)
        error = target - self._moved(controls, self._points)
        cost = (error**2).sum(1)
        for _ in range(_STEPS):
            step = self._step(controls, error, damping, bounded)
            trial = controls + step
            if bounded:
                trial = self.limit(trial)
            trial_error = target - self._moved(trial, self._points)
            trial_cost = (trial_error**2).sum(1)
            better = trial_cost < cost
            controls = np.where(better[:, None], trial, controls)
            error = np.where(better[:, None], trial_error, error)
            cost = np.where(better, trial_cost, cost)
            damping = np.where(better, damping * 0.2, damping * 10.0)
        distance = np.linalg.norm(error.reshape(len(T), -1, 3), axis=-1).max(-1)
        return controls, distance

    def _step(self, controls: Array, error: Array, damping: Array, bounded: bool) -> Array:
        """Take a damped Gauss-Newton step; controls at a bound with an outward gradient are fixed."""
        now = self._moved(controls, self._points)
        jacobian = np.stack(
            [(self._moved(controls + _DIFFERENCE * e, self._points) - now) / _DIFFERENCE for e in np.eye(3)], -1
        )
        gradient = np.einsum("nij,ni->nj", jacobian, error)
        normal = np.einsum("nij,nik->njk", jacobian, jacobian)
        diagonal = np.einsum("njj->nj", normal)
        free = np.ones_like(controls, dtype=bool)
        if bounded:
            held = ((controls <= _LOWER) & (gradient < 0)) | ((controls >= _UPPER) & (gradient > 0))
            free = ~held
        normal = normal * free[:, :, None] * free[:, None, :]
        index = np.arange(3)
        normal[:, index, index] = np.where(free, diagonal * (1.0 + damping[:, None]) + 1e-9, 1.0)
        return np.linalg.solve(normal, (gradient * free)[..., None])[..., 0]


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

    def __init__(self, seed: int, envelope: EnvelopeKind = "box") -> None:
        """Draw a subject.

        Args:
            envelope: "box": lateral and protrusive range are independent; "competing": a wide lateral movement reduces
                the protrusive range (|lateral|^1.3 + protrusion^1.3 <= 1).

        Raises:
            ValueError: the envelope is unknown.
        """
        if envelope not in ("box", "competing"):
            raise ValueError(f"envelope must be 'box' or 'competing', got {envelope!r}")
        rng = np.random.default_rng([seed, 0x7A77])
        self.seed = seed
        self.joint = draw_joint(rng)
        self.noise = Noise(0.12, float(np.deg2rad(0.08)), rng.uniform(0.10, 0.20), rng.uniform(0.065, 0.12))
        self.mandible_points = _mandible_points(self.joint)
        first_molars = self.joint.incisor + np.array([[22.0, 0.5, -26.0], [-22.0, 0.5, -26.0]])
        self.landmarks = np.concatenate([self.joint.incisor[None], first_molars, self.joint.condyles])
        self._envelope = Envelope(self.pose, self.mandible_points, exponent=1.3 if envelope == "competing" else None)

    def pose(self, opening: ArrayLike, lateral: ArrayLike, protrusion: ArrayLike) -> Array:
        """Return mandible poses (..., 4, 4) on the three-parameter manifold of the subject; see `controlled_pose`."""
        return controlled_pose(self.joint, opening, lateral, protrusion)

    def pose_with_extra(self, controls: ArrayLike, extra_mm: ArrayLike) -> Array:
        """Return mandible poses (..., 4, 4) that include movements outside the three controls; see `controlled_pose`.

        Args:
            controls: opening, lateral, protrusion, shape (..., 3).
            extra_mm: side shift, lift of the left and of the right condyle, shape (..., 3).
        """
        opening, lateral, protrusion = np.moveaxis(np.asarray(controls, dtype=np.float64), -1, 0)
        return controlled_pose(self.joint, opening, lateral, protrusion, extra_mm)

    def limit(self, controls: ArrayLike) -> Array:
        """Return controls (..., 3) limited to the envelope; controls inside it are unchanged."""
        return self._envelope.limit(np.asarray(controls, dtype=np.float64))

    def nearest(self, T_skull_mandible: ArrayLike, bounded: bool = True) -> tuple[Array, Array]:
        """Find the poses of the manifold nearest to given poses (..., 4, 4), by the rms distance of mandible points.

        Args:
            bounded: whether to stay within the envelope. If not, the distance is a lower limit on the error of any
                three-parameter fit.

        Returns:
            Controls (..., 3), and the largest distance of a mandible point [mm], shape (...).
        """
        return self._envelope.nearest(np.asarray(T_skull_mandible, dtype=np.float64), bounded)

    def is_valid(self, T_skull_mandible: ArrayLike, tolerance_mm: float = 1.0) -> Mask:
        """Return which poses (..., 4, 4) are possible: all mandible points within the tolerance of a possible pose.

        Movements outside the three controls alone displace points by up to 0.7 mm.
        """
        return self.nearest(T_skull_mandible)[1] <= tolerance_mm

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
