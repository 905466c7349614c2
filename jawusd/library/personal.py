"""Motion for a subject without a capture: the motion of the library's subjects, transferred and averaged.

The displacement of each of the five landmarks is scaled laterally by the ratio of the two subjects' intercondylar
distances, and in the sagittal plane by that of their distances between condyles and incisal point. The bandwidth of the
weights, which decrease with the distance between landmarks, and the expected error come from leave-one-out validation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import FittingError
from jawusd.evaluator import JawRig
from jawusd.formats.model import error_table
from jawusd.formats.notes import ErrorTable
from jawusd.geometry import LANDMARKS, landmark_frame, rigid_fit, transform_points


@dataclass(frozen=True, eq=False)
class Donor:
    """One subject of a library."""

    name: str  # name of the subject, for reports
    rig: JawRig  # rig of the subject

    @property
    def landmarks(self) -> Array:
        """Landmarks with the teeth together, skull frame [mm], shape (5, 3), in the order of `LANDMARKS`."""
        return transform_points(self.rig.T_rest, self.rig.landmarks)


def condylar_distance_mm(landmarks: Array) -> float:
    """Return the distance [mm] between the condyle centres of landmarks (5, 3)."""
    return float(np.linalg.norm(landmarks[3] - landmarks[4]))


def condyle_incisor_mm(landmarks: Array) -> float:
    """Return the distance [mm] from the midpoint of the condyles to the incisal point of landmarks (5, 3)."""
    return float(np.linalg.norm(landmarks[0] - landmarks[3:5].mean(axis=0)))


def landmark_distance_mm(a: Array, b: Array) -> float:
    """Return the rms distance [mm] between two subjects' landmarks (5, 3) [mm] after rigid alignment."""
    left = transform_points(rigid_fit(a, b), a) - b
    return float(np.sqrt((left**2).sum(axis=1).mean()))


def displacements(donor: Donor, target: Array, shares: Array) -> Array:
    """Return a donor's motion as displacements of the target's landmarks, in the target's frame [mm], shape (K, 5, 3).

    Args:
        target: Landmarks of the target subject with the teeth together [mm], shape (5, 3).
        shares: Jaw parameters as fractions of their ranges (see `JawRig.normalized`), shape (K, 3).
    """
    rest = donor.landmarks
    d = donor.rig.denormalized(shares)
    moved = transform_points(donor.rig.pose(d), donor.rig.landmarks) - rest
    width = condylar_distance_mm(target) / condylar_distance_mm(rest)
    reach = condyle_incisor_mm(target) / condyle_incisor_mm(rest)
    axes = landmark_frame(target)[:3, :3]  # rows of the matrix: left, up and anterior in the target's frame
    to_target = axes.T @ np.diag([width, reach, reach]) @ axes @ rigid_fit(rest, target)[:3, :3]
    return moved @ to_target.T


# Candidate bandwidths [mm]: landmark distance at which a weight decreases to exp(-1/2); inf means equal weights.
BANDWIDTHS_MM = (math.inf, 4.0, 2.0, 1.0)
_POSES = 1600  # number of poses to predict
_POSES_LEFT_OUT = 120  # number of poses per subject in leave-one-out validation
_MIN_DONORS = 2  # minimum number of subjects for leave-one-out validation


@dataclass(frozen=True, eq=False)
class Learned:
    """Result of leave-one-out validation over a library."""

    # landmark distance at which a weight decreases to exp(-1/2); inf for equal weights; None if only the closest
    # subject is used
    bandwidth_mm: float | None
    # landmark errors [mm], shape (K, 5), by name of the held-out subject, empty if the library has a single subject;
    # predicted and true poses are compared at equal fractions of the ranges, so that errors of the ranges are included
    errors_mm: dict[str, Array]

    def pooled(self) -> Array:
        """Return the errors of all subjects [mm], shape (N, 5)."""
        return np.concatenate(list(self.errors_mm.values()))

    def summary(self) -> dict[str, object]:
        """Return mean, 95 % quantile and maximum of the errors over landmarks [mm], and the mean of each subject."""
        errors = self.pooled()
        return {
            "measured": "leave-one-out over the library, at the landmarks, at equal shares of the ranges",
            "mean": float(errors.mean()),
            "p95": float(np.percentile(errors, 95)),
            "max": float(errors.max()),
            "mean_by_person": {name: float(values.mean()) for name, values in self.errors_mm.items()},
        }

    def table(self) -> ErrorTable:
        """Return mean, median, p95 and max of the errors per landmark [mm], in the form of a model's error tables."""
        return error_table(dict(zip(LANDMARKS, self.pooled().T, strict=True)))


