"""An estimated head for a subject without bone meshes: parametric bones, sized by the scans and the motion.

It shows roughly where bone may be, and is marked as estimated. The condyles are taken from the landmarks, or from the
motion if the landmarks are only mean adult positions. In opening and in protrusion the condyle slides along the same
path, so its trajectories form a thinner band than those of nearby points (the kinematic condylar centre; Kohno 1972,
Yatabe et al. 1995, J Dent Res 74:1321).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.formats.mesh import Mesh
from jawusd.geometry.anatomy import LANDMARKS, MEAN_CONDYLES
from jawusd.geometry.se3 import se3_inverse, transform_points
from jawusd.meshes.bones import JointShape, build_mandible, build_skull

_CONDYLES = [LANDMARKS.index(name) for name in ("condyle_left", "condyle_right")]

# Range and step [mm] of the search for the point with the thinnest band of trajectories, upward and forward from the
# mean adult position: the range of heights in 120 adults (21 to 47 mm; see `geometry.anatomy`) and a margin.
_REACH_MM = 18.0
_STEP_MM = 1.5
_PATH_DEGREE = 3
# Minimum travel of the condyles [mm], and maximum thickness of their band of trajectories as a fraction of the
# thickness at the mean position; outside these limits, the motion is not used.
_LEAST_TRAVEL_MM = 5.0
_CLEARLY_THINNER = 0.85
_FEWEST_POSES = 30

_FROM_MOTION, _FROM_MEANS = "estimated from the motion", "mean adult positions"
#: Mean error of a condyle centre [mm] by source, on 50 synthetic subjects; `tests/benchmarks/head.py` measures it.
CONDYLE_ERROR_MM = {_FROM_MOTION: 2.3, _FROM_MEANS: 8.6}

# Width between the first molars and length of the mean lower arch [mm], for which the parametric bones are sized, and
# the limits of their scale, which include almost all adults; scans of a few teeth would exceed them.
_MEAN_ARCH_MM = np.array([44.5, 46.0])
_ARCH_SCALE = (0.8, 1.25)
# Mean adult eminence: height, half width and start [mm], which give an inclination of 41 degrees (Cadiax studies).
_EMINENCE_MM = (10.5, 6.1, 5.0)


@dataclass(frozen=True)
class Estimate:
    """Which bones of a rig are estimated, and how well their condyles are known."""

    bones: tuple[str, ...]  # names of the estimated meshes
    condyles: str  # source of the condyle positions
    error_mm: float | None  # expected error of a condyle centre [mm]; None if it is not known


def with_estimated_bones(rig: JawRig, meshes: Mapping[str, Mesh]) -> tuple[dict[str, Mesh], Estimate | None]:
    """Return the meshes with an estimated mandible, and skull if neither is given; None if a mandible was given.

    The meshes [mm] are in the frames of `bake_rig`.
    """
    if "mandible" in meshes:
        return dict(meshes), None
    T_anatomical_mandible = rig.T_anatomical_skull @ rig.T_rest
    condyles, source = find_condyles(rig)
    points = transform_points(T_anatomical_mandible, np.concatenate([rig.landmarks[:3], condyles]))
    high, wide, start = (np.full(2, value) for value in _EMINENCE_MM)
    joint = JointShape(points[3:], points[0], high, wide, start)
    lower = transform_points(T_anatomical_mandible, meshes["lower_teeth"].vertices)
    size_mm = np.array([points[1, 0] - points[2, 0], points[0, 2] - np.percentile(lower[:, 2], 1.0)])
    width, length = np.clip(size_mm / _MEAN_ARCH_MM, *_ARCH_SCALE).tolist()
    found = {"mandible": _placed(build_mandible(joint, (width, length)), T_anatomical_mandible)}
    if "skull" not in meshes:
        found["skull"] = _placed(build_skull(joint, (width, length), whole=True), rig.T_anatomical_skull)
    return {**meshes, **found}, Estimate(tuple(found), source, CONDYLE_ERROR_MM.get(source))


def _placed(bone: Mesh, T_anatomical_frame: Array) -> Mesh:
    """Transform a bone from the anatomical frame to another frame, and remove its colours."""
    return replace(bone, vertices=transform_points(se3_inverse(T_anatomical_frame), bone.vertices), colors=None)


def find_condyles(rig: JawRig) -> tuple[Array, str]:
    """Return the centres of left and right condyle, mandible frame [mm], (2, 3), and their source.

    The motion determines their height and depth, the landmark their distance from the midline.
    """
    landmarks = rig.landmarks[_CONDYLES]
    inferred = [text for text in rig.inferred if text.startswith("condyle") and MEAN_CONDYLES in text]
    if not inferred:
        return landmarks, "landmarks of the model"
    otherwise = f"{_FROM_MEANS} from the tragions" if "tragions" in inferred[0] else _FROM_MEANS
    T_anatomical_mandible = rig.T_anatomical_skull @ rig.T_rest
    back = se3_inverse(T_anatomical_mandible)
    mean = transform_points(T_anatomical_mandible, landmarks)
    found = condyles_from_motion(rig.T_anatomical_skull @ rig.pose(rig.captured_d) @ back, mean)
    return (landmarks, otherwise) if found is None else (transform_points(back, found), _FROM_MOTION)


def condyles_from_motion(poses: Array, mean: Array) -> Array | None:
    """Return the centres near `mean` (2, 3) [mm] with the thinnest band of trajectories in poses (N, 4, 4), or None.

    Both are in the anatomical frame; the poses are the identity with the teeth closed.
    """
    poses = poses[:: max(1, len(poses) // 400)]
    if len(poses) < _FEWEST_POSES:
        return None
    found = [_thinnest(poses, place) for place in mean]
    return None if any(place is None for place in found) else np.array(found)


def _thinnest(poses: Array, mean: Array) -> Array | None:
    """Return the point near a mean position whose sagittal trajectories form the thinnest band; None if unclear."""
    offsets = np.arange(-_REACH_MM, _REACH_MM + 0.5 * _STEP_MM, _STEP_MM)
    grid = np.stack(np.meshgrid([0.0], offsets, offsets, indexing="ij"), axis=-1)[0] + mean
    thickness = _thickness(poses, grid.reshape(-1, 3)).reshape(grid.shape[:2])
    i, j = np.unravel_index(np.argmin(thickness), thickness.shape)
    inside = 0 < i < len(offsets) - 1 and 0 < j < len(offsets) - 1
    clear = thickness[i, j] < _CLEARLY_THINNER * _thickness(poses, mean[None])[0]
    return grid[i, j] if inside and clear else None


def _thickness(poses: Array, points: Array) -> Array:
    """Return the RMS distance [mm] of the sagittal trajectories of points (P, 3) from smooth paths, shape (P,)."""
    moved = np.einsum("nij,pj->ipn", poses[:, 1:3, :3], points) + poses[:, 1:3, 3].T[:, None]
    y, z = moved - moved.mean(axis=-1, keepdims=True)
    travel = np.ptp(z, axis=-1)
    s = z / np.maximum(travel, _LEAST_TRAVEL_MM)[:, None]
    powers = s[..., None] ** np.arange(_PATH_DEGREE + 1)
    back = np.swapaxes(powers, 1, 2)
    coefficients = np.linalg.solve(back @ powers, back @ y[..., None])[..., 0]
    path = np.einsum("pnk,pk->pn", powers, coefficients)
    slope = np.einsum("pnk,pk->pn", powers[..., :-1], coefficients[:, 1:] * np.arange(1, _PATH_DEGREE + 1))
    across = (y - path) ** 2 / (1 + (slope / np.maximum(travel, _LEAST_TRAVEL_MM)[:, None]) ** 2)
    return np.where(travel < _LEAST_TRAVEL_MM, np.inf, np.sqrt(across.mean(axis=-1)))
