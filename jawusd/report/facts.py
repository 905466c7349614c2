"""Types of the JSON headers that the report reads; written by synchronisation, tracking and fitting."""

from __future__ import annotations

from typing import cast

from typing_extensions import TypedDict

from jawusd.formats.report import ReportData
from jawusd.formats.text import Frames
from jawusd.formats.tracks import Registration

ErrorTable = dict[str, dict[str, float]]


class SyncFacts(TypedDict, total=False):
    """Result of the synchronisation, by camera."""

    method: str
    offsets: dict[str, Frames]
    confidence: dict[str, float]


class StartFacts(TypedDict, total=False):
    """Initialisation of the tracking."""

    by: str
    frame: int
    picks_left_out: dict[str, list[int]]


class ExtrinsicsFacts(TypedDict, total=False):
    """Corrections of the camera poses by tracking, by camera."""

    corrected: bool
    turns_deg: dict[str, list[float]]
    moves_mm: dict[str, list[float]]


class TracksFacts(TypedDict, total=False):
    """Header of tracks."""

    start: StartFacts
    extrinsics: ExtrinsicsFacts
    calibration_rescaled_px: dict[str, tuple[tuple[int, int], tuple[int, int]]]
    delays_frames: dict[str, float]
    outline_bias_px: dict[str, list[float]]
    gum_bias_px: dict[str, list[float]]
    gum_line_mm: list[float]
    registration: Registration


class ModelFacts(TypedDict, total=False):
    """Header of a model."""

    method: str
    fps: float
    errors: dict[str, ErrorTable]
    uncertainty: ErrorTable
    excluded_frames: dict[str, list[int]]
    trimmed_frames: list[int]
    warnings: list[dict[str, str]]


def sync_facts(data: ReportData) -> SyncFacts:
    """Return the result of the synchronisation."""
    return cast(SyncFacts, data.sync)


def tracks_facts(data: ReportData) -> TracksFacts:
    """Return the header of the tracks."""
    return cast(TracksFacts, data.tracks.meta)


def model_facts(data: ReportData) -> ModelFacts:
    """Return the header of the model."""
    return cast(ModelFacts, data.model.meta)
