"""What JSON headers of results (`meta`) say: one schema for those who write, check and show them.

Every value is optional: other programs and older versions leave values out or add their own.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Required

from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from jawusd.base.errors import FormatError
from jawusd.formats.text import Frames

ErrorTable = dict[str, dict[str, float]]
_STRICT = ConfigDict(strict=True, extra="ignore")


class CameraCorrections(TypedDict, total=False):
    """Camera poses as a take corrects them; tables by camera name."""

    corrected: bool
    pivot_mm: list[float]
    turns_deg: dict[str, list[float]]
    turns_sigma_deg: dict[str, list[float]]
    moves_mm: dict[str, list[float]]
    moves_sigma_mm: dict[str, list[float]]
    T_cam_world: dict[str, list[list[float]]]


class Registration(TypedDict, total=False):
    """How far the lower scan is from where the closed bite of the take shows it, in skull (scan) axes.

    `T` (4, 4) maps the lower scan as it was given to where it belongs; shift and turn are of the same motion about the
    middle of the lower crowns. Standard deviations follow.
    """

    frames: Required[list[int]]  # with the teeth together
    named: bool  # the capture names such a frame
    applied: Required[bool]  # poses and lower scan are those of the corrected registration
    shift_mm: Required[list[float]]
    turn_deg: Required[list[float]]
    shift_sigma_mm: list[float]
    turn_sigma_deg: list[float]
    T: Required[list[list[float]]]


class TakeNotes(TypedDict, total=False):
    """Estimates over a whole take, which tracks hold and summaries print; pairs are (upper, lower)."""

    outline_bias_px: dict[str, list[float]]  # by camera: how far the masks of both arches extend beyond free edges
    gum_bias_px: dict[str, list[float]]  # by camera: the same at the gum line
    gum_line_mm: list[float]  # distance of the drawn gum line from the scans', towards the gum, along the surface
    registration: Registration  # of the lower scan, from frames with the teeth together
    calibration_rescaled_px: dict[str, list[list[int]]]  # by camera: (width, height) calibrated and recorded
    prior_spread_mm: float  # width of the model's prior that all final poses were weighed with, where they were
    findings: list[dict[str, str | float | int]]  # `Finding.as_json` of all warnings about the take


@with_config(_STRICT)
class TracksMeta(TakeNotes, total=False):
    """Header of tracks; tables by camera name, pairs are (upper, lower)."""

    tracking: dict[str, object]  # configuration
    correlation_px: float
    delays_frames: dict[str, float]
    delays_sigma_frames: dict[str, float]
    outline_bias_sigma_px: dict[str, list[float]]
    gum_bias_sigma_px: dict[str, list[float]]
    gum_line_sigma_mm: list[float]
    steady_error: list[list[list[float]]]  # of both arches S (4, 4): the masks showed T_world_arch @ S
    extrinsics: CameraCorrections
    focal: dict[str, list[float]]  # by camera: focal length over the calibrated one, and its standard deviation
    start: dict[str, object]  # how and on which frame tracking was initialised
    painted: list[bool]
    solver: str
    backend: str
    evaluations_per_row_and_frame: float
    fps: float  # frames per second of a performance
    tolerance_mm: float  # how far outside the bound the rig allows poses of a performance


class ModelWarning(TypedDict):
    """What the take lacks for a good model."""

    code: str
    message: str


@with_config(_STRICT)
class ModelMeta(TypedDict, total=False):
    """Header of a model, as far as it is read again."""

    actor: str
    method: str
    fps: float | None
    warnings: list[ModelWarning]
    errors: dict[str, ErrorTable]
    uncertainty: ErrorTable
    excluded_frames: dict[str, list[int]]
    trimmed_frames: list[int]
    inferred: list[str]
    registration: Registration | None


class SyncNotes(TypedDict, total=False):
    """Result of the synchronisation, by camera."""

    method: str
    offsets: dict[str, Frames]
    confidence: dict[str, float]


def check_notes(
    meta: Mapping[str, object], kind: type[TracksMeta] | type[ModelMeta], path: str | os.PathLike[str]
) -> None:
    """Check the types of the values of a header.

    Raises:
        FormatError: one has another type than its readers expect.
    """
    try:
        TypeAdapter(kind).validate_python(meta)
    except ValidationError as error:
        fault = error.errors()[0]
        name = ".".join(map(str, fault["loc"]))
        raise FormatError(f'"meta" has no readable "{name}": {fault["msg"]}.', path=path) from error
