"""Which masks can be trusted: a confidence per frame and camera, and the frames to be looked at, worst first."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import FormatError, explain_missing_packages
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.capture import Capture
from jawusd.formats.text import read_text
from jawusd.formats.tracks import LOST
from jawusd.geometry.arrays import Array
from jawusd.pipeline import journal
from jawusd.pipeline.made_masks import SUMMARY
from jawusd.pipeline.segment import LEARNED, SegmentOptions, segment_teeth
from jawusd.pipeline.state import Progress

SHEET = "look_at_these.png"
FORMAT = "jawusd-segment/1"
_MAX_LEARNED_BYTES = 1 << 20
# Below this confidence a mask is to be looked at: a symptom at twice its usual spread.
_DOUBTFUL = 0.5
# Symptoms of a bad mask and whether more is worse; each is judged by how far it is off what the take's masks are like.
_SYMPTOMS = {"contrast": -1.0, "unexpected": 1.0, "residual_px": 1.0, "uncovered": 1.0}
_LEAST_SPREAD = {"contrast": 0.03, "unexpected": 0.01, "residual_px": 0.05, "uncovered": 0.01}
_USUAL_OFF = 3.0  # spreads at which a symptom alone brings the confidence to one half
# How far off an outline may well be [px of the working picture] where it shows in the picture, where it does not, and
# between the rows; over the mask's area that tells how much of the mask may be wrong. Small masks and masks without
# edges in the picture stand out in all cameras alike, so all are judged together, and sooner than by other symptoms.
_OUTLINE_PX = (0.4, 2.0, 0.6)
_OUTLINE, _OUTLINE_SPREAD, _OUTLINE_OFF = "outline", 0.01, 1.5
_SHEET_FRAMES = 12


def summarise(entries: dict[int, dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per frame and camera, in order: confidence 0 .. 1 of the worse row of teeth, and the reason.

    Args:
        entries: what is known about every frame, as `segment_teeth` returns it.
    """
    keys = [(frame, name) for frame in sorted(entries) for name in entries[frame]["cameras"]]
    found = [entries[frame]["cameras"][name] for frame, name in keys]
    cameras = np.array([name for _, name in keys])
    everywhere = np.zeros(len(keys), int)
    off = [_off(_values(found, symptom), cameras, _LEAST_SPREAD[symptom]) for symptom in _SYMPTOMS]
    off.append(_off(_outline_doubt(found), everywhere, _OUTLINE_SPREAD) * (_USUAL_OFF / _OUTLINE_OFF))
    off = np.stack(off, axis=-1)  # (N, 2, S)
    lost = np.array([[state == LOST for state in entries[frame]["status"]] for frame, _ in keys])
    doubt = np.where(lost, np.inf, np.maximum(off, 0).max(-1) / _USUAL_OFF)
    rows = []
    for k, (frame, name) in enumerate(keys):
        worse = int(doubt[k].argmax())
        reason = "lost" if lost[k, worse] else (*_SYMPTOMS, _OUTLINE)[int(off[k, worse].argmax())]
        confidence = float(1 / (1 + doubt[k, worse] ** 2))
        rows.append(
            {
                "frame": frame,
                "camera": name,
                "own_frame": found[k]["frame"],
                "confidence": round(confidence, 3),
                "row": ("upper", "lower")[worse],
                "reason": reason,
            }
        )
    return rows


def _values(found: list[dict], symptom: str) -> Array:
    """Return a symptom of every mask, more is worse, NaN without a mask, shape (N, 2)."""
    values = [[np.nan if v is None else v for v in entry[symptom]] for entry in found]
    return _SYMPTOMS[symptom] * np.array(values, np.float64)


def _outline_doubt(found: list[dict]) -> Array:
    """Return the share of every mask that may be wrong, NaN without a mask, shape (N, 2)."""
    outline, area = (np.array([entry[key] for entry in found], np.float64) for key in ("outline", "pixels"))
    return np.where(area > 0, outline @ np.array(_OUTLINE_PX) / np.maximum(area, 1), np.nan)


def _off(values: Array, groups: NDArray, least_spread: float) -> Array:
    """Return how many spreads values, shape (N, 2), lie above the median of their group and row, shape (N, 2)."""
    out = np.zeros_like(values)
    for group in np.unique(groups):
        of = groups == group
        for r in (0, 1):
            seen = values[of, r][np.isfinite(values[of, r])]
            if len(seen):
                middle = np.median(seen)
                spread = max(1.4826 * np.median(np.abs(seen - middle)), least_spread)
                out[of, r] = np.nan_to_num((values[of, r] - middle) / spread)
    return out


