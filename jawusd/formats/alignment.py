"""Corresponding points of a face model and a rig, and the alignment computed from them; both JSON.

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
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.text import parse_model, read_text
from jawusd.geometry import hat, rigidity_defect, transform_points

_MAX_BYTES = 1 << 20
_RIGID_TOLERANCE = 1e-6
_Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e7, le=1e7)]
_Positive = Annotated[float, Field(allow_inf_nan=False, gt=0, le=1e7)]
_Point = tuple[_Number, _Number, _Number]
_Row = tuple[_Number, _Number, _Number, _Number]
_Spread = tuple[_Number, _Number, _Number, _Number, _Number, _Number, _Number]


class Correspondence(BaseModel):
    """One point on a face model and on the rig."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: _Point = Field(description="three numbers [model units]")
    rig: _Point | None = Field(None, description="three numbers [mm]")
    sigma_mm: _Positive = Field(description="a number above 0 [mm]")


class Correspondences(BaseModel):
    """Content of a file of corresponding points."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["jawusd-correspondences/1"] = Field(
        "jawusd-correspondences/1", description='"jawusd-correspondences/1"'
    )
    unit_mm: _Positive = Field(description="a number above 0 [mm]")
    scale: bool = Field(False, description="true or false")
    points: dict[str, Correspondence] = Field(description="a JSON object of points by name")
    joint: _Point | None = Field(None, description="three numbers [model units]")


class Alignment(BaseModel):
    """The alignment of a face model with a rig, with its expected error."""

    model_config = ConfigDict(extra="forbid", frozen=True)

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


def motion_of_points(points: Array) -> Array:
    """Return J (..., 3, 7) [mm] of points (..., 3): their motion under a small (omega [rad], v [mm], log scale)."""
    p = np.asarray(points, dtype=np.float64)
    unit = np.broadcast_to(np.eye(3), (*p.shape, 3))
    return np.concatenate([-hat(p), unit, p[..., None]], axis=-1)


def load_correspondences(path: str | os.PathLike[str]) -> Correspondences:
    """Read corresponding points.

    Raises:
        FormatError: the file is not one of corresponding points; the message names the wrong entry.
    """
    path = Path(path)
    hint = "The format is described in the reference of files, and by an example in the guide to face solvers."
    return parse_model(read_text(path, _MAX_BYTES), path, Correspondences, hint)


def load_alignment(path: str | os.PathLike[str]) -> Alignment:
    """Read an alignment.

    Raises:
        FormatError: the file is not an alignment; the message names the wrong entry.
    """
    path = Path(path)
    found = parse_model(read_text(path, _MAX_BYTES), path, Alignment, "Such a file is written by `jawusd align`.")
    if rigidity_defect(found.matrix) > _RIGID_TOLERANCE:
        raise FormatError('"T_skull_model" must be a rigid 4 x 4 matrix.', path=path)
    return found


def save_alignment(path: str | os.PathLike[str], alignment: Alignment) -> None:
    """Write an alignment atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    write_text_atomic(path, json.dumps(alignment.model_dump(mode="json"), indent=1) + "\n")