@dataclass(frozen=True, eq=False)
class PersonalMotion:
    """Motion predicted for a subject."""

    # T_skull_mandible in the landmark frame, the identity with the teeth together, shape (N, 4, 4)
    poses: Array
    weights: dict[str, float]  # weights of the library's subjects by name; their sum is 1
    learned: Learned  # bandwidth of the weights, and expected error


def leave_one_out(donors: Sequence[Donor], *, closest: bool = False) -> Learned:
    """Predict every subject of a library from the other subjects, and choose the bandwidth of the weights.

    With `closest`, only the subject with the most similar landmarks is used, instead of an average. Raises FittingError
    without any subject.
    """
    if not donors:
        raise FittingError("the library has no subject whose motion can be transferred.")
    if len(donors) < _MIN_DONORS:
        return Learned(None, {})
    choices = [Learned(bandwidth, {}) for bandwidth in ((None,) if closest else BANDWIDTHS_MM)]
    for i, left_out in enumerate(donors):
        others = [*donors[:i], *donors[i + 1 :]]
        shares, rest = _captured_shares(left_out, _POSES_LEFT_OUT), left_out.landmarks
        own = left_out.rig.landmarks
        truth = transform_points(left_out.rig.pose(left_out.rig.denormalized(shares)), own)
        moved = np.stack([displacements(donor, rest, shares) for donor in others])
        for choice in choices:
            average = np.einsum("j,jkpi->kpi", _weights(others, rest, choice.bandwidth_mm), moved)
            predicted = transform_points(rigid_fit(rest, rest + average), rest)
            choice.errors_mm[left_out.name] = np.linalg.norm(predicted - truth, axis=-1)
    return min(choices, key=lambda choice: float(choice.pooled().mean()))


def personal_motion(donors: Sequence[Donor], target: Array, learned: Learned) -> PersonalMotion:
    """Predict the motion of a subject from its `LANDMARKS` (5, 3) [mm] with the teeth together, and a library."""
    weights = _weights(donors, target, learned.bandwidth_mm)
    used = [(donor, weight) for donor, weight in zip(donors, weights, strict=True) if weight > 0]
    shares = np.concatenate([_captured_shares(donor, _POSES // len(used)) for donor, _ in used])
    moved = sum(weight * displacements(donor, target, shares) for donor, weight in used)
    return PersonalMotion(
        rigid_fit(target, target + moved), {donor.name: float(weight) for donor, weight in used}, learned
    )


def _captured_shares(donor: Donor, count: int) -> Array:
    """Return about `count` of a subject's captured poses in temporal order, as fractions of the ranges."""
    codes = donor.rig.captured_d
    step = -(-len(codes) // max(count, 1))
    return donor.rig.normalized(codes[::step])


def _weights(donors: Sequence[Donor], target: Array, bandwidth_mm: float | None) -> Array:
    """Return the weights (n,) of the donors, which sum to 1; without a bandwidth, only the closest donor has weight."""
    distance = np.array([landmark_distance_mm(donor.landmarks, target) for donor in donors])
    if bandwidth_mm is None:
        return (np.arange(len(donors)) == distance.argmin()).astype(np.float64)
    nearness = -0.5 * (distance / bandwidth_mm) ** 2
    weights = np.exp(nearness - nearness.max())
    return weights / weights.sum()
