"""Draft a capture.toml from a folder of footage and scans, and list what is missing."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

import numpy as np

from jawusd.base.errors import CaptureError, JawusdError, explain_missing_packages
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.capture_writing import BoardSketch, CameraSketch, CaptureSketch, capture_text
from jawusd.pipeline.cameras import SameSize, read_calibration
from jawusd.pipeline.folder_files import FoundFiles, camera_names, find_files, fitting, pair, with_masks
from jawusd.pipeline.state import Progress

if TYPE_CHECKING:
    from jawusd.media.clip import Clip

_PICTURES = 5  # number of images examined per board clip
_USUAL_RATES = (24.0, 25.0, 30.0, 50.0, 60.0, 120.0, *(n * 1000 / 1001 for n in (24, 30, 60, 120)))
_RATE_TOLERANCE = 2e-4  # relative difference below which frame rates count as equal; 24 and 23.976 differ by 1e-3


@dataclass
class CaptureStart:
    """A draft capture: its capture.toml, what was found, what is missing, and notes."""

    path: Path
    sketch: CaptureSketch
    found: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@explain_missing_packages()
def start_capture(folder: Path, square_mm: float | None, fps: float | None, progress: Progress) -> CaptureStart:
    """Return a draft capture of a folder with footage, scans, and board clips or a calibration; nothing is written.

    Args:
        square_mm: side of the board's squares [mm], which cannot be derived from images.
        fps: frame rate [1/s]; None: the rate of the clips.

    Raises:
        CaptureError: the path is not a folder.
    """
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "there is no such folder"
        raise CaptureError(f"{what}.", path=folder, hint="Give the folder of footage and scans.")
    files = find_files(folder)
    name = re.sub(r"[^A-Za-z0-9_\-. ]+", "_", folder.resolve().name).strip() or "capture"
    out = CaptureStart(folder / "capture.toml", CaptureSketch(name))
    progress("look", 0, 3)
    scans = _scans(files, out)
    calibration, calibrated = _calibration(folder, files, out)
    progress("look", 1, 3)
    cameras, rate = _cameras(folder, files, calibrated, out)
    progress("look", 2, 3)
    board = _board(folder, cameras, square_mm, calibration is not None, out)
    if calibration is None and board is None:
        out.missing.append("a calibration of the cameras, or a clip of a chessboard per camera")
    fps = fps or rate
    if fps is None and cameras:
        out.missing.append("fps, the frame rate: no file states it")
    out.sketch = CaptureSketch(name, fps, scans, tuple(cameras), calibration, board)
    progress("look", 3, 3)
    return out


def write_start(start: CaptureStart) -> None:
    """Write capture.toml; raises OutputError."""
    write_text_atomic(start.path, capture_text(start.sketch))


def _scans(files: FoundFiles, out: CaptureStart) -> dict[str, PurePath]:
    found: dict[str, PurePath] = {}
    for key, what in (("upper_teeth", "upper teeth"), ("lower_teeth", "lower teeth"), ("mandible", ""), ("skull", "")):
        paths = files.scans.get(key, [])
        if len(paths) == 1:
            found[key] = paths[0]
            out.found.append(f"{key}: {paths[0]}")
        elif len(paths) > 1:
            out.missing.append(f"{key}: {_listed(paths)} are all candidates; name one (a folder is for one subject)")
        elif what:
            unknown = files.scans.get("", [])
            more = f"; perhaps {_listed(unknown)}, but the name does not show it" if unknown else ""
            out.missing.append(f"{key}, the scan of the {what} (PLY, STL or OBJ){more}")
    return found


def _calibration(folder: Path, files: FoundFiles, out: CaptureStart) -> tuple[PurePath | None, list[str]]:
    """Return the calibration file, and the names of its cameras."""
    readable: dict[PurePath, list[str]] = {}
    for path in files.calibrations:
        if path.name == "images.txt":  # belongs to the cameras.txt beside it
            continue
        with suppress(JawusdError):
            cameras = read_calibration(folder / path, 1.0, lambda: SameSize((1920, 1080)))
            readable[path] = [camera.name for camera in cameras]
    if len(readable) > 1:
        out.notes.append(f"{_listed(list(readable))} contain cameras; the first is used")
    for path, names in readable.items():
        out.found.append(f"calibration: {path} ({', '.join(names)})")
        return path, names
    return None, []


def _cameras(
    folder: Path, files: FoundFiles, calibrated: Sequence[str], out: CaptureStart
) -> tuple[list[CameraSketch], float | None]:
    """Return the cameras with footage, masks and board clips, and the frame rate of the clips."""
    opened = _opened(folder, files.clips, out)
    names = camera_names(list(opened))
    if calibrated:
        names = _named_as_calibrated(names, calibrated, out)
    boards, by_name = pair(names, files.boards)
    if boards and not by_name:
        listed = ", ".join(f"{names[clip]}: {board}" for clip, board in boards.items())
        out.notes.append(f"the names do not show which camera each board clip belongs to; matched in order ({listed})")
    cameras = []
    for clip, video in opened.items():
        size = f"{video.size_px[0]} x {video.size_px[1]} px"
        remark = f"{size}, {video.count} frames, {video.timeline.rate:.5g} fps"
        cameras.append(CameraSketch(names[clip], clip, board=boards.get(clip), remark=remark))
    cameras = with_masks(cameras, files.masks)
    for camera in cameras:
        masks = ", masks" if camera.masks else ""
        board = f", board {camera.board}" if camera.board else ""
        out.found.append(f"camera {camera.name}: {camera.video} ({camera.remark}){masks}{board}")
        if files.boards and not camera.board and not calibrated:
            out.missing.append(f"the board clip of camera {camera.name}")
    if len(cameras) < 2:
        out.missing.append(f"footage of at least two cameras; found {len(cameras)}")
    if 0 < sum(bool(camera.masks) for camera in cameras) < len(cameras):
        out.notes.append("only some cameras have masks; the others are not used for tracking")
    return cameras, _rate(opened, out)


def _opened(folder: Path, clips: Sequence[PurePath], out: CaptureStart) -> dict[PurePath, Clip]:
    from jawusd.media.footage import open_clip

    found: dict[PurePath, Clip] = {}
    for clip in clips:
        try:
            found[clip] = open_clip(folder / clip)
        except JawusdError as error:
            out.notes.append(f"{clip} is skipped: {error.statement().rstrip('.')}")
    return found


def _rate(opened: Mapping[PurePath, Clip], out: CaptureStart) -> float | None:
    rates = {path: video.timeline.rate for path, video in opened.items()}
    if not rates:
        return None
    found = float(np.median(list(rates.values())))
    for path, rate in rates.items():
        if abs(rate / found - 1) > 5e-3:
            out.notes.append(f"{path} has {rate:.5g} fps, but the other clips have {found:.5g}")
    usual = min(_USUAL_RATES, key=lambda rate: abs(rate / found - 1))
    return round(usual if abs(usual / found - 1) < _RATE_TOLERANCE else found, 5)


def _named_as_calibrated(
    names: dict[PurePath, str], calibrated: Sequence[str], out: CaptureStart
) -> dict[PurePath, str]:
    """Return the calibration's camera name of each clip, matched by the words of the clips' paths."""
    fits: dict[PurePath, str] = {}
    for clip in names:
        found = [name for name in calibrated if fitting(name, [clip])]
        if len(found) == 1 and found[0] not in fits.values():
            fits[clip] = found[0]
    if len(fits) == len(names):
        return fits
    out.missing.append(
        f"the camera names: the calibration has {', '.join(calibrated)}, but the clips are {_listed(list(names))}; "
        "give each [[camera]] its name in the calibration"
    )
    return names


def _board(
    folder: Path, cameras: Sequence[CameraSketch], square_mm: float | None, calibrated: bool, out: CaptureStart
) -> BoardSketch | None:
    from jawusd.capture.board_detection import detect_board

    clips = [camera.board for camera in cameras if camera.board is not None]
    if not clips:
        return None
    seen: list[BoardSketch] = []
    for clip in clips:
        video = next(iter(_opened(folder, [clip], out).values()), None)
        if video is not None and (found := detect_board(_some_pictures(video))) is not None:
            seen.append(found)
    board = max(seen, key=seen.count, default=BoardSketch())
    sketch = replace(board, square_mm=square_mm)
    if calibrated:
        return sketch
    if not seen:
        out.missing.append("[boards] cols and rows: no chessboard was found in the board clips")
    elif board.pattern == "charuco":
        out.missing.append(
            "[boards] cols and rows, one less than the squares of the ChArUco board, and marker_mm, the marker's side"
        )
    if seen:
        size = f"{board.cols} x {board.rows} inner corners" if board.cols else f"markers of {board.dictionary}"
        out.found.append(f"board: {board.pattern}, {size}")
    if square_mm is None:
        out.missing.append("[boards] square_mm, the side of a square: measure the printed board (or use --square-mm)")
    return sketch


def _some_pictures(video: Clip) -> list[np.typing.NDArray[np.uint8]]:
    wanted = np.unique(np.linspace(0, video.count - 1, _PICTURES + 2).astype(int)[1:-1])
    return [picture for picture in video.pictures(wanted.tolist()) if picture is not None]


def _listed(paths: Sequence[PurePath]) -> str:
    shown = ", ".join(str(path) for path in paths[:6])
    return shown + (f" and {len(paths) - 6} more" if len(paths) > 6 else "")