@explain_missing_packages()
def write_summary(capture: Capture, entries: dict[int, dict[str, Any]], folder: Path) -> dict[str, Any]:
    """Write segment.json, and thumbnails of the worst masks if any are to be looked at.

    Args:
        capture: gives the videos.
        entries: as for `summarise`.
        folder: holds the masks.

    Returns:
        What segment.json holds.

    Raises:
        CaptureError: a picture or mask cannot be read.
        FormatError: what was learned from drawn masks cannot be read.
        OutputError: a file cannot be written.
    """
    rows = summarise(entries)
    doubtful = sorted((row for row in rows if row["confidence"] < _DOUBTFUL), key=lambda row: row["confidence"])
    summary = {
        "format": FORMAT,
        "capture": capture.name,
        "masks": {
            camera.name: {row: f"{camera.name}/{row}/%06d.png" for row in ("upper", "lower")}
            for camera in capture.cameras
            if camera.video is not None
        },
        "frames": len(entries),
        "learned": _learned(folder / LEARNED),
        "look_at": doubtful,
        "sheet": SHEET if doubtful else None,
        "confidence": rows,
    }
    write_text_atomic(folder / SUMMARY, json.dumps(summary, indent=1) + "\n")
    if doubtful:
        from jawusd.segmentation.sheet import write_sheet

        videos = {camera.name: camera.video for camera in capture.cameras}
        worst = [(row["camera"], row["own_frame"], row["reason"]) for row in doubtful[:_SHEET_FRAMES]]
        write_sheet(folder / SHEET, worst, videos, folder)
    return summary


def _learned(path: Path) -> dict[str, Any] | None:
    """Return what was learned from drawn masks, None if nothing was."""
    if not path.exists():
        return None
    try:
        learned = json.loads(read_text(path, _MAX_LEARNED_BYTES))
        first, last = (float(value) for value in learned["disagreement"])
        return {**learned, "pictures": int(learned["pictures"]), "disagreement": [first, last]}
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        hint = "Segment again without --resume, or build with --fresh."
        raise FormatError(f"is not what `jawusd segment` wrote ({error}).", path=path, hint=hint) from error


def segment_capture(
    capture: Capture, offsets: dict[str, int], folder: Path, options: SegmentOptions, progress: Progress
) -> tuple[list[Path], dict[str, Any]]:
    """Segment a capture and sum it up; see `segment_teeth`.

    Args:
        capture: footage, calibration and scans.
        offsets: frame offset by camera.
        folder: where the masks go.
        options: how to segment.
        progress: told of the work.

    Returns:
        segment.json, and what it holds but for the confidences.
    """
    summary = write_summary(capture, segment_teeth(capture, offsets, folder, options, progress), folder)
    return [folder / SUMMARY], {key: value for key, value in summary.items() if key != "confidence"}


@explain_missing_packages()
def delete_masks(folder: Path) -> None:
    """Delete the masks that were made in a folder, what was said of them, and folders left empty.

    Files of other names stay, and so does everything in a folder that segmentation did not write to.
    """
    if not (folder / journal.FILE).is_file():
        return
    from jawusd.segmentation.state import state_files

    states = state_files(folder)
    for path in (*states, *(folder / name for name in (journal.FILE, SUMMARY, SHEET, LEARNED))):
        path.unlink(missing_ok=True)
    for path in [*folder.glob("*/upper/*.png"), *folder.glob("*/lower/*.png")]:
        # A link may lead out of the folder.
        if path.stem.isdigit() and path.resolve().is_relative_to(folder.resolve()):
            path.unlink()
    for path in [*folder.glob("*/upper"), *folder.glob("*/lower"), *folder.glob("*"), folder]:
        with contextlib.suppress(OSError):  # not empty, or no folder
            path.rmdir()


def segment_lines(summary: dict[str, Any]) -> list[str]:
    """Return the summary for people."""
    doubtful = summary["look_at"]
    lines = [f"{summary['frames']} frames segmented in {len(summary['masks'])} cameras"]
    if learned := summary.get("learned"):
        before, after = (f"{100 * value:.1f} %" for value in learned["disagreement"])
        lines.append(f"learned from {learned['pictures']} drawn pictures: disagreement {before} before, {after} after")
    if doubtful:
        lines.append(f"{len(doubtful)} masks to look at, worst first (thumbnails in {summary['sheet']}):")
    for row in doubtful[:_SHEET_FRAMES]:
        where = f"  {row['camera']} frame {row['own_frame']:>5}  {row['row']:<5}"
        lines.append(f"{where}  confidence {row['confidence']:.2f}  {row['reason']}")
    return lines
