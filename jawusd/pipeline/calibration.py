"""Calibrate a capture from its boards: wires scans, boards and the report together."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jawusd.errors import SyncError, TrackingError, explain_missing_packages
from jawusd.formats.calibration import save_calibration
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera
from jawusd.pipeline.prepare import load_meshes
from jawusd.pipeline.stages import about, sync_cameras
from jawusd.pipeline.state import Progress

_LISTED = 10
_SIZE_SIGMA = 0.005  # of the teeth's size as masks tell it


@explain_missing_packages()
def calibrate_boards(capture: Capture, out: Path, progress: Progress) -> dict:
    """Calibrate the cameras from the boards of a capture and write the calibration.

    Args:
        capture: names the boards.
        out: aniposelib TOML to write.
        progress: told of every picture searched.

    Returns:
        The report as plain data; see `capture.calibrate.CalibrationReport`.

    Raises:
        CalibrationError: the boards do not carry a calibration.
        CaptureError: a clip or scan cannot be read.
        OutputError: the file cannot be written.
    """
    from jawusd.capture.calibrate import calibrate_capture

    with about(capture.folder / "capture.toml"):
        meshes = load_meshes(capture)
        scans = {jaw: meshes[f"{jaw}_teeth"].vertices for jaw in ("upper", "lower")}
        cameras, report = calibrate_capture(
            capture,
            scans,
            lambda done, total: progress("calibrate", done, total),
            lambda cameras, by_picks: _scale_by_masks(capture, meshes, cameras, by_picks, progress),
        )
    save_calibration(out, cameras)
    return report.as_dict()


def _scale_by_masks(
    capture: Capture, meshes: Mapping[str, Mesh], cameras: list[Camera], by_picks: Any, progress: Progress
) -> Any:
    """Return what the masks tell of the size of the teeth, as a `capture.scale.ScaleCheck`.

    Raises:
        CalibrationError: the teeth come out with another size than their scans.
    """
    from jawusd.capture.scale import ScaleCheck, judged_scale
    from jawusd.tracking.initialization.scale_search import seen_size

    if sum(camera.masks is not None for camera in capture.cameras) < 2:
        return ScaleCheck(None, None, f"{by_picks.reason}, nor masks of two cameras to search the teeth in")
    scans = [meshes[f"{jaw}_teeth"] for jaw in ("upper", "lower")]
    progress("size of the teeth", 0, 1)
    try:
        offsets = sync_cameras(capture, progress)["offsets"]
        ratio = seen_size(capture, cameras, offsets, scans)
    except (SyncError, TrackingError) as error:
        why = f"{by_picks.reason}, and the teeth could not be searched in the masks ({error.statement().rstrip('.')})"
        return ScaleCheck(None, None, why)
    progress("size of the teeth", 1, 1)
    return judged_scale(ratio, _SIZE_SIGMA, capture.boards.square_mm)


def calibration_lines(report: dict) -> list[str]:
    """Return a calibration report as text."""
    lines = [f"calibrated from {report['views']} views of the board"]
    for name, camera in report["cameras"].items():
        line = (
            f"  {name}: {camera['rms_px']:.3f} px rms, {camera['views']} views, {camera['coverage']:.0%} of the picture"
        )
        for word in ("blurred", "missed"):
            if numbers := camera[word]:
                more = f" and {len(numbers) - _LISTED} more" if len(numbers) > _LISTED else ""
                line += f"; {word}: {', '.join(map(str, numbers[:_LISTED]))}{more}"
        lines.append(line)
    shape = report["board_shape"]
    if shape["distances"]:
        lines.append(
            f"  distances on the boards near the mouth: wrong by {shape['mean']:.4f} mm (mean), {shape['p95']:.4f} "
            f"(p95), {shape['max']:.4f} (max)"
        )
    lines.append(
        f"  distances in the mouth, expected from the scatter of the corners: {report['expected_shape_mm']:.4f} mm "
        f"(mean); middle of the mouth from {report['mouth_from']}"
    )
    if (ratio := report["scale"]["ratio"]) is not None:
        lines.append(f"  the teeth confirm the board's size: seen {ratio:.4f} times (+-{report['scale']['sigma']:.4f})")
    return lines + [f"  note: {note}" for note in report["notes"]] + [f"  advice: {text}" for text in report["advice"]]
