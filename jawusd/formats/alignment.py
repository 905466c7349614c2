"""Face models: corresponding points with a rig, and the alignment computed from them (both JSON); and jaw motion.

Correspondences, format jawusd-correspondences/1, are written by hand:

    {"format": "jawusd-correspondences/1", "unit_mm": 1000, "scale": false,
     "points": {"incisor": {"model": [x, y, z], "sigma_mm": 1},
                "molar_left": {"model": [x, y, z], "sigma_mm": 1.5},
                "chin": {"model": [x, y, z], "rig": [x, y, z], "sigma_mm": 3}},
     "joint": [x, y, z]}

`model` is a point of the face model with the teeth in occlusion, in its own frame and unit; `unit_mm` is the length of
this unit. `rig` is the same point in the skull frame of the rig [mm]; it may be omitted for the names `incisor`,
`molar_left`, `molar_right`, `condyle_left`, `condyle_right` (on the mandible) and `upper_incisor`, which the rig
provides. `sigma_mm` is the standard deviation of the difference between both, per axis. `scale` is true for a model
without a true size, and `unit_mm` is then estimated. `joint` is the jaw joint of the model, for its jaw rotations; it
may be omitted.

The alignment, format jawusd-alignment/1, is written by `jawusd align`.

Jaw motion in the model's own frame, as the model's solver writes it, is an npz file (numpy, without pickles) with one
row per frame:

    jaw_pose         (F, 3)     rotation vectors about the jaw joint [rad] (FLAME, SMPL-X), or (F, 1, 3)
    jaw_translation  (F, 3)     translations of the jaw [model units]; optional
    joint            (3,)       jaw joint [model units]; optional if the alignment states it
    T_model_jaw      (F, 4, 4)  instead of these: motions of the jaw, translations in model units
    frames           (F,)       frame numbers; optional, default 0, 1, 2, ...

The identity is the closed mouth with the teeth in occlusion. Other arrays are ignored. A CSV or JSON table of matrices
(see `jawusd.formats.poses`) is read as `T_model_jaw`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError
from jawusd.base.npz import read_arrays, take
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.poses import read_poses
from jawusd.formats.text import Strict, read_model
from jawusd.geometry import hat, make_transform, rigidity_defect, se3_inverse, so3_exp, transform_points

_MAX_BYTES = 1 << 20
_RIGID_TOLERANCE = 1e-6
_Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e7, le=1e7)]
_Positive = Annotated[float, Field(allow_inf_nan=False, gt=0, le=1e7)]
_Point = tuple[_Number, _Number, _Number]
_Row = tuple[_Number, _Number, _Number, _Number]
_Spread = tuple[_Number, _Number, _Number, _Number, _Number, _Number, _Number]


class Correspondence(Strict):
    """One point on a face model and on the rig."""

    model: _Point = Field(description="three numbers [model units]")
    rig: _Point | None = Field(None, description="three numbers [mm]")
    sigma_mm: _Positive = Field(description="a number above 0 [mm]")


class Correspondences(Strict):
    """Content of a file of corresponding points."""

    format: Literal["jawusd-correspondences/1"] = Field(
        "jawusd-correspondences/1", description='"jawusd-correspondences/1"'
    )
    unit_mm: _Positive = Field(description="a number above 0 [mm]")
    scale: bool = Field(False, description="true or false")
    points: dict[str, Correspondence] = Field(description="a JSON object of points by name")
    joint: _Point | None = Field(None, description="three numbers [model units]")


class Alignment(Strict):
    """The alignment of a face model with a rig, with its expected error."""

    format: Literal["jawusd-alignment/1"] = Field("jawusd-alignment/1", description='"jawusd-alignment/1"')
    actor: str = Field(description="the actor's name")
    unit_mm: _Positive = Field(description="a number above 0 [mm]")  # length of a model unit, given or estimated
    #: Rigid transform from model coordinates times `unit_mm` to the skull frame [mm].
    T_skull_model: tuple[_Row, _Row, _Row, _Row] = Field(description="four rows of four numbers")
    #: Covariance of the error xi = (omega [rad], v [mm], log scale), a left perturbation in the skull frame.
    covariance: tuple[_Spread, _Spread, _Spread, _Spread, _Spread, _Spread, _Spread] = Field(
        description="seven rows of seven numbers"
    )
    off_mm: dict[str, _Number] = Field(description="a number per point [mm]")  # distance of each point after the fit
    teeth_mm: _Number = Field(description="a number [mm]")  # expected error at the lower teeth, rms
    condyles_mm: _Number = Field(description="a number [mm]")  # expected error at the condyles, rms
    joint: _Point | None = Field(None, description="three numbers [model units]")

    @property
    def matrix(self) -> Array:
        """`T_skull_model` as an array, shape (4, 4)."""
        return np.array(self.T_skull_model)

    def to_skull(self, points: Array) -> Array:
        """Return points of the model (..., 3) [model units] in the skull frame [mm]."""
        return transform_points(self.matrix, self.unit_mm * np.asarray(points, dtype=np.float64))

    def error_mm(self, points: Array) -> Array:
        """Return the expected error (N,) [mm] (rms distance) at points (N, 3) [mm], skull frame."""
        J = motion_of_points(points)
        squared: Array = np.einsum("nij,jk,nik->n", J, np.array(self.covariance), J)
        return np.sqrt(squared)

    def jaw_poses(self, T_model_jaw: Array, T_rest: Array) -> Array:
        """Return T_skull_mandible (F, 4, 4) [mm] of motions of the model's jaw; T_rest (4, 4) is the closed bite.

        With S = `T_skull_model`, ``T_skull_mandible = S T_model_jaw S^-1 T_rest``.
        """
        motion = T_model_jaw.copy()
        motion[:, :3, 3] *= self.unit_mm
        poses: Array = self.matrix @ motion @ se3_inverse(self.matrix) @ T_rest
        return poses


def motion_of_points(points: Array) -> Array:
    """Return J (..., 3, 7) [mm] of points (..., 3): their motion under a small (omega [rad], v [mm], log scale)."""
    p = np.asarray(points, dtype=np.float64)
    unit = np.broadcast_to(np.eye(3), (*p.shape, 3))
    return np.concatenate([-hat(p), unit, p[..., None]], axis=-1)


def load_correspondences(path: AnyPath) -> Correspondences:
    """Read corresponding points.

    Raises:
        FormatError: the file is not one of corresponding points; the message names the wrong entry.
    """
    hint = "The format is described in the reference of files, and by an example in the guide to face solvers."
    return read_model(path, _MAX_BYTES, Correspondences, hint)


def load_alignment(path: AnyPath) -> Alignment:
    """Read an alignment.

    Raises:
        FormatError: the file is not an alignment; the message names the wrong entry.
    """
    found = read_model(path, _MAX_BYTES, Alignment, "Such a file is written by `jawusd align`.")
    if rigidity_defect(found.matrix) > _RIGID_TOLERANCE:
        raise FormatError('"T_skull_model" must be a rigid 4 x 4 matrix.', path=path)
    return found


def save_alignment(path: AnyPath, alignment: Alignment) -> None:
    """Write an alignment atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    write_text_atomic(path, json.dumps(alignment.model_dump(mode="json"), indent=1) + "\n")


