"""Calibrate the cameras of a capture from its boards, and align them in time."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from jawusd.base.errors import SyncError, TrackingError, explain_missing_packages, naming_file
from jawusd.cameras.calibration import save_calibration
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.capture import Capture
from jawusd.formats.clips import ClipSource, LightCurve
from jawusd.formats.mesh import Mesh
from jawusd.formats.notes import CalibrationNotes, SyncNotes
from jawusd.geometry import Camera
from jawusd.pipeline.state import Progress
from jawusd.pipeline.subject import load_meshes

if TYPE_CHECKING:
    from jawusd.capture.calibrate import ScaleCheck
    from jawusd.capture.sync import Alignment

PLOT_SUFFIXES = (".png", ".svg")

_SIZE_SIGMA = 0.005  # standard deviation of the scale factor estimated from masks


@explain_missing_packages()
def calibrate_boards(capture: Capture, out: Path, progress: Progress) -> CalibrationNotes:
    """Calibrate the cameras from the boards of a capture and write the calibration as aniposelib TOML.

    Raises:
        CalibrationError, CaptureError: the boards do not suffice, or a clip or scan cannot be read.
        OutputError: the file cannot be written.
    """
    from jawusd.capture.calibrate import calibrate_capture

    with naming_file(capture.file):
        meshes = load_meshes(capture)
        scans = {jaw: meshes[f"{jaw}_teeth"].vertices for jaw in ("upper", "lower")}
        cameras, report = calibrate_capture(
            capture,
            scans,
            partial(progress, "calibrate"),
            lambda cameras, by_picks: _scale_by_masks(capture, meshes, cameras, by_picks, progress),
        )
    save_calibration(out, cameras)
    return report


def _scale_by_masks(
    capture: Capture, meshes: Mapping[str, Mesh], cameras: list[Camera], by_picks: ScaleCheck, progress: Progress
) -> ScaleCheck:
    """Return the scale of the teeth estimated from the masks, to verify the stated size of the calibration board."""
    from jawusd.capture.calibrate import ScaleCheck, checked_scale
    from jawusd.tracking.initialization.scale_search import seen_size

    if capture.boards is None or sum(camera.masks is not None for camera in capture.cameras) < 2:
        return ScaleCheck(None, None, f"{by_picks.reason}, and fewer than two cameras have masks")
    scans = [meshes[f"{jaw}_teeth"] for jaw in ("upper", "lower")]
    progress("size of the teeth", 0, 1)
    try:
        offsets = sync_cameras(capture, progress)["offsets"]
        ratio = seen_size(capture, cameras, offsets, scans)
    except (SyncError, TrackingError) as error:
        why = f"{by_picks.reason}, and the search for the teeth in the masks failed ({error.statement().rstrip('.')})"
        return ScaleCheck(None, None, why)
    progress("size of the teeth", 1, 1)
    return checked_scale(ratio, _SIZE_SIGMA, capture.boards.square_mm)


def known_sync(capture: Capture) -> SyncNotes | None:
    """Return the frame offsets of the cameras if they are known without decoding clips, otherwise None."""
    if capture.sync.offsets is not None:
        return SyncNotes(offsets=dict(capture.sync.offsets), method="given in the capture")
    if len(capture.cameras) == 1 or any(camera.video is None for camera in capture.cameras):
        return SyncNotes(offsets={camera.name: 0 for camera in capture.cameras}, method="taken as simultaneous")
    return None


@explain_missing_packages()
def sync_cameras(capture: Capture, progress: Progress) -> SyncNotes:
    """Return the frame offset of every camera relative to the reference camera.

    Raises SyncError if no flash was found, or if the flashes of two cameras do not match.
    """
    progress("sync", 0, 1)
    if (result := known_sync(capture)) is None:
        from jawusd.capture.sync import estimate_offsets

        with naming_file(capture.file):
            result = _sync_result(estimate_offsets(capture))
    progress("sync", 1, 1)
    return result


@explain_missing_packages()
def sync_videos(videos: Mapping[str, Path | ClipSource], reference: str, progress: Progress) -> SyncNotes:
    """Return the frame offset of every clip relative to the reference; raises like `capture.sync.align_videos`."""
    from jawusd.capture.sync import align_videos

    progress("sync", 0, 1)
    result = _sync_result(align_videos(videos, reference))
    progress("sync", 1, 1)
    return result


def _sync_result(alignment: Alignment) -> SyncNotes:
    """Return an alignment as plain data."""
    return SyncNotes(
        offsets=alignment.offsets,
        reference=alignment.reference,
        method=alignment.method,
        exact_frames={name: offset.exact_frames for name, offset in alignment.cameras.items()},
        confidence=alignment.confidence,
        notes=list(alignment.notes),
    )


@explain_missing_packages()
def light_curves(videos: Mapping[str, Path | ClipSource], progress: Progress) -> dict[str, LightCurve]:
    """Return the mean brightness of every image by camera; raises CaptureError if a video cannot be decoded."""
    from jawusd.capture.sync import light_curve

    found: dict[str, LightCurve] = {}
    for name, video in videos.items():
        progress("brightness", len(found), len(videos))
        found[name] = light_curve(video)
    progress("brightness", len(videos), len(videos))
    return found


def write_light_curves(path: Path, curves: Mapping[str, LightCurve]) -> None:
    """Write the mean brightness of every image as CSV (camera, image, time_s, brightness); raises OutputError."""
    lines = ["camera,picture,time_s,brightness"]
    for name, curve in curves.items():
        pictures = enumerate(zip(curve.times_s, curve.brightness))
        lines += [f"{name},{k},{time_s:.6f},{mean:.3f}" for k, (time_s, mean) in pictures]
    write_text_atomic(path, "\n".join([*lines, ""]))


@explain_missing_packages()
def write_sync_plot(path: Path, curves: Mapping[str, LightCurve], result: SyncNotes | None) -> None:
    """Draw the brightness of all clips before and, if they could be aligned, after alignment, as .png or .svg.

    Raises OutputError, and MissingDependencyError without matplotlib.
    """
    from jawusd.report.figures import sync_figure
    from jawusd.report.style import write_figure

    title, offsets = "the cameras could not be aligned", None
    if result is not None:
        offsets = result["offsets"]
        listed = ", ".join(f"{name} {offsets[name]:+d}" for name in curves)
        title = f"aligned ({result['method']}): {listed} frames"
    write_figure(path, sync_figure(curves, offsets, title))
