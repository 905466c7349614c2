"""Write a new capture.toml, with comments on each part and missing values, or replace the picked points in one."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath

from pydantic import ValidationError

from jawusd.base.errors import AnyPath, FormatError, OutputError
from jawusd.base.inputs import check_input
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.formats.capture import Bootstrap

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
    return json.dumps(value.as_posix() if isinstance(value, PurePath) else str(value), ensure_ascii=False)


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


def _cameras(cameras: tuple[CameraSketch, ...]) -> Iterable[str]:
    for camera in cameras:
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
    if not cameras:
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


_TABLE = "bootstrap"


def write_bootstrap(path: AnyPath, picks: Bootstrap, expected: Bootstrap | None) -> None:
    """Replace or add `[bootstrap]` of a capture.toml, if its picked points are still the expected ones.

    Raises:
        FormatError: the file is not TOML.
        OutputError: the picked points have changed or cannot be replaced safely, or the file cannot be written.
            The file is then unchanged.
    """
    path = Path(path).resolve()  # for a link, replace its target
    check_input(path)
    try:
        data = path.read_bytes()
        encoding = json.detect_encoding(data)  # detected as in `jawusd.base.tables.read_text`, and kept on writing
        text = data.decode(encoding)
        found = tomllib.loads(text).get(_TABLE)
        there = None if found is None else Bootstrap.model_validate(found)
    except OSError as error:
        raise OutputError(f"cannot be read: {error.strerror}.", path=path) from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FormatError(f"is not valid TOML: {error}.", path=path) from error
    except ValidationError as error:
        raise FormatError(f"[{_TABLE}] cannot be read: {error.errors()[0]['msg']}.", path=path) from error
    if there != expected:
        raise OutputError(
            f"[{_TABLE}] was changed by another program after the file was read.",
            path=path,
            hint="Open the capture again to load the current picks.",
        )
    try:
        changed = with_bootstrap(text, picks)
    except ValueError as error:
        raise OutputError(
            f"{error}.",
            path=path,
            hint=f"Write [{_TABLE}] as tables, [{_TABLE}] and [[{_TABLE}.upper]], or delete it.",
        ) from error
    write_bytes_atomic(path, changed.encode(encoding))


def with_bootstrap(text: str, picks: Bootstrap) -> str:
    """Return the text of a capture.toml with new picked points; comments among the old ones are kept.

    Raises:
        ValueError: the old picked points are not written as tables.
    """
    blocks = list(_blocks(text))
    newline = "\r\n" if "\r\n" in text else "\n"
    own = [number for number, (table, _) in enumerate(blocks) if table == _TABLE]
    comments = [line for number in own for line in _comments(blocks[number][1], last=number == own[-1])]
    fresh = newline.join([f"[{_TABLE}]", *comments, *pick_lines(picks)]) + newline
    if own:
        rest = ["".join(lines) for number, (_, lines) in enumerate(blocks) if number not in own]
        tail = "".join(_after(blocks[own[-1]][1])) or newline * (len(rest) > own[0])
        changed = "".join([*rest[: own[0]], fresh, tail, *rest[own[0] :]])
    else:
        end = "" if not text or text.endswith("\n") else newline
        changed = f"{text}{end}{newline}{fresh}"
    _check(text, changed, picks)
    return changed


def pick_lines(picks: Bootstrap) -> list[str]:
    """Return the lines of picked points in a capture.toml, without the header of their table."""
    lines = [f"frame = {picks.frame}"]
    for arch, picked in (("upper", picks.upper), ("lower", picks.lower)):
        for pick in picked:
            # Camera names need no escapes, since they contain no characters that TOML escapes.
            views = (f'{{ camera = "{view.camera}", x = {view.x:.2f}, y = {view.y:.2f} }}' for view in pick.views)
            lines += ["", f"[[{_TABLE}.{arch}]]", f"vertex = {pick.vertex}", f"views = [{', '.join(views)}]"]
    return lines


def _blocks(text: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the top-level name, header and content lines of each table; the name is "" before the first header."""
    table = ""
    lines: list[str] = []
    for statement in _statements(text):
        if statement[0].lstrip().startswith("["):
            yield table, lines
            table, lines = next(iter(tomllib.loads(statement[0]))), []
        lines += statement
    yield table, lines


def _statements(text: str) -> Iterator[list[str]]:
    """Yield the lines of each header, value, comment or blank line; values may span several lines."""
    pending: list[str] = []
    for line in text.split("\n")[: None if not text.endswith("\n") else -1]:
        pending.append(line + "\n")
        try:
            tomllib.loads("".join(pending))
        except tomllib.TOMLDecodeError:
            continue  # the value continues on the next line
        yield pending
        pending = []
    if pending:
        yield pending


def _comments(lines: list[str], last: bool) -> list[str]:
    """Return the comments of a block; a value with a trailing comment is commented out as a whole."""
    among = lines[: len(lines) - len(_after(lines))] if last else lines
    # Values of picked points contain no #, so a # starts a comment.
    return [line.strip() if line.lstrip().startswith("#") else f"# {line.strip()}" for line in among if "#" in line]


def _after(lines: list[str]) -> list[str]:
    """Return the blank lines and comments at the end of a block, which belong to the next block."""
    count = 0
    while count < len(lines) and lines[-1 - count].strip()[:1] in ("", "#"):
        count += 1
    return lines[len(lines) - count :]


def _check(before: str, after: str, picks: Bootstrap) -> None:
    """Raise ValueError unless two texts differ only in the picked points."""
    try:
        old, new = tomllib.loads(before), tomllib.loads(after)
        written = Bootstrap.model_validate(new.pop(_TABLE))
    except (tomllib.TOMLDecodeError, ValidationError) as error:
        raise ValueError(f"[{_TABLE}] is not written as separate tables") from error
    old.pop(_TABLE, None)
    rounded = Bootstrap.model_validate(tomllib.loads("\n".join(pick_lines(picks)).replace(f"[[{_TABLE}.", "[[")))
    if old != new or written != rounded:
        raise ValueError(f"[{_TABLE}] is not written as separate tables")
