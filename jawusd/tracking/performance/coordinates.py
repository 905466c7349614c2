"""The unknowns of a frame (head pose and jaw parameters), and derivatives of both arches with respect to them.

A frame has nine unknowns: a twist (omega [rad], v [mm]) of the head in its own axes about the pivot, which is the
centre of the upper crowns, and the jaw parameters d1, d2, d3 [mm].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.geometry import (
    make_transform,
    orthonormalise,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_log,
    transform_point,
)
from jawusd.tracking.contour.scan import Scan

HEAD, JAW, OPENING = slice(0, 6), slice(6, 9), 6
LOCAL = 9


@dataclass(frozen=True, eq=False)
class Pose:
    """Head pose and jaw parameters."""

    head: Array  # T_world_upper, shape (4, 4)
    d: Array  # jaw parameters [mm], shape (3,)
    # part of the mandible's pose that the rig cannot reproduce: a left twist in the skull frame [rad, mm], shape (6,)
    misfit: Array = field(default_factory=lambda: np.zeros(6))


class Slopes(NamedTuple):
    """Derivatives of left world twists of the arches about the centres of their crowns."""

    arches: tuple[Array, Array]  # of the upper and lower arch, with respect to the unknowns, shape (6, 9) each
    # of the lower arch, with respect to a left twist of the mandible's pose in the skull frame, such as the error of
    # `JawRig.pose_covariance`, shape (6, 6)
    error: Array


class Coordinates:
    """Conversion of head poses and jaw parameters to poses of both arches, with derivatives.

    Attributes:
        jaw: the subject's rig.
        pivot: point of the upper scan about which the head rotates [mm], shape (3,).
        closed_mm: smallest captured opening d1, at most that of the closed bite.
        rig_error: covariance (6, 6) of the rig's own error at a captured pose of medium opening, the prior of misfits.
            That at the pose itself grows outside the captured poses, where a misfit would replace a deviation of d.
    """

    def __init__(self, jaw: JawRig, scans: Sequence[Scan]) -> None:
        self.jaw, self.pivot, self._lower_centre = jaw, scans[0].centre, scans[1].centre
        self.closed_mm = min(0.0, float(jaw.captured_d[:, 0].min(initial=0.0)))
        captured = jaw.captured_d[np.argsort(jaw.captured_d[:, 0], kind="stable")]
        self.rig_error = jaw.pose_covariance(captured[len(captured) // 2] if len(captured) else np.zeros(3))
        self._to_pivot = make_transform(np.eye(3), -self.pivot)
        self._from_pivot = make_transform(np.eye(3), self.pivot)

    def arches(self, pose: Pose) -> Array:
        """Return T_world_upper and T_world_lower, shape (2, 4, 4)."""
        relative = self.jaw.pose(pose.d)
        if pose.misfit.any():
            relative = se3_exp(pose.misfit) @ relative
        return np.stack([pose.head, pose.head @ relative])

    def pose_of(self, arches: Array) -> Pose:
        """Return the rig pose nearest to the given poses of the two arches, shape (2, 4, 4)."""
        return Pose(arches[0].copy(), self.jaw.encode(se3_inverse(arches[0]) @ arches[1])[0])

    def with_jaw(self, pose: Pose, d: Array, arch: int) -> Pose:
        """Return a pose with other jaw parameters (3,) in which one arch, 0 or 1, stays in place."""
        moved = replace(pose, d=d)
        back = self.arches(pose)[arch] @ se3_inverse(self.arches(moved)[arch])
        return replace(moved, head=orthonormalise(back @ pose.head))

    def slopes(self, pose: Pose) -> Slopes:
        """Return the derivatives of both arches' twists with respect to the unknowns and to an error of the rig."""
        relative = self.jaw.pose(pose.d)
        turn = se3_adjoint(make_transform(pose.head[:3, :3], np.zeros(3)))
        upper, lower = np.zeros((6, LOCAL)), np.zeros((6, LOCAL))
        upper[:, HEAD] = turn
        centre = transform_point(relative, self._lower_centre)
        lower[:, HEAD] = turn @ se3_adjoint(make_transform(np.eye(3), self.pivot - centre))
        error = turn @ se3_adjoint(make_transform(np.eye(3), -centre))
        lower[:, JAW] = error @ self.jaw.spatial_jacobian(pose.d)
        return Slopes((upper, lower), error)

    def moved(self, pose: Pose, step: Array) -> Pose:
        """Return a pose after a step of the nine unknowns, shape (9,)."""
        return replace(pose, head=self.turned(pose.head, step[HEAD]), d=pose.d + step[JAW])

    def turned(self, head: Array, twist: Array) -> Array:
        """Return T_world_upper, shape (..., 4, 4), after twists in the head's axes about the pivot, shape (..., 6)."""
        return orthonormalise(head @ self._from_pivot @ se3_exp(twist) @ self._to_pivot)

    def head_steps(self, before: Array, after: Array) -> Array:
        """Return the twists (..., 6) between two head poses (..., 4, 4), about the pivot in the axes of `before`."""
        return se3_log(self._to_pivot @ se3_inverse(before) @ after @ self._from_pivot)

    def step(self, before: Pose, after: Pose) -> Array:
        """Return the step of the nine unknowns from one pose to another, shape (9,)."""
        return np.concatenate([self.head_steps(before.head, after.head), after.d - before.d])
