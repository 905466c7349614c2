"""Records of a segmentation: a journal with one line per finished frame, for resuming, and a summary of confidences."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NotRequired, TypedDict, cast

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError, OutputError, explain_missing_packages
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.capture import CameraSource, Capture
from jawusd.formats.capture_parts import Masks
from jawusd.formats.text import read_text
from jawusd.formats.tracks import LOST
from jawusd.pipeline.state import hash_value

if TYPE_CHECKING:
    from jawusd.segmentation.camera import LearnedNumbers

RECORD, SUMMARY, SHEET, LEARNED = "segment.jsonl", "segment.json", "look_at_these.png", "learned.json"
FORMAT = "jawusd-segment/1"
_MAX_LEARNED_BYTES = 1 << 20
# Confidence below which masks need inspection.
_LOW_CONFIDENCE = 0.5
# Symptoms of a bad mask, with 1 if larger values are worse and -1 if smaller ones are, and the least spread of their
# values. Each is compared with its median over the take.
_SYMPTOMS = {"contrast": (-1, 0.03), "unexpected": (1, 0.01), "residual_px": (1, 0.05), "uncovered": (1, 0.01)}
_USUAL_OFF = 3.0  # deviation, in robust standard deviations, at which a single symptom halves the confidence
# Likely error of a mask's outline [px of the working image] on an image edge, away from edges, and between the arches.
# Integrated along the outline and divided by the mask's area, it gives the fraction of the mask that may be wrong. This
# fraction is comparable across cameras, so the frames of all cameras are pooled, with a stricter limit.
_OUTLINE_PX = (0.4, 2.0, 0.6)
_OUTLINE, _OUTLINE_SPREAD, _OUTLINE_OFF = "outline", 0.01, 1.5
_SHEET_FRAMES = 12

Pair = list[float | None]


class CameraEntry(TypedDict):
    """Quality of one camera's masks in a frame; pairs are (upper, lower), None where there is no mask."""

    frame: int
    contrast: Pair
    pixels: list[int]
    outline: list[list[int]]
    unexpected: Pair
    residual_px: Pair
    uncovered: Pair


class TrackEntry(TypedDict):
    """The fields of `FrameSummary` that describe the quality of tracking."""

    used: list[list[bool]]
    coverage: list[Pair]
    score_px: list[Pair]
    residual_px: Pair


class FrameEntry(TypedDict):
    """A finished frame: T_world_upper and T_world_lower, the status of each, and the quality of masks and tracking."""

    poses: list[list[list[float]]]
    status: list[int]
    cameras: dict[str, CameraEntry]
    track: TrackEntry
    again: NotRequired[bool]


class MaskConfidence(TypedDict):
    """Confidence, 0 .. 1, in the worse of the two masks of an image, and the reason if it is low."""

    frame: int
    camera: str
    own_frame: int
    confidence: float
    row: str
    reason: str


class SegmentSummary(TypedDict):
    """Contents of segment.json."""

    format: str
    capture: str
    masks: dict[str, dict[str, str]]
    frames: int
    learned: LearnedNumbers | None
    look_at: list[MaskConfidence]
    sheet: str | None
    confidence: NotRequired[list[MaskConfidence]]


def auto_masks_folder(capture: Capture) -> Path | None:
    """Return the folder of a capture's masks if `jawusd segment` wrote all of them, otherwise None."""
    masks = [path for camera in capture.cameras if camera.masks for path in (camera.masks.upper, camera.masks.lower)]
    folders = {path.parents[2] if len(path.parents) > 2 else None for path in masks}
    folder = folders.pop() if len(folders) == 1 else None
    return folder if folder is not None and (folder / SUMMARY).is_file() else None


