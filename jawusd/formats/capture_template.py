"""Write a new capture.toml with comments that explain each part and mark missing values."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import PurePath

#: Marks a value to be filled in.
FILL = "# FILL IN:"


@dataclass(frozen=True)
class CameraSketch:
    """Files found for one camera; paths are relative to the capture."""

    name: str
    video: PurePath | None = None
    masks: Mapping[str, PurePath] = field(default_factory=dict)  # paths of the masks by arch, "upper" and "lower"
    board: PurePath | None = None
    remark: str = ""  # remark on the footage, written as a comment


@dataclass(frozen=True)
class BoardSketch:
    """Calibration board found in the clips."""

    pattern: str = "chessboard"
    cols: int | None = None
    rows: int | None = None
    square_mm: float | None = None
    dictionary: str | None = None


@dataclass(frozen=True)
class CaptureSketch:
    """Files and values found for a capture; what was not found is None."""

    name: str
    fps: float | None = None
    scans: Mapping[str, PurePath] = field(default_factory=dict)  # paths of the scans by key of [scans]
    cameras: tuple[CameraSketch, ...] = ()
    calibration: PurePath | None = None
    board: BoardSketch | None = None
    flashes: bool = True  # whether the cameras have clips


def capture_text(sketch: CaptureSketch) -> str:
    """Return the text of a capture.toml; missing values become comments, so that the text is always valid TOML."""
    lines = [
        "# A capture for jawusd: one subject, one take. `jawusd check FOLDER` reports problems,",
        "# `jawusd init --reference` explains all keys. Paths are relative to this file; lengths are in mm.",
        "",
        'format = "jawusd-capture/1"',
        f"name = {_text(sketch.name)}",
        'units = "mm"',
        _number("fps", sketch.fps, "24.0", "frames per second of the clips"),
        *_calibration(sketch),
        "# frames = [30, 270]  # only these frames of the first camera: first, and one past the last",
        "",
        *_scans(sketch.scans),
        *_cameras(sketch.cameras),
        *_board(sketch),
        "[sync]",
        'method = "flash"  # room light switched off and on at start and end; without flashes, the sound is used',
        "# offsets = { NAME = 0, OTHER = 5 }  # or given: frame k of a camera is frame k + offset of the first one",
        "",
        "# [motion]",
        "# rest_frame = 46  # a frame with the teeth together; default: found automatically",
        "",
        "# The teeth are located automatically. If that fails, make picks with `jawusd view FOLDER`.",
    ]
    return "\n".join(lines) + "\n"


def _text(value: object) -> str:
    return json.dumps(
        str(PurePath(value).as_posix()) if isinstance(value, PurePath) else str(value), ensure_ascii=False
    )


def _number(key: str, value: float | None, example: str, meaning: str) -> str:
    if value is None:
        return f"{FILL} {key} = {example}  # {meaning}"
    return f"{key} = {value!r}  # {meaning}"


def _calibration(sketch: CaptureSketch) -> Iterable[str]:
    if sketch.calibration is not None:
        yield f"calibration = {_text(sketch.calibration)}"
        yield "# calibration_unit_mm = 1000.0  # if that file is in metres"
    elif sketch.board is None:
        yield f'{FILL} calibration = "calibration.toml"  # of the cameras, or clips of a board in [boards]'


def _scans(scans: Mapping[str, PurePath]) -> Iterable[str]:
    yield "[scans]  # all in one frame, teeth in occlusion"
    for key, wanted in (("upper_teeth", True), ("lower_teeth", True), ("mandible", False), ("skull", False)):
        if key in scans:
            yield f"{key} = {_text(scans[key])}"
        elif wanted:
            yield f'{FILL} {key} = "{key.partition("_")[0]}.ply"  # PLY, STL or OBJ'
        else:
            yield f'# {key} = "{key}.ply"  # optional'
    yield ""


def _cameras(cameras: Iterable[CameraSketch]) -> Iterable[str]:
    none = True
    for camera in cameras:
        none = False
        yield "[[camera]]" + (f"  # {camera.remark}" if camera.remark else "")
        yield f"name = {_text(camera.name)}"
        if camera.video is not None:
            yield f"video = {_text(camera.video)}"
        for arch in ("upper", "lower"):
            if arch in camera.masks:
                yield f"masks.{arch} = {_text(camera.masks[arch])}"
            elif camera.masks:
                yield f'{FILL} masks.{arch} = "{arch}/%06d.png"'
        yield ""
    if none:
        yield f'{FILL} for each camera: [[camera]], name = "left", video = "left.mp4"'
        yield ""


def _board(sketch: CaptureSketch) -> Iterable[str]:
    clips = [camera.board for camera in sketch.cameras]
    board = sketch.board
    if board is None:
        yield "# [boards]  # clips of a chessboard, one per camera: the build calibrates from them"
        yield "# cols = 9"
        yield "# rows = 6"
        yield "# square_mm = 8.0"
        yield '# videos = ["board_left.mp4", "board_right.mp4"]'
        yield ""
        return
    # Boards are not needed if there is a calibration, and become comments.
    mute = "# " if sketch.calibration is not None else ""
    yield f"{mute}[boards]  # clips of a calibration board, in the order of the cameras"
    yield f'{mute}pattern = "{board.pattern}"'
    for key, value, example, meaning in (
        ("cols", board.cols, "9", "inner corners along a row, one less than squares"),
        ("rows", board.rows, "6", "inner corners along a column"),
        ("square_mm", board.square_mm, "8.0", "side of a square, measured on the printed board"),
    ):
        yield mute + _number(key, value, example, meaning)
    if board.pattern == "charuco":
        yield f"{mute}dictionary = {_text(board.dictionary)}" if board.dictionary else f"{FILL} dictionary"
        yield f"{FILL} marker_mm = 6.0  # side of a marker"
    listed = ", ".join(_text(clip) if clip is not None else f'"MISSING_{n}"' for n, clip in enumerate(clips, 1))
    yield f"{mute}videos = [{listed}]"
    yield ""
