"""Types of the JSON headers that the report reads; written by synchronisation, tracking and fitting."""

from __future__ import annotations

from typing import cast

from typing_extensions import TypedDict

from jawusd.formats.report import ReportData
from jawusd.formats.text import Frames
from jawusd.formats.tracks import Registration

ErrorTable = dict[str, dict[str, float]]


class SyncHeader(TypedDict, total=False):
    """Result of the synchronisation, by camera."""

    method: str
    offsets: dict[str, Frames]
    confidence: dict[str, float]


class StartHeader(TypedDict, total=False):
    """Initialisation of the tracking."""

    by: str
    frame: int
    picks_left_out: dict[str, list[int]]


class ExtrinsicsHeader(TypedDict, total=False):
    """Corrections of the camera poses by tracking, by camera."""

    corrected: bool
    turns_deg: dict[str, list[float]]
    moves_mm: dict[str, list[float]]


class TracksHeader(TypedDict, total=False):
    """Header of tracks."""

    start: StartHeader
    extrinsics: ExtrinsicsHeader
    calibration_rescaled_px: dict[str, tuple[tuple[int, int], tuple[int, int]]]
    delays_frames: dict[str, float]
    outline_bias_px: dict[str, list[float]]
    gum_bias_px: dict[str, list[float]]
    gum_line_mm: list[float]
    registration: Registration


class ModelHeader(TypedDict, total=False):
    """Header of a model."""

    method: str
    fps: float
    errors: dict[str, ErrorTable]
    uncertainty: ErrorTable
    excluded_frames: dict[str, list[int]]
    trimmed_frames: list[int]
    warnings: list[dict[str, str]]


def sync_header(data: ReportData) -> SyncHeader:
    """Return the result of the synchronisation."""
    return cast(SyncHeader, data.sync)


def tracks_header(data: ReportData) -> TracksHeader:
    """Return the header of the tracks."""
    return cast(TracksHeader, data.tracks.meta)


def model_header(data: ReportData) -> ModelHeader:
    """Return the header of the model."""
    return cast(ModelHeader, data.model.meta)