class Journal:
    """The record of finished frames, kept in memory and in a JSON Lines file."""

    def __init__(self, folder: Path, inputs: str, resume: bool) -> None:
        """Open the record, empty or, to resume, with the frames already finished from inputs with the same hash.

        Raises OutputError if the folder cannot be written, or the file not be read.
        """
        self._path = folder / RECORD
        self.entries: dict[int, FrameEntry] = {}
        self._head = json.dumps({"inputs": inputs})
        lines = _lines(self._path) if resume else []
        if lines and lines[0] == self._head:
            self.entries = dict(entry for line in lines[1:] if (entry := _entry(line)) is not None)
        self.drop(())

    def add(self, frame: int, entry: FrameEntry) -> None:
        """Record a finished frame; raises OutputError if the file cannot be written."""
        line = _line(frame, entry)
        self.entries[frame] = json.loads(line)["entry"]
        try:
            with open(self._path, "a", encoding="utf-8") as handle:
                handle.write(line + "\n")
        except OSError as error:
            raise OutputError(f"cannot be written: {error.strerror}.", path=self._path) from error

    def drop(self, frames: Iterable[int]) -> None:
        """Remove frames; raises OutputError if the file cannot be written."""
        for frame in frames:
            del self.entries[frame]
        kept = [self._head, *(_line(frame, entry) for frame, entry in self.entries.items())]
        write_text_atomic(self._path, "\n".join(kept) + "\n")

    def known(self, frame: int) -> tuple[Array, NDArray[np.int8]]:
        """Return T_world_upper and T_world_lower, shape (2, 4, 4), and status, shape (2,), of a frame."""
        entry = self.entries[frame]
        return np.array(entry["poses"], np.float64), np.array(entry["status"], np.int8)


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
    except OSError as error:
        raise OutputError(f"cannot be read: {error.strerror}.", path=path) from error


def _line(frame: int, entry: FrameEntry) -> str:
    # JSON has no NaN and infinity; they become null.
    data = json.loads(json.dumps({"frame": frame, "entry": entry}), parse_constant=lambda _: None)
    return json.dumps({**data, "sha256": hash_value(data)})


def _entry(line: str) -> tuple[int, FrameEntry] | None:
    """Return the frame and the entry of a journal line; None if the line is truncated or corrupt."""
    try:
        data = json.loads(line)
        known = data.pop("sha256")
        return (data["frame"], data["entry"]) if known == hash_value(data) else None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def summarise(entries: Mapping[int, FrameEntry]) -> list[MaskConfidence]:
    """Return the confidence in the masks of every image, ordered by frame and camera."""
    keys = [(frame, name) for frame in sorted(entries) for name in entries[frame]["cameras"]]
    found = [entries[frame]["cameras"][name] for frame, name in keys]
    cameras = np.array([name for _, name in keys])
    everywhere = np.full(len(keys), "")
    pairs = cast("list[Mapping[str, Pair]]", found)
    parts = [
        _off(sign * np.array([entry[name] for entry in pairs], np.float64), cameras, least_spread)
        for name, (sign, least_spread) in _SYMPTOMS.items()
    ]
    parts.append(_off(_outline_doubt(found), everywhere, _OUTLINE_SPREAD) * (_USUAL_OFF / _OUTLINE_OFF))
    off = np.stack(parts, axis=-1)  # shape (N, 2, number of symptoms)
    lost = np.array([[state == LOST for state in entries[frame]["status"]] for frame, _ in keys])
    doubt = np.where(lost, np.inf, np.maximum(off, 0).max(-1) / _USUAL_OFF)
    rows: list[MaskConfidence] = []
    for k, (frame, name) in enumerate(keys):
        worse = int(doubt[k].argmax())
        rows.append(
            {
                "frame": frame,
                "camera": name,
                "own_frame": found[k]["frame"],
                "confidence": round(float(1 / (1 + doubt[k, worse] ** 2)), 3),
                "row": ("upper", "lower")[worse],
                "reason": "lost" if lost[k, worse] else (*_SYMPTOMS, _OUTLINE)[int(off[k, worse].argmax())],
            }
        )
    return rows


def _outline_doubt(found: Sequence[CameraEntry]) -> Array:
    """Return the fraction of each mask's area that may be wrong, NaN where there is no mask, shape (N, 2)."""
    outline = np.array([entry["outline"] for entry in found], np.float64)
    area = np.array([entry["pixels"] for entry in found], np.float64)
    return np.where(area > 0, outline @ np.array(_OUTLINE_PX) / np.maximum(area, 1), np.nan)


