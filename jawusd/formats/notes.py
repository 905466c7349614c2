"""Schema of the JSON headers (`meta`) of results, shared by writers, checks and reports.

Every value is optional: other programs and older versions omit some values or add others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Required

from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from jawusd.base.errors import AnyPath, FormatError
from jawusd.formats.text import Frames

ErrorTable = dict[str, dict[str, float]]
_STRICT = ConfigDict(strict=True, extra="ignore")


class CameraCorrections(TypedDict, total=False):
    """Corrections of the camera poses, estimated on a take, in tables by camera name."""

    corrected: bool
    pivot_mm: list[float]
    turns_deg: dict[str, list[float]]
    turns_sigma_deg: dict[str, list[float]]
    moves_mm: dict[str, list[float]]
    moves_sigma_mm: dict[str, list[float]]
    T_cam_world: dict[str, list[list[float]]]


class Registration(TypedDict, total=False):
    """Registration of the lower scan to the occlusion found in the take, in skull (scan) axes.

    Shift and turn describe the motion `T` (4, 4) of the scan about the centre of the lower crowns.
    """

    frames: Required[list[int]]  # number of frames with the teeth together
    named: bool  # whether the capture specifies the rest frame
    applied: Required[bool]  # whether the poses and the lower scan use the corrected registration
    shift_mm: Required[list[float]]
    turn_deg: Required[list[float]]
    shift_sigma_mm: list[float]
    turn_sigma_deg: list[float]
    T: Required[list[list[float]]]


def registration_sizes(found: Registration) -> tuple[float, float, float, float]:
    """Return the magnitudes of shift [mm] and turn [deg], and of their standard deviations, NaN if unknown."""
    sigma_mm = math.hypot(*found.get("shift_sigma_mm", [math.nan]))
    sigma_deg = math.hypot(*found.get("turn_sigma_deg", [math.nan]))
    return math.hypot(*found["shift_mm"]), math.hypot(*found["turn_deg"]), sigma_mm, sigma_deg


class TakeNotes(TypedDict, total=False):
    """Estimates for the whole take, stored in tracks and printed in summaries; pairs are (upper, lower) arch."""

    outline_bias_px: dict[str, list[float]]  # bias of the mask outlines at tooth edges, by camera
    gum_bias_px: dict[str, list[float]]  # bias of the mask outlines at the gum line, by camera
    # Offset of the gum line in masks from that of the scans, along the surface towards the gum.
    gum_line_mm: list[float]
    registration: Registration  # registration of the lower scan, estimated in occlusion
    calibration_rescaled_px: dict[str, list[list[int]]]  # calibrated and recorded (width, height), by camera
    prior_spread_mm: float  # standard deviation of the model prior of all final poses, if there is one
    findings: list[dict[str, str | float | int]]  # `Finding.as_json` of all warnings about the take


@with_config(_STRICT)
class TracksMeta(TakeNotes, total=False):
    """Header of tracks; tables are by camera name, pairs are (upper, lower) arch."""

    tracking: dict[str, object]  # configuration of the tracker
    correlation_px: float
    delays_frames: dict[str, float]
    delays_sigma_frames: dict[str, float]
    outline_bias_sigma_px: dict[str, list[float]]
    gum_bias_sigma_px: dict[str, list[float]]
    gum_line_sigma_mm: list[float]
    steady_error: list[list[list[float]]]  # for each arch: S (4, 4) such that T_world_arch @ S matches the masks
    extrinsics: CameraCorrections
    focal: dict[str, list[float]]  # ratio of estimated to calibrated focal length and its standard deviation, by camera
    start: dict[str, object]  # method and frame of the initialisation of tracking
    painted: list[bool]
    solver: str
    backend: str
    evaluations_per_row_and_frame: float
    fps: float  # frame rate of a performance [Hz]
    tolerance_mm: float  # maximum distance outside the bound at which the rig accepts poses of a performance


class ModelWarning(TypedDict):
    """Warning about a model: a movement that the take lacks, or insufficient quality."""

    code: str
    message: str


@with_config(_STRICT)
class ModelMeta(TypedDict, total=False):
    """Header of a model; keys that are never read are omitted."""

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
    """Offset of every camera from the reference camera [frames], with quality figures of the method that found it."""

    method: str
    offsets: Required[dict[str, Frames]]
    reference: str
    exact_frames: dict[str, float]
    confidence: dict[str, float]
    notes: list[str]


class CameraFigures(TypedDict):
    """Statistics of one camera's calibration."""

    views: int
    rms_px: float
    coverage: float  # fraction of image cells that contain corners
    empty_corners: list[str]
    blurred: list[int]  # image numbers
    missed: list[int]  # image numbers


class CalibrationNotes(TypedDict):
    """Accuracy of a calibration, with advice on how to improve it."""

    cameras: dict[str, CameraFigures]
    views: int  # number of board poses used
    #: absolute errors of distances between corners near the mouth [mm]: "mean", "p95", "max", and the number of
    #: "distances"; 0 if no corner near the mouth was visible to two cameras
    board_shape: dict[str, float]
    expected_shape_mm: float  # mean error of distances in the mouth that the scatter of the corners implies
    mouth_mm: tuple[float, float, float]  # centre of the mouth in world coordinates
    mouth_from: str  # text that names the source of mouth_mm
    #: `capture.calibrate.ScaleCheck` of the board's square size against the size of the teeth
    scale: dict[str, float | str | None]
    advice: list[str]  # possible improvements of the calibration, one sentence each
    notes: list[str]  # assumptions of the calibration, one sentence each


def check_notes(meta: Mapping[str, object], kind: type[TracksMeta] | type[ModelMeta], path: AnyPath) -> None:
    """Check the types of a header's values.

    Raises:
        FormatError: a value has the wrong type.
    """
    try:
        TypeAdapter(kind).validate_python(meta)
    except ValidationError as error:
        fault = error.errors()[0]
        name = ".".join(map(str, fault["loc"]))
        raise FormatError(f'"meta" has an invalid "{name}": {fault["msg"]}.', path=path) from error