_JOINT_HINT = 'Store it as "joint" in the npz file, or state it in the correspondences of `jawusd align`.'


def read_jaw_track(path: AnyPath, joint: tuple[float, float, float] | None) -> tuple[Array, Array]:
    """Read frame numbers (F,) and T_model_jaw (F, 4, 4) of a face model, translations in model units.

    `joint` [model units] is used if the file does not contain it.

    Raises:
        FormatError: the file has no jaw motion, an array has a wrong shape, or there is no joint.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        numbers, T = read_poses(path)
        return numbers.astype(np.float64), T
    arrays = read_arrays(path)
    if "T_model_jaw" in arrays:
        T = take(arrays, "T_model_jaw", (None, 4, 4), path).astype(np.float64)
    elif "jaw_pose" in arrays:
        T = _turned(arrays, joint, path)
    else:
        raise FormatError('has neither "jaw_pose" nor "T_model_jaw".', path=path)
    count = np.arange(len(T), dtype=np.float64)
    frames = take(arrays, "frames", (len(T),), path).astype(np.float64) if "frames" in arrays else count
    return frames, T


def _turned(arrays: dict[str, Array], joint: tuple[float, float, float] | None, path: Path) -> Array:
    if arrays["jaw_pose"].ndim == 3:
        arrays = {**arrays, "jaw_pose": arrays["jaw_pose"][:, 0]}
    R = so3_exp(take(arrays, "jaw_pose", (None, 3), path).astype(np.float64))
    if "joint" not in arrays and joint is None:
        raise FormatError('has "jaw_pose" but no "joint".', path=path, hint=_JOINT_HINT)
    j = take(arrays, "joint", (3,), path).astype(np.float64) if "joint" in arrays else np.array(joint)
    shift = take(arrays, "jaw_translation", (len(R), 3), path) if "jaw_translation" in arrays else np.zeros(3)
    return make_transform(R, j - R @ j + shift)