def _off(values: Array, groups: NDArray[np.str_], least_spread: float) -> Array:
    """Return the excess of values (N, 2) over the median of their group and arch, in robust sigmas, shape (N, 2)."""
    out = np.zeros_like(values)
    for group in np.unique(groups):
        of = groups == group
        for arch in (0, 1):
            seen = values[of, arch][np.isfinite(values[of, arch])]
            if len(seen):
                middle = np.median(seen)
                spread = max(1.4826 * float(np.median(np.abs(seen - middle))), least_spread)
                out[of, arch] = np.nan_to_num((values[of, arch] - middle) / spread)
    return out


@explain_missing_packages()
def write_summary(capture: Capture, entries: Mapping[int, FrameEntry], folder: Path) -> SegmentSummary:
    """Write segment.json, and thumbnails of the worst masks if any need inspection, to the folder of the masks.

    Raises CaptureError if an image cannot be read, FormatError if learned parameters are corrupt, and OutputError.
    """
    rows = summarise(entries)
    uncertain = sorted((row for row in rows if row["confidence"] < _LOW_CONFIDENCE), key=lambda row: row["confidence"])
    videos = {camera.name: camera.clip for camera in capture.cameras if camera.clip is not None}
    summary: SegmentSummary = {
        "format": FORMAT,
        "capture": capture.name,
        "masks": {name: {arch: f"{name}/{arch}/%06d.png" for arch in ("upper", "lower")} for name in videos},
        "frames": len(entries),
        "learned": _learned(folder / LEARNED),
        "look_at": uncertain,
        "sheet": SHEET if uncertain else None,
        "confidence": rows,
    }
    write_text_atomic(folder / SUMMARY, json.dumps(summary, indent=1) + "\n")
    if uncertain:
        from jawusd.segmentation.files import write_sheet

        worst = [(row["camera"], row["own_frame"], row["reason"]) for row in uncertain[:_SHEET_FRAMES]]
        write_sheet(folder / SHEET, worst, videos, folder)
    return summary


def _learned(path: Path) -> LearnedNumbers | None:
    """Return the result of learning from drawn masks; None if no masks were drawn."""
    if not path.exists():
        return None
    try:
        learned = json.loads(read_text(path, _MAX_LEARNED_BYTES))
        first, last = (float(value) for value in learned["disagreement"])
        numbers, pictures = dict(learned["numbers"]), int(learned["pictures"])
        return {"numbers": numbers, "disagreement": [first, last], "pictures": pictures}
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        hint = "Run `jawusd segment` again without --resume."
        raise FormatError(f"is not what `jawusd segment` wrote ({error}).", path=path, hint=hint) from error


@explain_missing_packages()
def delete_masks(folder: Path) -> None:
    """Delete the masks and records that a segmentation wrote to a folder, and the folders left empty."""
    if not (folder / RECORD).is_file():
        return
    from jawusd.segmentation.colours import state_files

    for path in (*state_files(folder), *(folder / name for name in (RECORD, SUMMARY, SHEET, LEARNED))):
        path.unlink(missing_ok=True)
    for path in [*folder.glob("*/upper/*.png"), *folder.glob("*/lower/*.png")]:
        # Symbolic links may point outside the folder.
        if path.stem.isdigit() and path.resolve().is_relative_to(folder.resolve()):
            path.unlink()
    for path in [*folder.glob("*/upper"), *folder.glob("*/lower"), *folder.glob("*"), folder]:
        with contextlib.suppress(OSError):  # the folder is not empty, or the path is not a folder
            path.rmdir()


def with_masks(capture: Capture, folder: Path) -> Capture:
    """Return the capture with the masks that `segment_teeth` wrote to a folder."""
    from jawusd.segmentation.files import ARCHES, mask_pattern

    def masked(camera: CameraSource) -> CameraSource:
        masks = Masks(**{arch: mask_pattern(folder, camera.name, arch) for arch in ARCHES})
        return camera if camera.video is None else camera.model_copy(update={"masks": masks})

    return capture.model_copy(update={"cameras": tuple(map(masked, capture.cameras))})
